// Atoms that ship with the program, of files that name them; mirrors storage/packed/dictionaries.

import { MIP_SIZES, promised } from "./packed.js";
import { decompress } from "./zstd.js";

const SIZE = 16, STEP = 2, TEXELS = SIZE * SIZE;

/** `atom_scale` and the levels `atoms_<s>` of `sizes` of the first `n_dictionary` atoms that `bytes`, a file of a dictionary, holds. */
export function shippedAtoms(bytes, { n_dictionary: n, shipped }, sizes) {
  const raw = decompress(bytes, promised(bytes)), all = raw.length / (3 * TEXELS + 4);
  if (!Number.isInteger(all) || n > all) throw new Error(`the dictionary ${shipped.slice(0, 16)} has ${all} atoms; the file names ${n}`);
  const planes = new Int8Array(raw.buffer, raw.byteOffset, 3 * all * TEXELS), finest = new Int8Array(n * TEXELS * 3);
  for (let i = 0; i < n * TEXELS; ++i) {
    const green = planes[i];
    finest[3 * i] = STEP * (planes[all * TEXELS + i] + green);
    finest[3 * i + 1] = STEP * green;
    finest[3 * i + 2] = STEP * (planes[2 * all * TEXELS + i] + green);
  }
  const found = { atom_scale: new Float32Array(raw.slice(planes.length, planes.length + 4 * n).buffer) };
  for (const size of MIP_SIZES.filter((s) => sizes.includes(s))) found[`atoms_${size}`] = means(finest, n, size);
  return found;
}

// Texels of a coarser level: means, halves to the even number.
function means(finest, n, size) {
  const factor = SIZE / size, level = new Int8Array(n * size * size * 3), row = SIZE * 3;
  for (let at = 0; at < level.length; ++at) {
    const c = at % 3, x = ((at / 3) | 0) % size, y = ((at / (3 * size)) | 0) % size, atom = (at / (3 * size * size)) | 0;
    let sum = 0;
    for (let dy = 0; dy < factor; ++dy)
      for (let dx = 0; dx < factor; ++dx) sum += finest[atom * TEXELS * 3 + (y * factor + dy) * row + (x * factor + dx) * 3 + c];
    const mean = sum / (factor * factor), low = Math.floor(mean);
    level[at] = mean - low === 0.5 ? low + (low & 1) : Math.round(mean);
  }
  return level;
}
