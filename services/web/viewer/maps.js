// The maps of laser stations in GPU memory: mirrors pipeline/maps/stored.py and renderer/splats/upload/maps.py.

const MIP_LEVELS = 5;
const FRAME_WORDS = 9;
const SMALLEST_LOOKED_UP_PX = 2.5, GROWTH = 2; // shaders/looked_up.glsl; and detail.glsl, of splats that stand in for finer ones

/** Whether a view may look any splat of a group up in its map, by the group's box and largest splat. */
export function isLookedUp({ groupBoxes, largest }, group, { rotation: [, , ahead], eye, fx, fy }) {
  const at = 6 * group, nearest = ahead.reduce((sum, x, i) => sum + x * (groupBoxes[at + (x > 0 ? i : 3 + i)] - eye[i]), 0);
  return largest[2 * group + 1] * GROWTH * Math.max(fx, fy) >= SMALLEST_LOOKED_UP_PX * nearest;
}

/** For each map: its station against the origin as two floats, height, 1 / nearest, codes an e-fold. */
export function mapFrames({ maps, origin }) {
  const frames = new Float32Array(FRAME_WORDS * maps.length);
  maps.forEach((map, i) => {
    const centre = map.centre.map((x, axis) => x - origin[axis]), high = centre.map(Math.fround), at = FRAME_WORDS * i;
    frames.set([...high, ...centre.map((x, axis) => x - high[axis]), map.height_px, 1 / map.nearest, 1 / map.depth_step], at);
  });
  return new Uint32Array(frames.buffer);
}

/** Textures of all maps from their arrays. */
export async function mapTextures(gl, { maps }, { map_colors: colors, map_depth_low: low, map_depth_high: high }) {
  const height = Math.max(...maps.map((map) => map.height_px));
  if (3 * height > gl.getParameter(gl.MAX_TEXTURE_SIZE) || maps.length > gl.getParameter(gl.MAX_ARRAY_TEXTURE_LAYERS))
    throw new Error(`this file has ${maps.length} maps of up to ${3 * height} texels to a side; this device has no textures so large`);
  const made = { map_colors: textureOf(gl, gl.RGBA8, 3 * height, 3 * height, maps.length), map_depths: textureOf(gl, gl.R16UI, 3 * height, 2 * height, maps.length) };
  let atColor = 0, atTexel = 0;
  for (const [layer, { height_px: h, color_bytes: bytes }] of maps.entries()) {
    const codes = decodeCodes(low, high, atTexel, h), pixels = await decodeColors(colors.slice(atColor, atColor + bytes), h);
    atColor += bytes;
    atTexel += 6 * h * h;
    put(gl, made.map_depths, [0, 0, layer], inSquares(codes, h, 1), h, gl.RED_INTEGER, gl.UNSIGNED_SHORT);
    let level = { colors: Float32Array.from(pixels), height: h };
    for (let i = 0; i < codes.length; ++i) level.colors[4 * i + 3] = codes[i] ? 255 : 0;
    for (let i = 0; i < MIP_LEVELS; ++i) {
      if (i) level = halved(level);
      const corner = i ? [3 * h - ((3 * h) >> (i - 1)), 2 * h, layer] : [0, 0, layer];
      put(gl, made.map_colors, corner, inSquares(Uint8Array.from(level.colors, Math.round), level.height, 4), level.height, gl.RGBA, gl.UNSIGNED_BYTE);
    }
  }
  return { ...made, bytes: maps.length * height * height * (9 * 4 + 6 * 2) };
}

function textureOf(gl, format, width, height, layers) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
  gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, format, width, height, layers);
  for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D_ARRAY, side, gl.NEAREST);
  return texture;
}

function put(gl, texture, corner, values, height, format, type) {
  gl.bindTexture(gl.TEXTURE_2D_ARRAY, texture);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, ...corner, 3 * height, 2 * height, 1, format, type, values);
}

/** Depth codes (h, 6 h): each row's are stored as what they are above those of the row before. */
export function decodeCodes(low, high, first, h) {
  const width = 6 * h, codes = new Uint16Array(width * h);
  for (let i = 0; i < codes.length; ++i) {
    const folded = low[first + i] | (high[first + i] << 8);
    codes[i] = ((folded >> 1) ^ -(folded & 1)) + (i < width ? 0 : codes[i - width]);
  }
  return codes;
}

// RGBA bytes (h, 6 h, 4) of a WebP picture; the browser decodes it.
async function decodeColors(bytes, h) {
  const picture = await createImageBitmap(new Blob([bytes], { type: "image/webp" }), { colorSpaceConversion: "none", premultiplyAlpha: "none" });
  if (picture.width !== 6 * h || picture.height !== h) throw new Error(`a map of ${picture.width} x ${picture.height} pixels, not ${6 * h} x ${h}`);
  const canvas = Object.assign(document.createElement("canvas"), { width: 6 * h, height: h });
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(picture, 0, 0);
  picture.close();
  return context.getImageData(0, 0, 6 * h, h).data;
}

// Means of 2 x 2 texels, weighted by their alpha, the share that shows a surface.
function halved({ colors, height }) {
  const width = 6 * height, half = height / 2, made = new Float32Array(4 * 6 * half * half);
  for (let y = 0; y < half; ++y)
    for (let x = 0; x < 6 * half; ++x) {
      const to = 4 * (y * 6 * half + x), from = 4 * (2 * y * width + 2 * x);
      let weight = 0;
      for (const at of [from, from + 4, from + 4 * width, from + 4 * width + 4]) {
        for (let k = 0; k < 3; ++k) made[to + k] += colors[at + k] * colors[at + 3];
        weight += colors[at + 3];
      }
      for (let k = 0; k < 3; ++k) made[to + k] /= Math.max(weight, 1e-9);
      made[to + 3] = weight / 4;
    }
  return { colors: made, height: half };
}

/** A map (h, 6 h, k) as its six squares, three in a row. */
function inSquares(values, h, k) {
  const made = new values.constructor(values.length), row = 3 * h * k;
  for (let y = 0; y < h; ++y)
    for (let half = 0; half < 2; ++half) made.set(values.subarray((2 * y + half) * row, (2 * y + half + 1) * row), (half * h + y) * row);
  return made;
}
