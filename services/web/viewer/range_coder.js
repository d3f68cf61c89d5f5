// Numbers out of bytes by adaptive models under a range coder (docs/FORMAT.md, "Codes of runs").

const MODEL_BITS = 12, RATE = 4, TOP = 2 ** 24;
export const SIGNED = 80; // models of a signed number: how many bits it has, its sign, its second and its third bit
const SIGN = 16, SECOND = 32, THIRD = 48;

export class RangeReader {
  /** `models` are numbered by the caller. Bytes beyond the end are 0; `at` tells how many were taken. */
  constructor(bytes, nModels) {
    Object.assign(this, { bytes, at: 0, code: 0, range: 0xffffffff, models: new Uint16Array(nModels).fill(1 << (MODEL_BITS - 1)) });
    for (let i = 0; i < 4; ++i) this.code = this.code * 256 + this.next();
  }

  next() {
    return this.at < this.bytes.length ? this.bytes[this.at++] : (this.at++, 0);
  }

  fill() {
    for (; this.range < TOP; this.range *= 256) this.code = this.code * 256 + this.next();
  }

  bit(model) {
    const p = this.models[model], bound = (this.range >>> MODEL_BITS) * p, bit = this.code < bound ? 0 : 1;
    if (bit) this.code -= bound, this.range -= bound, this.models[model] = p - (p >> RATE);
    else this.range = bound, this.models[model] = p + (((1 << MODEL_BITS) - p) >> RATE);
    this.fill();
    return bit;
  }

  even(bits) {
    let value = 0;
    for (let i = 0; i < bits; ++i) {
      this.range = this.range >>> 1;
      const bit = this.code < this.range ? 0 : 1;
      if (bit) this.code -= this.range;
      value = 2 * value + bit;
      this.fill();
    }
    return value;
  }

  tree(base, bits) {
    let node = 1;
    for (let i = 0; i < bits; ++i) node = 2 * node + this.bit(base + node);
    return node - (1 << bits);
  }

  signed(base) {
    const n = this.tree(base, 4);
    if (!n) return 0;
    const isNegative = this.bit(base + SIGN + n);
    let size = 1;
    if (n > 1) size = 2 + this.bit(base + SECOND + n);
    if (n > 2) size = 2 * size + this.bit(base + THIRD + 2 * n + (size & 1));
    if (n > 3) size = size * 2 ** (n - 3) + this.even(n - 3);
    return isNegative ? -size : size;
  }
}
