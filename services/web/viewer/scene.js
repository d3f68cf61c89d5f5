// A packed scene in GPU memory while it arrives: the table of groups first, then geometry and colours of groups, then atoms and codes. Groups are
// drawn from when their geometry is there, with their colours alone until their codes are. Mirrors renderer/splats/scene.py.

import { groupTree, sharesOf } from "./detail.js";
import { mapFrames, mapTextures } from "./maps.js";
import { CHUNK, CHUNKS_PER_GROUP, GROUP, MIP_SIZES } from "./packed.js";
import { decodeRuns, readRuns } from "./runs.js";
import { atlasBand, atlasLayout, firstWords, groupBoxes, splatWords, tablesOf, widthsOf } from "./tables.js";

const LINE = 2048; // texels to a line of a texture, as renderer/splats/gles.py has it
const BATCH_BYTES = 1 << 21; // of chunks that are asked for together
const OF_CHUNKS = ["batch_count", "box_low", "box_size", "box_bits", "size_scale", "sizes", "color_low", "color_size"];
const KEPT = { box_low: [Float32Array, 3], box_size: [Float32Array, 3], size_scale: [Uint8Array, 2] }; // on this side too
const MOST_OUTLINED_BY_CHUNKS = 64, SMALL_GAP = 4096; // groups, as renderer/splats/views.py; bytes between what is one request
const ABSENT = 0, FLAT = 1, CODED = 2;

/** A texture of 32-bit words, or of pairs of them, that `load` of the shaders reads. */
class Words {
  constructor(gl, n, pairs = false) {
    const height = Math.max(1, Math.ceil(n / LINE)), most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    if (height > most) throw new Error(`this file needs textures of ${height} lines; this device has ${most}`);
    Object.assign(this, { gl, pairs, texture: gl.createTexture(), bytes: height * LINE * (pairs ? 8 : 4) });
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, pairs ? gl.RG32UI : gl.R32UI, LINE, height);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
  }

  /** `words` from the texel `first` on. */
  put(first, words) {
    const { gl } = this, per = this.pairs ? 2 : 1, n = words.length / per;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    for (let done = 0; done < n;) {
      const x = (first + done) % LINE, whole = x ? 0 : Math.floor((n - done) / LINE), width = whole ? LINE : Math.min(LINE - x, n - done);
      const texels = width * Math.max(1, whole), part = words.subarray(done * per, (done + texels) * per);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, x, Math.floor((first + done) / LINE), width, Math.max(1, whole),
        this.pairs ? gl.RG_INTEGER : gl.RED_INTEGER, gl.UNSIGNED_INT, part);
      done += texels;
    }
    return this;
  }
}

export class Scene {
  constructor(gl, packed) {
    const { header } = packed;
    Object.assign(this, { gl, packed, header, textures: {}, loaded: 0, waiting: new Map(), layout: atlasLayout(header), hasAtoms: false });
    this.state = new Uint8Array(packed.nGroups);
    this.drawn = new Set(Object.keys(header.effects));
    this.drawn.delete("mip_levels");
    this.drawn.delete("levels");
    if (!header.n_dictionary || header.coarsest_size === header.atom_size) this.drawn.delete("level_blending");
    if (!this.drawn.has("relighting")) this.drawn.delete("normal_smoothing");
    if (header.n_dictionary && header.coarsest_size < header.atom_size) this.drawn.add("mip_levels");
    const first = header.batches.findIndex((batch) => batch.clipline || batch.ellipsoid);
    this.nLeading = first < 0 ? header.batches.length : first;
    this.defines = { COLOR_BOXES: header.color_step ? 1 : 0, SIZE_BITS: header.size_bits, DETAIL: header.levels ? 1 : 0, RUNS: header.runs ? 1 : 0, MAPPED: 0 };
    this.geometryArrays = [...OF_CHUNKS, "position", "normal", "color"].filter((name) => packed.has(name));
    this.shapeArrays = ["colors", "ellipsoids", "cliplines"].filter((name) => packed.has(name));
  }

  get bytes() {
    return Object.values(this.textures).reduce((sum, words) => sum + words.bytes, this.maps?.bytes ?? 0);
  }

  isShown(group) {
    return this.state[group] !== ABSENT;
  }

  isCoded(group) {
    return this.state[group] === CODED;
  }

  /** Those of the groups `seen` that are here and, of levels, show the view with no more than `mostSplats`. */
  choose(view, seen, mostSplats) {
    const here = seen.filter((group) => this.isShown(group));
    if (!this.tree) return here;
    const inView = new Set(seen);
    const shares = sharesOf(this.tree, view, { mostSplats, isSeen: (group) => inView.has(group), isHere: (group) => this.isShown(group) });
    this.textures.shares.put(0, new Uint32Array(shares.buffer));
    return here.filter((group) => shares[group] > 0);
  }

  /**
   * Load what `wanted()` names, groups in the order in which they are wanted, and go on as it names more: geometry and colours, then atoms and
   * codes. `onChange(stage)` is called when there is more to draw. Ends with `signal` alone.
   */
  async load(wanted, onChange, signal) {
    await this.loadTables(signal);
    onChange("tables");
    for (;;) {
      const groups = wanted(), { stage, chunks } = this.missing(groups);
      if (stage === "atoms") {
        await this.loadAtoms(signal);
      } else if (stage === "maps") {
        await this.loadMaps(signal);
        onChange(stage);
      } else if (stage) {
        await this.packed.read(chunks, (array, index, values) => { if (this.take(array, index, values)) onChange(stage); }, signal);
      } else {
        onChange("all");
        await new Promise((wake) => { this.wake = wake; });
      }
    }
  }

  // What is to be asked for next, a batch of chunks; none where all has arrived.
  missing(groups) {
    const geometry = this.batch(groups, [...this.geometryArrays, ...this.shapeArrays]);
    if (geometry.length) return { stage: "geometry", chunks: geometry };
    if (this.header.maps && !this.maps) return { stage: "maps" };
    if (!this.header.n_dictionary) return {};
    if (!this.hasAtoms) return { stage: "atoms" };
    const codes = this.batch(groups, ["codes"]);
    return codes.length ? { stage: "codes", chunks: codes } : {};
  }

  batch(groups, arrays) {
    const chunks = new Map();
    let bytes = 0;
    for (const group of groups)
      for (const array of arrays) {
        if (this.arrived[array][group]) continue;
        const chunk = this.packed.chunk(array, group);
        bytes += chunk.stop - chunk.start;
        if (bytes > BATCH_BYTES && chunks.size) return [...chunks.values()];
        chunks.set(`${array}/${group}`, chunk);
      }
    return [...chunks.values()];
  }

  async loadTables(signal) {
    const { gl, packed, header } = this, { nChunks, nGroups } = packed, widths = widthsOf(header);
    this.arrays = await packed.readWhole(["group_low", "group_high", "group_radius", "group_rows"].filter((name) => packed.has(name)), signal);
    this.outline = { low: this.arrays.group_low, high: this.arrays.group_high, n: nGroups };
    if (header.runs) this.decoded = decodeRuns(packed, await readRuns(packed, firstWords(packed, this.arrays.group_rows), signal));
    if (this.decoded) {
      const { box_low: low, box_size: size } = this.decoded;
      this.outline = { low, high: low.map((x, i) => x + size[i]), n: nChunks };
    } else if (nGroups <= MOST_OUTLINED_BY_CHUNKS) {
      const { box_low: low, box_size: size } = await packed.readWhole(["box_low", "box_size"], signal, SMALL_GAP);
      this.outline = { low, high: low.map((x, i) => x + size[i]), n: nChunks };
    }
    for (const [name, [Type, width]] of Object.entries(KEPT)) if (packed.has(name)) this.arrays[name] = new Type(nChunks * width);
    if (this.decoded) Object.assign(this.arrays, { box_low: this.decoded.box_low, box_size: this.decoded.box_size });
    else this.arrays.box_low.fill(Infinity); // of what is not there yet
    this.first = firstWords(packed, this.arrays.group_rows);
    this.groupBoxes = groupBoxes(packed, this.arrays);
    this.counts = [];
    this.widths = widths;
    const table = (n) => new Words(gl, Math.max(1, n));
    Object.assign(this.textures, { boxes: table(nChunks * widths.boxes + 1), running_counts: table(Math.ceil((nChunks * widths.running) / 2)),
      groups: table(nGroups * widths.groups) });
    if (header.levels) {
      this.tree = groupTree(packed, this.arrays);
      this.textures.shares = new Words(gl, nGroups);
    }
    const pairs = !header.color_step, n = header.n_splats;
    if (this.decoded) {
      this.textures.splats = new Words(gl, 4 * n).put(0, this.decoded.splats);
      if (pairs) this.textures.colors = new Words(gl, Math.ceil((3 * n) / 4) + 1);
    } else this.textures.splats = new Words(gl, pairs ? n : Math.ceil((n * 5) / 4) + 1, pairs);
    for (const name of packed.streams) this.textures[name] = new Words(gl, this.first[name][nGroups] + 1);
    this.arrived = Object.fromEntries([...this.geometryArrays, ...packed.streams].map((name) => [name, new Uint8Array(nGroups)]));
  }

  // Bring a group's rows of an array to the GPU; whether there is more to draw now.
  take(array, group, values) {
    const first = this.first[array];
    if (first) {
      this.textures[array].put(first[group], values.subarray(0, first[group + 1] - first[group]));
    } else {
      const parts = { ...this.waiting.get(group), [array]: values };
      this.waiting.set(group, parts);
      if (Object.keys(parts).length === this.geometryArrays.length) {
        this.putGroup(group, parts);
        this.waiting.delete(group);
      }
    }
    this.arrived[array][group] = 1;
    return this.advance(group);
  }

  putGroup(group, parts) {
    const { header, textures, widths } = this, n = Math.min(GROUP, header.n_splats - group * GROUP), chunk = group * CHUNKS_PER_GROUP;
    const perGroup = header.color_step ? (GROUP * 5) / 4 : GROUP, spared = n < GROUP ? undefined : perGroup * (header.color_step ? 1 : 2);
    if (this.decoded) parts = this.ofRuns(group, n, parts);
    else textures.splats.put(group * perGroup, splatWords(n, parts).subarray(0, spared));
    const first = Object.fromEntries(this.packed.streams.map((name) => [name, this.first[name][group]]));
    const { counts, boxes, running, groups } = tablesOf(header, parts, n, first);
    this.counts[group] = counts;
    textures.boxes.put(chunk * widths.boxes, boxes);
    textures.running_counts.put((chunk * widths.running) / 2, running);
    textures.groups.put(group * widths.groups, groups);
    for (const [name, [, width]] of Object.entries(KEPT))
      if (parts[name]) this.arrays[name].set(parts[name].subarray(0, Math.ceil(n / CHUNK) * width), chunk * width);
  }

  // Colours of a group of runs to the GPU; with the boxes of its chunks, which are decoded already.
  ofRuns(group, n, parts) {
    if (parts.color) {
      const words = new Uint32Array(Math.ceil((3 * n) / 4));
      new Uint8Array(words.buffer).set(parts.color.subarray(0, 3 * n));
      this.textures.colors.put((group * GROUP * 3) / 4, words);
    }
    const [first, end] = [3 * group * CHUNKS_PER_GROUP, 3 * (group * CHUNKS_PER_GROUP + Math.ceil(n / CHUNK))];
    return { ...parts, ...Object.fromEntries(["box_low", "box_size", "box_bits"].map((name) => [name, this.decoded[name].subarray(first, end)])) };
  }

  advance(group) {
    const here = (name) => this.arrived[name][group], was = this.state[group];
    if (![...this.geometryArrays, ...this.shapeArrays].every(here)) return false;
    this.state[group] = this.hasAtoms && here("codes") ? CODED : FLAT;
    return this.state[group] !== was;
  }

  async loadMaps(signal) {
    const { gl, packed, header } = this, names = ["station", "map_colors", "map_depth_low", "map_depth_high"];
    const arrays = await packed.readWhole(names, signal), frames = mapFrames(header);
    this.maps = await mapTextures(gl, header, arrays);
    const stations = new Uint32Array(Math.ceil(header.n_splats / 4));
    new Uint8Array(stations.buffer).set(arrays.station.subarray(0, header.n_splats));
    this.textures.splat_maps = new Words(gl, stations.length).put(0, stations);
    this.textures.map_frames = new Words(gl, frames.length).put(0, frames);
    this.defines.MAPPED = 1;
  }

  async loadAtoms(signal) {
    const { gl, packed, header, layout } = this, sizes = MIP_SIZES.filter((s) => s <= header.atom_size && s >= header.coarsest_size);
    const found = await packed.readWhole(["weight_levels", "atom_scale", ...sizes.map((s) => `atoms_${s}`)], signal);
    const levels = header.n_ranks << header.weight_bits, floats = new Float32Array(levels + header.n_dictionary);
    floats.set(found.weight_levels.subarray(0, levels));
    floats.set(found.atom_scale.subarray(0, header.n_dictionary), levels);
    this.textures.weights = new Words(gl, floats.length).put(0, new Uint32Array(floats.buffer));
    if (Math.max(layout.width, layout.height) > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("a dictionary too large for this device");
    this.atlas = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.atlas);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGB8_SNORM, layout.width, layout.height);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.LINEAR);
    for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    for (const size of sizes) {
      const { rows, band } = atlasBand(found[`atoms_${size}`], size, header.n_dictionary, layout);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, layout.bands[MIP_SIZES.indexOf(size)], layout.width, rows, gl.RGB, gl.BYTE, band);
    }
    this.hasAtoms = true;
  }

  /** Bytes of the uniform block `Scene` of shaders/view.glsl. */
  uniformBlock() {
    const { header, packed, layout } = this, block = new DataView(new ArrayBuffer(128));
    const put = (kind, at, values) => values.forEach((value, i) => block[kind](at + 4 * i, value, true));
    put("setInt32", 0, header.up);
    put("setInt32", 16, header.ahead);
    put("setFloat32", 32, [header.radius]);
    put("setUint32", 36, [header.n_splats, header.batches.length, header.dictionary_bits, header.weight_bits, packed.nGroups, layout.width,
      MIP_SIZES.indexOf(header.atom_size), ...layout.bands]);
    put("setFloat32", 88, [1 / layout.width, 1 / layout.height]);
    put("setUint32", 96, [MIP_SIZES.indexOf(header.coarsest_size), header.n_ranks]);
    return block.buffer;
  }
}
