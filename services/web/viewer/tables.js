// What is derived of groups as they arrive: running counts of batches, where streams begin, boxes. Mirrors renderer/splats/upload/tables.py.

import { CHUNK } from "./packed.js";
import { FRAME_WORDS, firstNumbers, putFrame } from "./quadrics.js";

const LONGEST_ELLIPSOID = 4; // half axis in radii that a byte can say

// Words of a chunk's box or frame, before those of its colours.
const colorAt = (geometry) => (geometry === "quadrics" ? FRAME_WORDS : 7);

// Words of its splats' sizes, which numbers over quadrics have.
const sizeWords = (geometry, bits) => (geometry === "quadrics" ? 0 : 4 * bits);

/** Words that the tables take a chunk and a group. */
export const widthsOf = ({ size_bits, color_step, batches, geometry }) =>
  ({ boxes: colorAt(geometry) + (color_step ? 4 : 0) + sizeWords(geometry, size_bits), running: batches.length - 1, groups: 2 + 2 * batches.length });

/**
 * Tables of the chunks of a group by its arrays, as the shaders take them: `boxes` and `running` words, its row of `groups`, and the `counts` of
 * splats of each batch. `first` are the words that each of its streams begins at.
 */
export function tablesOf(header, arrays, nSplats, first) {
  const nBatches = header.batches.length, nChunks = Math.ceil(nSplats / CHUNK), counts = new Uint32Array(nBatches);
  for (let i = 0; i < nChunks * nBatches; ++i) counts[i % nBatches] += arrays.batch_count[i];
  return { counts, boxes: boxWords(header, arrays, nSplats, first.colors), running: runningCounts(arrays.batch_count, nChunks, nBatches),
    groups: groupRow(header, counts, first) };
}

/** The radius that a step of `size_scale` stands for. */
const radiusOf = (header, step) => header.radius * 2 ** (step / 16 - 8);

// Low corner, size, bits and scale of sizes of each chunk's box, where colours are in boxes first word, low corner, size and turn of those, and
// where splats have sizes their words.
function boxWords(header, arrays, nSplats, colorWord) {
  const ofFrames = header.geometry === "quadrics", at0 = colorAt(header.geometry), sizeAt = at0 + (header.color_step ? 4 : 0), perChunk = sizeWords(header.geometry, header.size_bits), width = sizeAt + perChunk, nChunks = Math.ceil(nSplats / CHUNK);
  const words = new Uint32Array(nChunks * width), floats = new Float32Array(words.buffer);
  const numbers = ofFrames && firstNumbers(arrays, nSplats, header.batches.length);
  for (let chunk = 0; chunk < nChunks; ++chunk) {
    const at = chunk * width, i = 3 * chunk;
    if (ofFrames) {
      putFrame(words, at, chunk, arrays, numbers[chunk]);
    } else {
      floats.set(arrays.box_low.subarray(i, i + 3), at);
      floats.set(arrays.box_size.subarray(i, i + 3), at + 3);
      words[at + 6] = arrays.box_bits[i] | (arrays.box_bits[i + 1] << 8);
    }
    if (header.size_bits) {
      words[at + (ofFrames ? 4 : 6)] |= (arrays.size_scale[2 * chunk] << 16) | (arrays.size_scale[2 * chunk + 1] << 24);
      if (!ofFrames) words.set(arrays.sizes.subarray(chunk * perChunk, (chunk + 1) * perChunk), at + sizeAt);
    }
    if (!header.color_step) continue;
    const [low, size, turn] = [arrays.color_low, arrays.color_size, arrays.color_turn].map((rows) => rows.subarray(i, i + 3));
    const bits = [...size].reduce((sum, s) => sum + Math.max(0, Math.ceil((s - header.color_step) / 16)), 0);
    words[at + at0] = colorWord;
    words[at + at0 + 1] = (low[0] & 0xffff) | (low[1] << 16);
    words[at + at0 + 2] = (low[2] & 0xffff) | (size[0] << 16) | (size[1] << 24);
    words[at + at0 + 3] = size[2] | ((turn[0] & 0xff) << 8) | ((turn[1] & 0xff) << 16) | (turn[2] << 24);
    colorWord += Math.ceil((Math.min(CHUNK, nSplats - chunk * CHUNK) * bits) / 32);
  }
  return words;
}

// For each chunk and each batch but the last: splats of its group, through this chunk, of the batches up to this one; two a word.
function runningCounts(batchCount, nChunks, nBatches) {
  const width = nBatches - 1, halves = new Uint16Array((nChunks * width + 1) & ~1), through = new Uint32Array(nBatches);
  for (let chunk = 0; chunk < nChunks; ++chunk) {
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
function groupRow({ batches }, counts, first) {
  const row = new Uint32Array(2 + 2 * batches.length);
  row[0] = first.codes ?? 0;
  row[1] = first.cliplines ?? 0;
  let entry = 0, line = 0, ellipsoid = first.ellipsoids ?? 0;
  batches.forEach((batch, i) => {
    row[2 + 2 * i] = entry;
    row[3 + 2 * i] = batch.ellipsoid ? ellipsoid : line;
    entry += counts[i] * batch.n_atoms;
    if (batch.clipline) line += counts[i];
    if (batch.ellipsoid) ellipsoid += counts[i];
  });
  return row;
}

/** (nGroups, 6) low and high corner against the origin, grown by what splats reach, by the table of groups. */
export function groupBoxes({ header, nGroups }, { group_low: low, group_high: high, group_radius: radius }) {
  const boxes = new Float64Array(nGroups * 6), longest = header.batches.some((b) => b.ellipsoid) ? LONGEST_ELLIPSOID : 1;
  for (let group = 0; group < nGroups; ++group)
    for (let axis = 0; axis < 3; ++axis) {
      boxes[6 * group + axis] = low[3 * group + axis] - longest * radius[2 * group + 1];
      boxes[6 * group + 3 + axis] = high[3 * group + axis] + longest * radius[2 * group + 1];
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
