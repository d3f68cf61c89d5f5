// What is derived when a scene is loaded: running counts of batches, where streams begin, boxes. Mirrors renderer/splats/scene.py.

import { CHUNK, CHUNKS_PER_GROUP, GROUP, MIP_SIZES } from "./packed.js";

const LONGEST_ELLIPSOID = 4; // half axis in radii that a byte can say

/** Where each group's words begin in a stream that stands one group after the other, and where the last ones end: by stream (nGroups + 1). */
export function firstWords({ streams, nGroups }, words) {
  const found = {};
  streams.forEach((name, i) => {
    const first = (found[name] = new Float64Array(nGroups + 1)); // whole numbers beyond 32 bits
    for (let group = 0; group < nGroups; ++group) first[group + 1] = first[group] + words[group * streams.length + i];
  });
  return found;
}

/** Tables of `arrays`, those of chunks and groups; typed arrays of 32-bit words as the shaders take them. */
export function tablesOf(packed, arrays) {
  const { header, nChunks, nGroups } = packed, nBatches = header.batches.length;
  const counts = groupCounts(arrays.batch_count, nChunks, nGroups, nBatches);
  return {
    counts, boxes: boxWords(packed, arrays), running: runningCounts(arrays.batch_count, nChunks, nBatches),
    groups: groupTable(packed, arrays, counts), groupBoxes: groupBoxes(packed, arrays),
  };
}

// (nGroups, nBatches) splats of each batch in each group.
function groupCounts(batchCount, nChunks, nGroups, nBatches) {
  const counts = Array.from({ length: nGroups }, () => new Uint32Array(nBatches));
  for (let chunk = 0; chunk < nChunks; ++chunk)
    for (let batch = 0; batch < nBatches; ++batch) counts[(chunk / CHUNKS_PER_GROUP) | 0][batch] += batchCount[chunk * nBatches + batch];
  return counts;
}

/** The radius that a step of `size_scale` stands for. */
const radiusOf = (header, step) => header.radius * 2 ** (step / 16 - 8);

// Low corner, size, bits and scale of sizes of each chunk's box, where colours are in boxes first word, low corner, size and bits of those, and
// where splats have sizes their words; a spare word at the end.
function boxWords({ header, nChunks }, arrays) {
  const sizeAt = header.color_step ? 11 : 7, perChunk = 4 * header.size_bits, width = sizeAt + perChunk;
  const words = new Uint32Array(nChunks * width + 1), floats = new Float32Array(words.buffer);
  let colorWord = 0;
  for (let chunk = 0; chunk < nChunks; ++chunk) {
    const at = chunk * width, i = 3 * chunk;
    for (let axis = 0; axis < 3; ++axis) {
      floats[at + axis] = arrays.box_low[i + axis];
      floats[at + 3 + axis] = arrays.box_size[i + axis];
    }
    words[at + 6] = arrays.box_bits[i] | (arrays.box_bits[i + 1] << 8);
    if (header.size_bits) {
      words[at + 6] |= (arrays.size_scale[2 * chunk] << 16) | (arrays.size_scale[2 * chunk + 1] << 24);
      words.set(arrays.sizes.subarray(chunk * perChunk, (chunk + 1) * perChunk), at + sizeAt);
    }
    if (!header.color_step) continue;
    const low = arrays.color_low.subarray(i, i + 3), size = arrays.color_size.subarray(i, i + 3);
    const bits = [...size].map((s) => Math.max(0, Math.ceil((s - header.color_step) / 16)));
    words[at + 7] = colorWord;
    colorWord += Math.ceil((Math.min(CHUNK, header.n_splats - chunk * CHUNK) * (bits[0] + bits[1] + bits[2])) / 32);
    words[at + 8] = (low[0] & 0xffff) | (low[1] << 16);
    words[at + 9] = (low[2] & 0xffff) | (size[0] << 16) | (size[1] << 24);
    words[at + 10] = size[2] | (bits[0] << 8) | (bits[1] << 16) | (bits[2] << 24);
  }
  return words;
}

// For each chunk and each batch but the last: splats of its group, through this chunk, of the batches up to this one; two a word.
function runningCounts(batchCount, nChunks, nBatches) {
  const width = nBatches - 1, halves = new Uint16Array((nChunks * width + 1) & ~1), through = new Uint32Array(nBatches);
  for (let chunk = 0; chunk < nChunks; ++chunk) {
    if (chunk % CHUNKS_PER_GROUP === 0) through.fill(0);
    let sum = 0;
    for (let batch = 0; batch < nBatches; ++batch) {
      through[batch] += batchCount[chunk * nBatches + batch];
      sum += through[batch];
      if (batch < width) halves[chunk * width + batch] = sum;
    }
  }
  return new Uint32Array(halves.buffer);
}

// First words of codes and cliplines, then of each batch its first entry and its first clipline or ellipsoid's word.
function groupTable({ header, nGroups }, { first }, counts) {
  const { batches } = header, width = 2 + 2 * batches.length, table = new Uint32Array(nGroups * width);
  for (let group = 0; group < nGroups; ++group) {
    table[group * width] = first.codes?.[group] ?? 0;
    table[group * width + 1] = first.cliplines?.[group] ?? 0;
    let entry = 0, line = 0, ellipsoid = first.ellipsoids?.[group] ?? 0;
    batches.forEach((batch, i) => {
      const n = counts[group][i];
      table[group * width + 2 + 2 * i] = entry;
      table[group * width + 3 + 2 * i] = batch.ellipsoid ? ellipsoid : line;
      entry += n * batch.n_atoms;
      if (batch.clipline) line += n;
      if (batch.ellipsoid) ellipsoid += n;
    });
  }
  return table;
}

// (nGroups, 6) low and high corner against the origin, grown by what splats reach.
function groupBoxes({ header, nChunks, nGroups }, { box_low: low, box_size: size, size_scale: scale }) {
  const boxes = new Float64Array(nGroups * 6), longest = header.batches.some((b) => b.ellipsoid) ? LONGEST_ELLIPSOID : 1;
  for (let group = 0; group < nGroups; ++group) boxes.fill(Infinity, 6 * group, 6 * group + 3).fill(-Infinity, 6 * group + 3, 6 * group + 6);
  for (let chunk = 0; chunk < nChunks; ++chunk) {
    const at = 6 * ((chunk / CHUNKS_PER_GROUP) | 0), reach = longest * (scale ? radiusOf(header, scale[2 * chunk + 1]) : header.radius);
    for (let axis = 0; axis < 3; ++axis) {
      boxes[at + axis] = Math.min(boxes[at + axis], low[3 * chunk + axis] - reach);
      boxes[at + 3 + axis] = Math.max(boxes[at + 3 + axis], low[3 * chunk + axis] + size[3 * chunk + axis] + reach);
    }
  }
  return boxes;
}

/** The radius of splats about a point against the origin: the middle of the scale of the chunk whose box is nearest, of equals the smallest. */
export function radiusAt({ header, nChunks }, { box_low: low, box_size: size, size_scale: scale }, point) {
  if (!scale) return header.radius;
  let best = [Infinity, Infinity], found = header.radius;
  for (let chunk = 0; chunk < nChunks; ++chunk) {
    const off = Math.hypot(...point.map((x, i) => Math.max(low[3 * chunk + i] - x, x - low[3 * chunk + i] - size[3 * chunk + i], 0)));
    const extent = Math.hypot(size[3 * chunk], size[3 * chunk + 1], size[3 * chunk + 2]);
    if (off < best[0] || (off === best[0] && extent < best[1])) {
      best = [off, extent];
      found = radiusOf(header, (scale[2 * chunk] + scale[2 * chunk + 1]) / 2);
    }
  }
  return found;
}

/** The mean radius of a group's splats; sizes are codes of a few bits on the scale of their chunk (storage/packed/sizes.py). */
export function meanRadius({ header }, { size_scale: scale, sizes }, group) {
  const bits = header.size_bits, first = group * GROUP, end = Math.min(first + GROUP, header.n_splats);
  if (!bits) return header.radius;
  let sum = 0;
  for (let splat = first; splat < end; ++splat) {
    const chunk = (splat / CHUNK) | 0, bit = (splat % CHUNK) * bits, at = chunk * 4 * bits + (bit >> 5), shift = bit & 31;
    const code = ((sizes[at] >>> shift) | (shift + bits > 32 ? sizes[at + 1] << (32 - shift) : 0)) & ((1 << bits) - 1);
    sum += header.radius * 2 ** ((scale[2 * chunk] + ((scale[2 * chunk + 1] - scale[2 * chunk]) * code) / ((1 << bits) - 1) - 128) / 16);
  }
  return sum / (end - first);
}

/** Position, normal and, where it is bytes, colour of `n` splats side by side, as words; a spare one at the end where they are 5 bytes each. */
export function splatWords(n, { position, normal, color }) {
  const width = color ? 8 : 5, bytes = new Uint8Array(Math.ceil((n * width) / 4) * 4 + (color ? 0 : 4));
  for (let i = 0; i < n; ++i) {
    const at = i * width;
    for (let j = 0; j < 3; ++j) bytes[at + j] = position[3 * i + j];
    bytes[at + 3] = normal[2 * i];
    bytes[at + 4] = normal[2 * i + 1];
    if (color) for (let j = 0; j < 3; ++j) bytes[at + 5 + j] = color[3 * i + j];
  }
  return new Uint32Array(bytes.buffer);
}

/** Where an atom's texels lie: bands of the levels one below the other; mirrors renderer/splats/atlas.py. */
export function atlasLayout({ n_dictionary, atom_size, coarsest_size }) {
  const width = atom_size * Math.ceil(Math.sqrt(Math.max(1, n_dictionary))), bands = [];
  let height = 0;
  for (const size of MIP_SIZES) {
    bands.push(height);
    if (size <= atom_size && size >= coarsest_size) height += Math.ceil(Math.max(1, n_dictionary) / ((width / size) | 0)) * size;
  }
  return { width, height, bands };
}

/** Atoms (k, s, s, 3) of one level as rows of the atlas: (rows, width, 3) bytes. */
export function atlasBand(atoms, size, n, { width }) {
  const columns = (width / size) | 0, rows = Math.ceil(n / columns), band = new Int8Array(rows * size * width * 3);
  for (let atom = 0; atom < n; ++atom)
    for (let y = 0; y < size; ++y) {
      const from = (atom * size + y) * size * 3, to = (((((atom / columns) | 0) * size + y) * width) + (atom % columns) * size) * 3;
      band.set(atoms.subarray(from, from + size * 3), to);
    }
  return { rows: rows * size, band };
}
