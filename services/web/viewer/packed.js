// The arrays of a packed file, as docs/FORMAT.md has them; mirrors storage/packed. What follows a change of the format is here and in tables.js.

import { ArchiveForm } from "./plain.js";
import { readDirectory, readMembers, text, viewOf } from "./zip.js";
import { decompress } from "./zstd.js";

export const VERSIONS = [1];
export const CHUNK = 128;
export const CHUNKS_PER_GROUP = 64;
export const GROUP = CHUNK * CHUNKS_PER_GROUP;
export const MIP_SIZES = [32, 16, 8, 4, 2, 1];
const MOST_CHUNK_BYTES = 1 << 24;
const TYPES = {
  box_low: Float32Array, box_size: Float32Array, color_low: Int16Array, colors: Uint32Array, codes: Uint32Array, weight_levels: Float32Array,
  frame_origin: Uint16Array, frame_step: Uint16Array, frame_cells: Uint16Array, normal_low: Int16Array, splats: Uint32Array, atom_scale: Float32Array, cliplines: Uint32Array, sizes: Uint32Array, ellipsoids: Uint32Array, camera: Uint16Array, group_low: Float32Array,
  group_high: Float32Array, group_radius: Float32Array, group_rows: Uint32Array, group_start: BigUint64Array, group_bytes: BigUint64Array,
}; // all others are bytes
const SIGNED = new Set(["normal", "color_turn", "frame_turn", "frame_curve", "normal_slope", "run_codebook"]);
const FIRST_CHUNK = /\/c\/0(\/0)*$/, NOT_OF_GROUPS = /^(group|atoms?|map|weight)_|^run_codebook/;
const STREAMS = ["splats", "colors", "codes", "cliplines", "ellipsoids"]; // in the order of group_rows, behind run_codes, which no file has with splats

/** An opened packed file: its header, and arrays when they are asked for. */
export class Packed {
  static async open(source) {
    const members = await readDirectory(source);
    const root = members.get("zarr.json");
    if (!root) throw new Error("a zip without a header");
    let header = null;
    await readMembers(source, [root], (_, bytes) => { header = JSON.parse(text(bytes)).attributes; });
    return new Packed(source, members, header);
  }

  constructor(source, members, header) {
    if (header.format !== "splatpress" || !VERSIONS.includes(header.version))
      throw new Error(`a file of version ${header.version}; this viewer draws version ${VERSIONS.join(", ")}`);
    if (!["boxes", "runs", "quadrics"].includes(header.geometry ?? "boxes"))
      throw new Error(`a file whose geometry is ${header.geometry}; this viewer draws boxes, runs and quadrics`);
    if (header.archive) throw new ArchiveForm("a file in archive form, which this viewer does not read: splatpress export --to plain makes one that it does");
    Object.assign(this, { source, members, header });
    if (header.runs && !members.has("run_codes/c/0/0")) throw new Error("a file of runs without their codes, of an older writer: pack the scan again");
    header.effects ??= {};
    this.nChunks = Math.ceil(header.n_splats / CHUNK);
    this.nGroups = Math.ceil(header.n_splats / GROUP);
    this.counts = new Map();
    // Arrays whose chunks are of a group each, in the order in which they stand in the file.
    this.ofGroups = [...members.values()].filter(({ name }) => FIRST_CHUNK.test(name) && !NOT_OF_GROUPS.test(name)).sort((a, b) => a.start - b.start)
      .map(({ name }) => name.slice(0, name.indexOf("/")));
    for (const name of members.keys()) {
      const array = name.slice(0, name.indexOf("/"));
      if (name.includes("/c/")) this.counts.set(array, (this.counts.get(array) || 0) + 1);
    }
  }

  /** Those word streams that the file has. */
  get streams() {
    return STREAMS.filter((name) => this.has(name));
  }

  /** Arrays of which groups have any number of rows, in the order of group_rows. */
  get ragged() {
    return ["run_codes", ...STREAMS].filter((name) => this.has(name));
  }

  has(name) {
    return this.counts.has(name);
  }

  /** The zarr chunks of an array, along its first axis. */
  chunksOf(name) {
    return Array.from({ length: this.counts.get(name) || 0 }, (_, i) => this.chunk(name, i));
  }

  chunk(array, index) {
    return { array, index, ...this.members.get(this.memberOf(array, index)) };
  }

  memberOf(name, index) {
    for (let tail = ""; tail.length < 8; tail += "/0") if (this.members.has(`${name}/c/${index}${tail}`)) return `${name}/c/${index}${tail}`;
    throw new Error(`the file lacks chunk ${index} of ${name}`);
  }

  /** Ask for chunks of `chunksOf`; `onChunk(array, index, values, bytes)` hears each, with its bytes as they stand in the file. */
  async read(chunks, onChunk, signal, largestGap, again) {
    const byMember = new Map(chunks.map((chunk) => [chunk.name, chunk]));
    await readMembers(this.source, chunks, (name, bytes) => {
      const { array, index } = byMember.get(name);
      onChunk(array, index, valuesOf(array, bytes), bytes);
    }, signal, largestGap, again);
  }

  /** Whole arrays by name; their last chunks may be longer than they are. */
  async readWhole(names) {
    const parts = Object.fromEntries(names.map((name) => [name, []]));
    await this.read(names.flatMap((name) => this.chunksOf(name)), (array, index, values) => { parts[array][index] = values; });
    return Object.fromEntries(names.map((name) => [name, joined(parts[name])]));
  }
}

function valuesOf(array, bytes) {
  const isTable = array.startsWith("group_"), size = isTable ? bytes.length : promised(bytes);
  if (!(size >= 0 && size <= MOST_CHUNK_BYTES)) throw new Error(`a chunk of ${array} of ${size} bytes`);
  const raw = isTable ? bytes.slice() : decompress(bytes, size);
  const Type = TYPES[array] || (SIGNED.has(array) || array.startsWith("atoms_") ? Int8Array : Uint8Array);
  if (raw.length % Type.BYTES_PER_ELEMENT) throw new Error(`a chunk of ${array} of ${raw.length} bytes`);
  return new Type(raw.buffer);
}

// What a zstd frame says that its contents are (RFC 8878, 3.1.1.1).
export function promised(bytes) {
  const view = viewOf(bytes), kind = bytes[4] >> 6, single = (bytes[4] >> 5) & 1;
  const at = 5 + (single ? 0 : 1) + [0, 1, 2, 4][bytes[4] & 3];
  return kind === 0 ? bytes[at] : kind === 1 ? view.getUint16(at, true) + 256 : view.getUint32(at, true);
}

function joined(parts) {
  if (parts.length === 1) return parts[0];
  const all = new parts[0].constructor(parts.reduce((n, part) => n + part.length, 0));
  let at = 0;
  for (const part of parts) all.set(part, at), (at += part.length);
  return all;
}

/** Unit vector that is up: the file's direction, turned to where the tops of most photographs point. */
export function upOf({ up, cameras }) {
  const length = Math.hypot(...up);
  const tops = cameras.reduce((sum, camera) => sum - up[0] * camera.rotation[1][0] - up[1] * camera.rotation[1][1] - up[2] * camera.rotation[1][2], 0);
  return up.map((x) => (tops < 0 ? -x : x) / length);
}
