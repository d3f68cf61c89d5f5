// Runs of cells of a hexagonal close packed grid into positions and normals, a group at a time, bit by bit as pipeline/geometry/runs/codes.py decodes them.

import { CHUNK } from "./packed.js";

const RISE = [0, 1, 1, 0, -1, -1]; // rows, by direction
const { fround } = Math;

/**
 * A group of `n` splats by its arrays, of which `rows` count: four words a splat, x, y, z as floats, a word of normal; and boxes of its chunks, as a
 * file of boxes has them.
 */
export function decodeRuns({ runs: grid }, codebook, arrays, rows, n) {
  const splats = new Uint32Array(4 * n), place = new Float32Array(splats.buffer), splatOf = placesOf(arrays.run_batch, n);
  const turn = grid.turn.map(fround), { run_first: first, run_base: base, run_step: steps } = arrays;
  const pitch = [fround(grid.cell / 2), fround((grid.cell * (Math.sqrt(3) / 2)) / 3), fround(grid.cell * Math.sqrt(2 / 3))], at = [0, 0, 0];
  let cell = 0, step = 0, section = 0;
  for (let run = 0; run < rows.run_start; ++run) {
    while (section + 1 < rows.run_first && first[section + 1] <= run) ++section;
    const word = arrays.run_start[run], length = (word >>> 27) + 1;
    if (cell + length > n) throw new Error(`a group whose runs have more cells than its ${n} splats`);
    let column = base[3 * section] + (word & 2047), row = base[3 * section + 1] + ((word >>> 11) & 2047), a = arrays.run_normal[2 * run];
    const slice = base[3 * section + 2] + ((word >>> 22) & 31);
    let b = arrays.run_normal[2 * run + 1], direction = 0;
    for (let i = 0; i < length; ++i, ++cell) {
      if (i) {
        const code = steps[step++], odd = (row ^ slice) & 1, entry = 2 * (code >> 3);
        direction = (direction + (code & 7)) % 6;
        column += direction === 0 ? 1 : direction === 3 ? -1 : direction === 1 || direction === 5 ? odd : odd - 1;
        row += RISE[direction];
        a += codebook[entry], b += codebook[entry + 1];
        if (Math.abs(a) > 127) a = (a > 0 ? 254 : -254) - a, b = -b;
        if (Math.abs(b) > 127) b = (b > 0 ? 254 : -254) - b, a = -a;
      }
      at[0] = fround((2 * column + ((row ^ slice) & 1)) * pitch[0]), at[1] = fround((3 * row + (slice & 1)) * pitch[1]), at[2] = fround(slice * pitch[2]);
      const to = 4 * splatOf(cell);
      for (let axis = 0; axis < 3; ++axis) {
        const k = 3 * axis;
        place[to + axis] = fround(fround(fround(turn[k] * at[0]) + fround(turn[k + 1] * at[1])) + fround(turn[k + 2] * at[2]));
      }
      splats[to + 3] = (a & 255) | ((b & 255) << 8);
    }
  }
  if (cell !== n) throw new Error(`a group whose runs have ${cell} cells for its ${n} splats`);
  return { splats, ...boxesOf(place, n) };
}

// The splat that a cell is: those of a chunk stand by batch, as they stood within it.
function placesOf(batch, n) {
  if (!batch) return (cell) => cell;
  const places = new Uint32Array(n);
  for (let begin = 0; begin < n; begin += CHUNK) {
    const cells = Array.from({ length: Math.min(CHUNK, n - begin) }, (_, i) => begin + i).sort((a, b) => batch[a] - batch[b] || a - b);
    cells.forEach((cell, i) => { places[cell] = begin + i; });
  }
  return (cell) => places[cell];
}

function boxesOf(place, n) {
  const nChunks = Math.ceil(n / CHUNK);
  const low = new Float32Array(3 * nChunks).fill(Infinity), high = new Float32Array(3 * nChunks).fill(-Infinity), size = new Float32Array(3 * nChunks);
  for (let splat = 0; splat < n; ++splat)
    for (let axis = 0, to = 3 * Math.floor(splat / CHUNK); axis < 3; ++axis, ++to) {
      low[to] = Math.min(low[to], place[4 * splat + axis]);
      high[to] = Math.max(high[to], place[4 * splat + axis]);
    }
  size.forEach((_, i) => { size[i] = high[i] - low[i]; });
  return { box_low: low, box_size: size, box_bits: new Uint8Array(3 * nChunks) };
}
