// A texture of 32-bit words, or of pairs of them, that `load` of the shaders reads: what storage buffers are elsewhere.

const LINE = 2048; // texels to a line, as renderer/splats/gles.py has it

export class Words {
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
