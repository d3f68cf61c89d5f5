// A packed scene in GPU memory while it arrives: the table of groups first, then a first picture's groups, the dictionary, and what else is wanted.
// Groups are drawn from when their geometry is there, with their colours alone until codes and atoms are. Mirrors renderer/splats/scene.py; but that a group lies
// in a slot (pool.js), which takes its number's place in all that shaders read.

import { atlasLayout, loadAtoms } from "./atoms.js";
import { groupTree, sharesOf } from "./detail.js";
import { mapFrames, mapTextures } from "./maps.js";
import { CHUNK, CHUNKS_PER_GROUP, GROUP, MIP_SIZES } from "./packed.js";
import { Pool } from "./pool.js";
import { FRAMES, GROUP_WORDS, frameBoxes, originOf } from "./quadrics.js";
import { decodeRuns } from "./runs.js";
import { Seals } from "./seals.js";
import { groupBoxes, splatWords, tablesOf, widthsOf } from "./tables.js";
import { Words } from "./words.js";

const BATCH_BYTES = 1 << 21; // of chunks that are asked for together
const OF_CHUNKS = ["batch_count", "box_low", "box_size", "box_bits", "size_scale", "sizes", "color_low", "color_size", "color_turn"];
const OF_RUNS = ["run_codes", "run_batch"];
const KEPT = { box_low: [Float32Array, 3], box_size: [Float32Array, 3], size_scale: [Uint8Array, 2] }; // on this side too, by slot
const MOST_OUTLINED_BY_CHUNKS = 64, SMALL_GAP = 4096; // groups, as renderer/splats/views.py; bytes between what is one request
const POOL = 2; // groups in memory for each that the budget draws: those above them, and what one has just seen
const ABSENT = 0, FLAT = 1, CODED = 2;

export class Scene {
  /** With at most `budget` splats of it drawn at once. */
  constructor(gl, packed, budget) {
    const { header } = packed, { levels } = header;
    this.nCoarsest = levels ? Math.ceil(levels[0] / GROUP) : 0;
    const room = levels ? Math.max(POOL, Math.ceil((POOL * budget) / GROUP)) + this.nCoarsest + 1 : Infinity;
    Object.assign(this, { gl, packed, header, textures: {}, waiting: new Map(), layout: atlasLayout(header), pool: new Pool(packed.nGroups, room) });
    this.state = new Uint8Array(packed.nGroups);
    this.drawn = new Set(Object.keys(header.effects));
    this.drawn.delete("mip_levels");
    this.drawn.delete("levels");
    if (!header.n_dictionary || header.coarsest_size === header.atom_size) this.drawn.delete("level_blending");
    if (!this.drawn.has("relighting")) this.drawn.delete("normal_smoothing");
    if (header.n_dictionary && header.coarsest_size < header.atom_size) this.drawn.add("mip_levels");
    const first = header.batches.findIndex((batch) => batch.clipline || batch.ellipsoid);
    this.nLeading = first < 0 ? header.batches.length : first;
    this.defines = { COLOR_BOXES: header.color_step, SIZE_BITS: header.size_bits, DETAIL: levels ? 1 : 0, RUNS: header.runs ? 1 : 0,
      QUADRICS: header.geometry === "quadrics" ? 1 : 0, MAPPED: 0 };
    const here = (name) => packed.has(name);
    this.runArrays = OF_RUNS.filter(here);
    this.frameArrays = FRAMES.filter(here);
    this.geometryArrays = [...OF_CHUNKS, "position", "normal", "color", "station"].filter(here).concat(this.runArrays, this.frameArrays);
    this.shapeArrays = ["splats", "colors", "ellipsoids", "cliplines"].filter(here);
  }

  get bytes() {
    return Object.values(this.textures).reduce((sum, words) => sum + words.bytes, (this.maps?.bytes ?? 0) + (this.atlas ? 4 * this.layout.width * this.layout.height : 0));
  }

  /** Chunks of all slots, as `kept` has them. */
  get nChunks() {
    return this.pool.nSlots * CHUNKS_PER_GROUP;
  }

  isShown(group) {
    return this.state[group] !== ABSENT;
  }

  isCoded(group) {
    return this.state[group] === CODED;
  }

  splatsOf(group) {
    return Math.min(GROUP, this.header.n_splats - group * GROUP);
  }

  /** Those of the groups `seen` that are here and, of levels, show the view with no more than `mostSplats`. */
  choose(view, seen, mostSplats) {
    const here = seen.filter((group) => this.isShown(group)), { tree } = this;
    if (!tree) return here;
    const inView = new Set(seen);
    const shares = sharesOf(tree, view, { mostSplats, isSeen: (group) => inView.has(group), isHere: (group) => this.isShown(group) });
    this.share(shares);
    return here.filter((group) => shares[group] > 0);
  }

  /** With what shares groups are drawn from here on. */
  share(shares) {
    this.textures.shares.put(0, new Uint32Array(Float32Array.from(this.pool.groupOf, (group) => (group < 0 ? 0 : shares[group])).buffer));
  }

  /**
   * Load what `wanted()` names, groups in the order in which they are wanted, and go on as it names more. `onChange(stage)` is called when there is more to draw. `atRest()`
   * is waited for when all is there, and may use the pool. Ends by an error alone.
   */
  async load(wanted, onChange, atRest) {
    await this.loadTables();
    onChange("tables");
    for (;;) {
      const { stage, chunks } = this.missing(this.pool.want(wanted()));
      if (stage === "atoms") {
        const { weights, atlas } = await loadAtoms(this.gl, this.packed, this.layout);
        this.textures.weights = weights;
        this.atlas = atlas;
        for (const group of this.pool.groupOf) if (group >= 0) this.advance(group);
        onChange(stage);
      } else if (stage === "maps") {
        await this.loadMaps();
        onChange(stage);
      } else if (stage) {
        await this.read(chunks, onChange);
      } else {
        const woken = new Promise((wake) => { this.wake = wake; });
        onChange("all");
        await atRest();
        await woken;
      }
    }
  }

  // What is to be asked for next, a batch of groups; none where all has arrived. The dictionary is when there is a picture.
  missing(groups) {
    const chunks = this.batch(groups, this.packed.ofGroups), isAny = this.state.some((state) => state !== ABSENT);
    if (chunks.length && !isAny) return { stage: "groups", chunks };
    if (this.header.maps && !this.maps) return { stage: "maps" };
    if (this.header.n_dictionary && !this.atlas) return { stage: "atoms" };
    return chunks.length ? { stage: "groups", chunks } : {};
  }

  batch(groups, arrays) {
    const chunks = [];
    let bytes = 0;
    for (const group of groups)
      for (const array of arrays) {
        if (this.arrived[array][group]) continue;
        const chunk = this.packed.chunk(array, group);
        bytes += chunk.stop - chunk.start;
        if (bytes > BATCH_BYTES && chunks.length) return chunks;
        this.pool.place(group, (before, slot) => this.forget(before, slot));
        chunks.push(chunk);
      }
    return chunks;
  }

  // `again`: what may be asked for more than once, which browsers are to keep.
  async read(chunks, onChange, signal, largestGap, again = false) {
    const checks = [];
    await this.packed.read(chunks, (array, group, values, bytes) => {
      if (this.take(array, group, values)) onChange("groups");
      checks.push(this.seals.hear(array, group, bytes));
    }, signal, largestGap, again);
    await Promise.all(checks);
  }

  forget(group, slot) {
    this.state[group] = ABSENT;
    this.waiting.delete(group);
    this.seals.forget(group);
    for (const arrived of Object.values(this.arrived)) arrived[group] = 0;
    this.kept.box_low.fill(Infinity, slot * CHUNKS_PER_GROUP * 3, (slot + 1) * CHUNKS_PER_GROUP * 3);
  }

  async loadTables() {
    const { packed, header } = this, { nGroups } = packed;
    const tables = await packed.readWhole(["group_low", "group_high", "group_radius", "group_rows", "group_seal", "run_codebook"].filter((name) => packed.has(name)));
    this.kept = Object.fromEntries(Object.entries(KEPT).filter(([name]) => packed.has(name) || name !== "size_scale")
      .map(([name, [Type, width]]) => [name, new Type(this.nChunks * width)]));
    this.kept.box_low.fill(Infinity); // of what is not there yet
    this.codebook = tables.run_codebook;
    this.outlines = tables;
    this.rows = tables.group_rows;
    this.seals = new Seals(tables.group_seal, packed.ofGroups);
    this.groupBoxes = groupBoxes(packed, tables);
    this.largest = tables.group_radius;
    this.counts = [];
    if (header.levels) this.tree = groupTree(packed, tables);
    this.findStreams();
    this.makeTextures();
    this.arrived = Object.fromEntries(packed.ofGroups.map((name) => [name, new Uint8Array(nGroups)]));
    this.outline = { low: tables.group_low, high: tables.group_high, n: nGroups };
    if (header.levels || nGroups <= MOST_OUTLINED_BY_CHUNKS) await this.outlineByChunks();
  }

  // Where each stream of a group begins, and how many words all of them take: one behind the other, or with as much room for each as the largest takes.
  findStreams() {
    const { pool, packed: { ragged, streams, nGroups } } = this;
    this.streams = Object.fromEntries(streams.map((name) => {
      const words = Array.from({ length: nGroups }, (_, group) => this.rowsOf(name, group)), first = [0];
      if (pool.isWhole) for (const n of words) first.push(first.at(-1) + n);
      const most = words.reduce((a, b) => Math.max(a, b), 0);
      const ahead = name === "splats" ? GROUP_WORDS * pool.nSlots : 0; // where each slot's begin, and its group's box
      return [name, { begin: pool.isWhole ? (slot) => ahead + first[slot] : (slot) => ahead + slot * most,
        total: ahead + (pool.isWhole ? first[nGroups] : pool.nSlots * most) }];
    }));
    if (ragged.length && this.rows.length < ragged.length * nGroups) throw new Error("a table of groups that is shorter than they are");
  }

  /** Rows that count of an array of which groups have any number. */
  rowsOf(name, group) {
    const { ragged } = this.packed;
    return this.rows[group * ragged.length + ragged.indexOf(name)];
  }

  makeTextures() {
    const { gl, packed, header, pool: { nSlots }, nChunks, textures } = this, words = (n) => new Words(gl, Math.max(1, n));
    const n = Math.min(header.n_splats, nSlots * GROUP), widths = (this.widths = widthsOf(header)), pairs = !header.color_step;
    Object.assign(textures, { boxes: words(nChunks * widths.boxes + 1), running_counts: words(Math.ceil((nChunks * widths.running) / 2)),
      groups: words(nSlots * widths.groups) });
    if (header.levels) textures.shares = words(nSlots);
    if (header.maps) textures.splat_maps = words(Math.ceil(n / 4));
    const { RUNS, QUADRICS } = this.defines;
    if ((RUNS || QUADRICS) && pairs) textures.colors = words(Math.ceil((3 * n) / 4) + 1);
    if (!QUADRICS) textures.splats = RUNS ? words(4 * n) : new Words(gl, pairs ? n : Math.ceil((n * 5) / 4) + 1, pairs);
    for (const name of packed.streams) textures[name] = words(this.streams[name].total + 1);
  }

  // Boxes of chunks that hold the scene, before a camera is placed: those of the coarsest level, which is the first picture too, else of all groups.
  async outlineByChunks() {
    const { packed, header, kept } = this, { levels } = header;
    const groups = Array.from({ length: levels ? Math.ceil(levels[0] / GROUP) : packed.nGroups }, (_, group) => group);
    const isSmall = levels || packed.source.size < BATCH_BYTES, arrays = isSmall ? packed.ofGroups : header.runs ? this.runArrays : this.defines.QUADRICS ? this.frameArrays : ["box_low", "box_size"];
    for (let chunks; (chunks = this.batch(this.pool.want(groups), arrays)).length;) await this.read(chunks, () => {}, undefined, isSmall ? undefined : SMALL_GAP);
    const n = Math.min(groups.length * CHUNKS_PER_GROUP, packed.nChunks), low = kept.box_low.slice(0, 3 * n);
    this.outline = { low, high: low.map((x, i) => x + kept.box_size[i]), n };
  }

  // Bring a group's rows of an array to the GPU; whether there is more to draw now.
  take(array, group, values) {
    const stream = this.streams[array];
    if (stream) {
      this.textures[array].put(stream.begin(this.pool.slotOf[group]), values.subarray(0, this.rowsOf(array, group)));
    } else if (this.geometryArrays.includes(array)) {
      const parts = { ...this.waiting.get(group), [array]: values };
      if (this.runArrays.includes(array) && this.runArrays.every((name) => parts[name])) this.decodeRuns(group, parts);
      if (this.frameArrays.includes(array) && this.frameArrays.every((name) => parts[name])) this.keep(group, frameBoxes(parts, Math.ceil(this.splatsOf(group) / CHUNK), originOf(this.outlines, group)));
      this.waiting.set(group, parts);
      this.keep(group, { [array]: values });
      if (this.geometryArrays.every((name) => parts[name])) {
        this.putGroup(group, parts);
        this.waiting.delete(group);
      }
    }
    this.arrived[array][group] = 1;
    return this.advance(group);
  }

  decodeRuns(group, parts) {
    const n = this.splatsOf(group), bytes = parts.run_codes.subarray(0, this.rowsOf("run_codes", group));
    const { splats, ...boxes } = decodeRuns(this.header, this.codebook, bytes, parts.run_batch, n);
    this.textures.splats.put(this.pool.slotOf[group] * GROUP * 4, splats);
    Object.assign(parts, boxes);
    this.keep(group, boxes);
  }

  keep(group, parts) {
    const n = Math.ceil(this.splatsOf(group) / CHUNK), chunk = this.pool.slotOf[group] * CHUNKS_PER_GROUP;
    for (const [name, [, width]] of Object.entries(KEPT)) if (parts[name]) this.kept[name].set(parts[name].subarray(0, n * width), chunk * width);
  }

  putGroup(group, parts) {
    const { header, textures, widths, pool } = this, slot = pool.slotOf[group], n = this.splatsOf(group), chunk = slot * CHUNKS_PER_GROUP;
    if (!(header.runs || this.defines.QUADRICS)) {
      const perGroup = header.color_step ? (GROUP * 5) / 4 : GROUP, spared = n < GROUP ? undefined : perGroup * (header.color_step ? 1 : 2);
      textures.splats.put(slot * perGroup, splatWords(n, parts).subarray(0, spared));
    } else if (parts.color) textures.colors.put((slot * GROUP * 3) / 4, asWords(parts.color, 3 * n));
    if (this.defines.QUADRICS) textures.splats.put(slot * GROUP_WORDS, this.headOf(group));
    if (parts.station) textures.splat_maps.put((slot * GROUP) / 4, asWords(parts.station, n));
    const first = Object.fromEntries(Object.entries(this.streams).map(([name, { begin }]) => [name, begin(slot)]));
    const { counts, boxes, running, groups } = tablesOf(header, parts, n, first);
    this.counts[group] = counts;
    textures.boxes.put(chunk * widths.boxes, boxes);
    textures.running_counts.put((chunk * widths.running) / 2, running);
    textures.groups.put(slot * widths.groups, groups);
  }

  // The first word of a slot's numbers, and where the box of its group begins.
  headOf(group) {
    const head = new Uint32Array(GROUP_WORDS);
    head[0] = this.streams.splats.begin(this.pool.slotOf[group]);
    new Float32Array(head.buffer).set(originOf(this.outlines, group), 1);
    return head;
  }

  advance(group) {
    const here = (name) => this.arrived[name][group], was = this.state[group];
    if (![...this.geometryArrays, ...this.shapeArrays].every(here)) return false;
    this.state[group] = this.atlas && here("codes") ? CODED : FLAT; // of a file without a dictionary all are flat
    return this.state[group] !== was;
  }

  async loadMaps() {
    const { gl, packed, header } = this, frames = mapFrames(header);
    this.maps = await mapTextures(gl, header, await packed.readWhole(["map_colors", "map_depth_low", "map_depth_high"]));
    this.textures.map_frames = new Words(gl, frames.length).put(0, frames);
    this.defines.MAPPED = 1;
  }

  /** Bytes of the uniform block `Scene` of shaders/view.glsl. */
  uniformBlock() {
    const { header, pool, layout } = this, block = new DataView(new ArrayBuffer(128));
    const put = (kind, at, values) => values.forEach((value, i) => block[kind](at + 4 * i, value, true));
    const nSplats = (pool.nSlots - 1) * GROUP + this.splatsOf(pool.nGroups - 1); // up to the last slot's end, which is the last group's
    put("setInt32", 0, header.up);
    put("setInt32", 16, header.ahead);
    put("setFloat32", 32, [header.radius]);
    put("setUint32", 36, [nSplats, header.batches.length, header.dictionary_bits, header.weight_bits, pool.nSlots, layout.width,
      MIP_SIZES.indexOf(header.atom_size), ...layout.bands]);
    put("setFloat32", 88, [1 / layout.width, 1 / layout.height]);
    put("setUint32", 96, [MIP_SIZES.indexOf(header.coarsest_size), header.n_ranks]);
    return block.buffer;
  }
}

function asWords(bytes, n) {
  const words = new Uint32Array(Math.ceil(n / 4));
  new Uint8Array(words.buffer).set(bytes.subarray(0, n));
  return words;
}
