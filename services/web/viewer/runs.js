// Runs of cells of a hexagonal close packed grid into positions and normals, a group at a time, bit by bit as docs/FORMAT.md has it ("Runs", "Codes of runs").

import { CHUNK } from "./packed.js";
import { RangeReader, SIGNED } from "./range_coder.js";

const RISE = [0, 1, 1, 0, -1, -1]; // rows, by direction
const BASE_BITS = 22, MOST_INDEX = 1 << 20;
const LENGTH = 4, SLICE = LENGTH + 32, ROW = SLICE + 32, COLUMN = ROW + 2 * SIGNED, A = COLUMN + 4 * SIGNED, B = A + 256, TURN = B + 8 * 256; // models; those of bases are 0 to 2
const STEP = TURN + 64 * 8, N_MODELS = STEP + 32 * 32;
const { fround } = Math;
const signed = (byte) => (byte << 24) >> 24;

/**
 * A group of `n` splats from the bytes of its runs and, where there are several batches, the batch of each cell: four words a splat, x, y, z as
 * floats, a word of normal; and boxes of its chunks, as a file of boxes has them.
 */
export function decodeRuns({ runs: grid }, codebook, bytes, batch, n) {
  const splats = new Uint32Array(4 * n), place = new Float32Array(splats.buffer), splatOf = placesOf(batch, n), reader = new RangeReader(bytes, N_MODELS);
  const put = placing(grid, place), base = [0, 0, 0], field = [0, 0, 0];
  let cell = 0;
  while (cell < n) {
    for (let axis = 0; axis < 3; ++axis) if (reader.bit(axis)) base[axis] = reader.even(BASE_BITS) - MOST_INDEX;
    for (let run = reader.even(8); run >= 0; --run) {
      const length = reader.tree(LENGTH, 5) + 1, rise = reader.tree(SLICE, 5), ofRow = reader.signed(ROW + (rise ? 0 : SIGNED));
      if (cell + length > n) throw new Error(`a group whose runs have more cells than its ${n} splats`);
      field[2] = (field[2] + rise) & 31;
      field[1] = (field[1] + ofRow) & 2047;
      field[0] = (field[0] + reader.signed(COLUMN + (rise ? 0 : (1 + Math.min(2, Math.abs(ofRow))) * SIGNED))) & 2047;
      const byte = reader.tree(A, 8);
      let [column, row, slice] = field.map((x, axis) => x + base[axis]), a = signed(byte), b = signed(reader.tree(B + 256 * (byte >> 5), 8));
      for (let i = 0, direction = 0, turns = 0, step = 0; i < length; ++i, ++cell) {
        if (i) {
          const turn = reader.tree(TURN + 8 * turns, 3), odd = (row ^ slice) & 1;
          step = reader.tree(STEP + 32 * step, 5);
          turns = ((turns << 3) | turn) & 63;
          direction = (direction + turn) % 6;
          column += direction === 0 ? 1 : direction === 3 ? -1 : direction === 1 || direction === 5 ? odd : odd - 1;
          row += RISE[direction];
          a += codebook[2 * step], b += codebook[2 * step + 1];
          if (Math.abs(a) > 127) a = (a > 0 ? 254 : -254) - a, b = -b;
          if (Math.abs(b) > 127) b = (b > 0 ? 254 : -254) - b, a = -a;
        }
        const to = 4 * splatOf(cell);
        put(to, column, row, slice);
        splats[to + 3] = (a & 255) | ((b & 255) << 8);
      }
    }
  }
  if (reader.at !== bytes.length) throw new Error(`runs of ${bytes.length} bytes, of which their cells take ${reader.at}`);
  return { splats, ...boxesOf(place, n) };
}

// Puts the centre of a cell against the origin, each product and each sum rounded to float32.
function placing({ cell, turn }, place) {
  const pitch = [fround(cell / 2), fround((cell * (Math.sqrt(3) / 2)) / 3), fround(cell * Math.sqrt(2 / 3))], rows = turn.map(fround);
  return (to, column, row, slice) => {
    const x = fround((2 * column + ((row ^ slice) & 1)) * pitch[0]), y = fround((3 * row + (slice & 1)) * pitch[1]), z = fround(slice * pitch[2]);
    for (let axis = 0, k = 0; axis < 3; ++axis, k += 3)
      place[to + axis] = fround(fround(fround(rows[k] * x) + fround(rows[k + 1] * y)) + fround(rows[k + 2] * z));
  };
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
