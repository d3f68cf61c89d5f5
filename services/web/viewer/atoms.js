// The dictionary in GPU memory: an atlas of all atoms at all of their mip levels, and what weight codes stand for. Mirrors renderer/splats/atlas.py.

import { MIP_SIZES } from "./packed.js";
import { shippedAtoms } from "./shipped.js";
import { Words } from "./words.js";

/** Where an atom's texels lie: bands of the levels one below the other. */
export function atlasLayout({ n_dictionary, atom_size, coarsest_size }) {
  const width = atom_size * Math.ceil(Math.sqrt(Math.max(1, n_dictionary))), bands = [];
  let height = 0;
  for (const size of MIP_SIZES) {
    bands.push(height);
    if (size <= atom_size && size >= coarsest_size) height += Math.ceil(Math.max(1, n_dictionary) / ((width / size) | 0)) * size;
  }
  return { width, height, bands };
}

/** The texture of the atlas, and the words of `weights`. */
export async function loadAtoms(gl, packed, layout) {
  const { header } = packed, sizes = MIP_SIZES.filter((s) => s <= header.atom_size && s >= header.coarsest_size);
  const own = header.shipped ? [] : ["atom_scale", ...sizes.map((s) => `atoms_${s}`)];
  const found = await packed.readWhole(["weight_levels", ...own]);
  if (header.shipped) Object.assign(found, shippedAtoms(await packed.source.dictionary(header.shipped), header, sizes));
  const levels = header.n_ranks << header.weight_bits, floats = new Float32Array(levels + header.n_dictionary);
  floats.set(found.weight_levels.subarray(0, levels));
  floats.set(found.atom_scale.subarray(0, header.n_dictionary), levels);
  const weights = new Words(gl, floats.length).put(0, new Uint32Array(floats.buffer));
  if (Math.max(layout.width, layout.height) > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("a dictionary too large for this device");
  const atlas = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, atlas);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGB8_SNORM, layout.width, layout.height);
  for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.LINEAR);
  for (const side of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, side, gl.CLAMP_TO_EDGE);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  for (const size of sizes) {
    const { rows, band } = atlasBand(found[`atoms_${size}`], size, header.n_dictionary, layout);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, layout.bands[MIP_SIZES.indexOf(size)], layout.width, rows, gl.RGB, gl.BYTE, band);
  }
  return { weights, atlas };
}

// Atoms (k, s, s, 3) of one level as rows of the atlas: (rows, width, 3) bytes.
function atlasBand(atoms, size, n, { width }) {
  const columns = (width / size) | 0, rows = Math.ceil(n / columns), band = new Int8Array(rows * size * width * 3);
  for (let atom = 0; atom < n; ++atom)
    for (let y = 0; y < size; ++y) {
      const from = (atom * size + y) * size * 3, to = (((((atom / columns) | 0) * size + y) * width) + (atom % columns) * size) * 3;
      band.set(atoms.subarray(from, from + size * 3), to);
    }
  return { rows: rows * size, band };
}
