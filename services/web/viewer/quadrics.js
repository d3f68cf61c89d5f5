// Splats over quadrics: how many words their numbers take, and the frames of chunks as the shaders take them. Mirrors storage/packed/quadrics.py and
// renderer/splats/upload/tables.py; numbers are decoded by renderer/shaders/quadric.glsl alone.

import { CHUNK } from "./packed.js";

export const FRAMES = ["frame_origin", "frame_turn", "frame_step", "frame_cells", "frame_curve", "frame_bits", "normal_low", "normal_cells", "normal_slope", "normal_lean", "normal_grid"];
export const FRAME_WORDS = 8;
export const GROUP_WORDS = 5; // of the head of a group: its first word, where its box begins, the unit there
const LEAST_BITS = 16, TURN_W = 117;

// How many bits of its numbers a batch of n splats keeps in unary.
function highBits(n, bits) {
  let high = 0;
  while (high < bits - LEAST_BITS && 1 << high < n) ++high;
  return n * high > n + (1 << high) ? high : 0;
}

/** Bits of a chunk's numbers, of its splats of each batch. */
export function numberBits(counts, bits) {
  let sum = 0;
  for (const n of counts) {
    const high = highBits(n, bits);
    sum += n * (bits - high) + (high ? n + (1 << high) : 0);
  }
  return sum;
}

const floatOf = (upper) => new Float32Array(new Uint32Array([upper << 16]).buffer)[0];
const bytesWord = (a, b, c, d) => (a & 0xff) | ((b & 0xff) << 8) | ((c & 0xff) << 16) | (d << 24);

/** What origins of frames count in, of the sides of a group's box: the power of two of which the longest has 2^15 to 2^16. */
const originUnit = (sides) => 2 ** ((new Uint32Array(Float32Array.of(Math.max(...sides, 2 ** -100)).buffer)[0] >>> 23) - 142);

/** Where the box of a group begins, and the unit of origins in it, of the table of groups. */
export function originOf({ group_low: low, group_high: high }, group) {
  const at = [...low.subarray(3 * group, 3 * group + 3)];
  return [...at, originUnit(at.map((x, i) => high[3 * group + i] - x))];
}

/** The words of the frame of `chunk` at `at` of `words`; `first` is the bit where its numbers begin in its group. */
export function putFrame(words, at, chunk, arrays, first) {
  const of = (name, width) => arrays[name].subarray(chunk * width, (chunk + 1) * width);
  const turn = of("frame_turn", 3), curve = of("frame_curve", 3), [u, v] = of("frame_cells", 2).map((n) => n - 1), many = of("normal_cells", 2);
  const low = of("normal_low", 2), slope = of("normal_slope", 4);
  const grid = arrays.normal_grid[chunk], origin = of("frame_origin", 3), lean = arrays.normal_lean[chunk] & 0xff;
  words[at] = origin[0] | (origin[1] << 16);
  words[at + 1] = origin[2] | (arrays.frame_step[chunk] << 16);
  words[at + 2] = bytesWord(...turn, (arrays.frame_bits[chunk] - LEAST_BITS) | ((grid & 7) << 5));
  words[at + 3] = bytesWord(...curve, (u >> 8) | ((v >> 8) << 4));
  words[at + 4] = (u & 0xff) | ((v & 0xff) << 8);
  words[at + 5] = bytesWord(...slope);
  words[at + 6] = (low[0] + 256) | ((low[1] + 256) << 9) | (lean << 18) | ((first >>> 16) << 26) | ((grid >> 3) << 31);
  words[at + 7] = many[0] | (many[1] << 8) | ((first & 0xffff) << 16);
}

// How many values codes of sizes have in a chunk, the lowest digit of its numbers.
const sizesOf = ({ size_scale: scale }, chunk) => (scale ? Math.min(16, 1 + Math.ceil((8 * (scale[2 * chunk + 1] - scale[2 * chunk])) / 15)) : 1);

/** Low corners and sizes (nChunks, 3) against the origin of boxes that hold all cells that numbers of each chunk can name; `begin` is where the
 *  group's box begins, and the unit of origins. */
export function frameBoxes(arrays, nChunks, begin) {
  const box_low = new Float32Array(3 * nChunks), box_size = new Float32Array(3 * nChunks);
  for (let chunk = 0; chunk < nChunks; ++chunk) {
    const [u, v] = arrays.frame_cells.subarray(2 * chunk, 2 * chunk + 2), [a, b, c] = arrays.frame_curve.subarray(3 * chunk, 3 * chunk + 3);
    const states = u * v * (arrays.normal_cells[2 * chunk] + 1) * (arrays.normal_cells[2 * chunk + 1] + 1) * sizesOf(arrays, chunk);
    const unit = 2 ** -(39 - Math.clz32(Math.max(u, v))), rise = (Math.abs(a) * u * u + Math.abs(b) * u * v + Math.abs(c) * v * v) * unit;
    const [x, y, z] = arrays.frame_turn.subarray(3 * chunk, 3 * chunk + 3), s = 2 / (x * x + y * y + z * z + TURN_W ** 2), w = TURN_W;
    const rows = [ // images of U, V and N
      [1 - s * (y * y + z * z), s * (x * y + z * w), s * (x * z - y * w)],
      [s * (x * y - z * w), 1 - s * (x * x + z * z), s * (y * z + x * w)],
      [s * (x * z + y * w), s * (y * z - x * w), 1 - s * (x * x + y * y)],
    ];
    const spans = [[0, u], [0, v], [-rise, 2 ** arrays.frame_bits[chunk] / states + rise]], step = floatOf(arrays.frame_step[chunk]);
    for (let axis = 0; axis < 3; ++axis) {
      let low = 0, high = 0;
      spans.forEach((ends, i) => {
        const reached = ends.map((end) => end * rows[i][axis] * step);
        low += Math.min(...reached);
        high += Math.max(...reached);
      });
      box_low[3 * chunk + axis] = begin[axis] + begin[3] * arrays.frame_origin[3 * chunk + axis] + low;
      box_size[3 * chunk + axis] = high - low;
    }
  }
  return { box_low, box_size };
}

/** Where the numbers of each chunk of a group begin, in bits. */
export function firstNumbers({ batch_count: counts, frame_bits: bits }, nSplats, nBatches) {
  const found = new Uint32Array(Math.ceil(nSplats / CHUNK));
  for (let chunk = 1; chunk < found.length; ++chunk)
    found[chunk] = found[chunk - 1] + numberBits(counts.subarray((chunk - 1) * nBatches, chunk * nBatches), bits[chunk - 1]);
  return found;
}
