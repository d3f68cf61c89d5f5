// Zstandard frames into bytes (RFC 8878), for browsers that cannot do it themselves: one frame without dictionary that states its size.
// Sections named below are the RFC's.

const LITERAL_LENGTHS = codes([[16, 0], [4, 1], [2, 2], [2, 3], [1, 4], ...[6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16].map((bits) => [1, bits])], 0);
const MATCH_LENGTHS = codes([[32, 0], [4, 1], [2, 2], [2, 3], [2, 4], [1, 5], ...[7, 8, 9, 10, 11, 12, 13, 14, 15, 16].map((bits) => [1, bits])], 3);
const repeat = (n, value) => Array(n).fill(value);
// Default distributions, 3.1.1.3.2.2: accuracy, then probabilities of symbols.
const DEFAULTS = [
  [6, [4, 3, ...repeat(11, 2), 1, 1, 1, ...repeat(9, 2), 3, 2, ...repeat(5, 1), ...repeat(4, -1)]],
  [5, [...repeat(6, 1), 2, 2, 2, ...repeat(15, 1), ...repeat(5, -1)]],
  [6, [1, 4, 3, ...repeat(6, 2), ...repeat(37, 1), ...repeat(7, -1)]],
].map(([accuracy, probabilities]) => decodingTable(accuracy, probabilities));
const MOST_ACCURACY = [9, 8, 9], MOST_SYMBOL = [35, 31, 52]; // of literal lengths, offsets, match lengths

// Baselines and extra bits of length codes, 3.1.1.3.2.1.1, from runs of codes with the same number of bits.
function codes(runs, first) {
  const base = [], bits = [];
  for (const [n, width] of runs) for (let i = 0; i < n; ++i, first += 1 << width) base.push(first), bits.push(width);
  return { base, bits };
}

function refuse(why) {
  throw new Error("damaged zstd frame: " + why);
}

// FSE decoding table, 4.1: for each state its symbol, the bits to read and the baseline of the next state.
function decodingTable(accuracy, probabilities) {
  const size = 1 << accuracy, symbol = new Uint8Array(size), bits = new Uint8Array(size), next = new Uint16Array(size);
  let high = size - 1;
  probabilities.forEach((p, s) => { if (p === -1) symbol[high--] = s; });
  const step = (size >> 1) + (size >> 3) + 3;
  let at = 0;
  probabilities.forEach((p, s) => {
    for (let i = 0; i < p; ++i) {
      symbol[at] = s;
      do at = (at + step) & (size - 1); while (at > high);
    }
  });
  const count = probabilities.map((p) => (p === -1 ? 1 : p));
  for (let i = 0; i < size; ++i) {
    const x = count[symbol[i]]++;
    bits[i] = accuracy - (31 - Math.clz32(x));
    next[i] = (x << bits[i]) - size;
  }
  return { accuracy, symbol, bits, next };
}

class Frame {
  constructor(source) {
    this.bytes = new Uint8Array(source.length + 8); // spare bytes, so that four may always be loaded at once
    this.bytes.set(source);
    this.view = new DataView(this.bytes.buffer);
    this.end = source.length;
    this.out = null; // allocated once the size is right
    this.at = this.made = 0;
    this.offsets = [1, 4, 8];
    this.tables = [null, null, null];
    this.huffman = null;
  }

  // Up to 25 bits from the bit `at` on; those before the frame are zeros.
  field(at, n) {
    if (at < 0) return n + at > 0 ? this.field(0, n + at) << -at : 0;
    return (this.view.getUint32(at >> 3, true) >>> (at & 7)) & ((1 << n) - 1);
  }

  need(n) {
    if (this.at + n > this.end) refuse("it ends early");
  }

  // A stream read from its end, 4.1: the bit just above it is its last set one.
  streamEnd(start, stop) {
    if (stop <= start || stop > this.end || !this.bytes[stop - 1]) refuse("a stream without an end");
    return 8 * stop - 1 - (Math.clz32(this.bytes[stop - 1]) - 24);
  }

  // Probabilities of an FSE table, 4.1.1; moves on to the byte behind them.
  probabilities(mostAccuracy, mostSymbol) {
    let bit = 8 * this.at;
    const accuracy = this.field(bit, 4) + 5, found = [];
    if (accuracy > mostAccuracy) refuse(`an accuracy of ${accuracy}`);
    bit += 4;
    for (let left = 1 << accuracy; left > 0;) {
      if (found.length > mostSymbol || bit > 8 * this.end) refuse("too many symbols");
      const width = 32 - Math.clz32(left + 1), half = (1 << (width - 1)) - 1, few = (1 << width) - 2 - left;
      let value = this.field(bit, width);
      if ((value & half) < few) {
        value &= half;
        bit += width - 1;
      } else {
        if (value > half) value -= few;
        bit += width;
      }
      found.push(value - 1);
      left -= Math.abs(value - 1);
      for (let more = value === 1 ? 3 : 0; more === 3;) {
        more = this.field(bit, 2);
        bit += 2;
        for (let i = 0; i < more; ++i) found.push(0);
      }
    }
    if (found.length > mostSymbol + 1) refuse("too many symbols");
    this.at = (bit + 7) >> 3;
    return decodingTable(accuracy, found);
  }

  // Huffman weights and the decoding table of them, 4.2.1.
  readHuffman() {
    this.need(1);
    const head = this.bytes[this.at++], weights = [];
    if (head >= 128) {
      this.need((head - 126) >> 1);
      for (let i = 0; i < head - 127; ++i) weights.push((this.bytes[this.at + (i >> 1)] >> (i & 1 ? 0 : 4)) & 15);
      this.at += (head - 126) >> 1;
    } else {
      this.need(head);
      this.readWeights(weights, this.at + head);
    }
    let total = weights.reduce((sum, w) => sum + (w ? 1 << (w - 1) : 0), 0);
    const most = 32 - Math.clz32(total), rest = (1 << most) - total;
    if (!total || most > 11 || rest & (rest - 1)) refuse("Huffman weights that do not add up");
    weights.push(32 - Math.clz32(rest));
    const symbol = new Uint8Array(1 << most), bits = new Uint8Array(1 << most);
    for (let weight = 1, at = 0; weight <= most; ++weight) {
      weights.forEach((w, s) => {
        if (w !== weight) return;
        symbol.fill(s, at, at + (1 << (w - 1)));
        bits.fill(most + 1 - w, at, (at += 1 << (w - 1)));
      });
    }
    this.huffman = { most, symbol, bits };
  }

  // Two states take turns until the stream has no bits left, 4.2.1.2.
  readWeights(weights, stop) {
    const start = this.at, table = this.probabilities(6, 255);
    let bit = this.streamEnd(this.at, stop);
    const low = 8 * this.at, states = [0, 0];
    for (let i = 0; i < 2; ++i) states[i] = this.field((bit -= table.accuracy), table.accuracy);
    for (let turn = 0; ; turn ^= 1) {
      if (weights.length > 254) refuse("too many Huffman weights");
      weights.push(table.symbol[states[turn]]);
      const n = table.bits[states[turn]];
      if (bit - n < low) {
        weights.push(table.symbol[states[turn ^ 1]]);
        break;
      }
      states[turn] = table.next[states[turn]] + this.field((bit -= n), n);
    }
    if (start > stop) refuse("Huffman weights beyond their end");
    this.at = stop;
  }

  huffmanStream(start, stop, target) {
    const { most, symbol, bits } = this.huffman, mask = (1 << most) - 1, view = this.view;
    let bit = this.streamEnd(start, stop) - most;
    for (let i = 0; i < target.length; ++i) {
      const code = (bit < 0 ? this.field(bit, most) : view.getUint32(bit >> 3, true) >>> (bit & 7)) & mask;
      target[i] = symbol[code];
      bit -= bits[code];
    }
    if (bit + most !== 8 * start) refuse("a Huffman stream of another length");
  }

  // 3.1.1.3.1
  literals() {
    this.need(1);
    const head = this.view.getUint32(this.at, true), kind = head & 3, format = (head >> 2) & 3;
    if (kind < 2) {
      const [bytes, skip] = [[1, 3], [2, 4], [1, 3], [3, 4]][format];
      const size = (head & (2 ** (8 * bytes) - 1)) >>> skip;
      this.at += bytes;
      const length = kind ? 1 : size;
      this.need(length);
      const found = kind ? new Uint8Array(size).fill(this.bytes[this.at]) : this.bytes.subarray(this.at, this.at + size);
      this.at += length;
      return found;
    }
    const width = [10, 10, 14, 18][format], bytes = [3, 3, 4, 5][format];
    this.need(bytes);
    const size = this.field(8 * this.at + 4, width), packed = this.field(8 * this.at + 4 + width, width);
    this.at += bytes;
    this.need(packed);
    const stop = this.at + packed, found = new Uint8Array(size);
    if (kind === 2) this.readHuffman();
    else if (!this.huffman) refuse("no Huffman table before");
    if (format === 0) this.huffmanStream(this.at, stop, found);
    else this.fourStreams(stop, found);
    this.at = stop;
    return found;
  }

  fourStreams(stop, found) {
    const part = (found.length + 3) >> 2;
    let start = this.at + 6;
    for (let i = 0; i < 4; ++i) {
      const end = i < 3 ? start + this.view.getUint16(this.at + 2 * i, true) : stop;
      if (end > stop) refuse("a stream beyond its section");
      this.huffmanStream(start, end, found.subarray(i * part, Math.min(found.length, (i + 1) * part)));
      start = end;
    }
  }

  // 3.1.1.3.2
  block(stop) {
    const literals = this.literals();
    this.need(1);
    let n = this.bytes[this.at++];
    if (n === 255) n = this.view.getUint16(this.at, true) + 0x7f00, this.at += 2;
    else if (n >= 128) n = ((n - 128) << 8) + this.bytes[this.at++];
    if (n) this.sequences(n, literals, stop);
    else this.put(literals);
    this.at = stop;
  }

  sequences(n, literals, stop) {
    const modes = this.bytes[this.at++];
    this.tables = this.tables.map((known, i) => this.tableOf((modes >> (6 - 2 * i)) & 3, known, i));
    const [lengths, offsets, matches] = this.tables;
    let bit = this.streamEnd(this.at, stop), taken = 0;
    const read = (width) => (bit -= width, width > 24 ? this.field(bit + 16, width - 16) * 65536 + this.field(bit, 16) : this.field(bit, width));
    let l = read(lengths.accuracy), o = read(offsets.accuracy), m = read(matches.accuracy);
    for (let i = 0; i < n; ++i) {
      const offsetBits = offsets.symbol[o], matchCode = matches.symbol[m], lengthCode = lengths.symbol[l];
      const value = 2 ** offsetBits + read(offsetBits);
      const length = MATCH_LENGTHS.base[matchCode] + read(MATCH_LENGTHS.bits[matchCode]);
      const before = LITERAL_LENGTHS.base[lengthCode] + read(LITERAL_LENGTHS.bits[lengthCode]);
      if (taken + before > literals.length) refuse("more literals than there are");
      this.put(literals.subarray(taken, (taken += before)));
      this.copy(this.offsetOf(value, before), length);
      if (i + 1 < n) {
        l = lengths.next[l] + read(lengths.bits[l]);
        m = matches.next[m] + read(matches.bits[m]);
        o = offsets.next[o] + read(offsets.bits[o]);
      }
    }
    if (bit !== 8 * this.at) refuse("sequences of another length");
    this.put(literals.subarray(taken));
  }

  tableOf(mode, known, i) {
    if (mode === 0) return DEFAULTS[i];
    if (mode === 2) return this.probabilities(MOST_ACCURACY[i], MOST_SYMBOL[i]);
    if (mode === 3) return known || refuse("no table before");
    const symbol = this.bytes[this.at++];
    if (symbol > MOST_SYMBOL[i]) refuse(`the code ${symbol}`);
    return { accuracy: 0, symbol: [symbol], bits: [0], next: [0] };
  }

  // Repeated offsets, 3.1.1.5.
  offsetOf(value, before) {
    const known = this.offsets;
    if (value > 3) {
      this.offsets = [value - 3, known[0], known[1]];
    } else {
      const which = value - 1 + (before === 0 ? 1 : 0);
      const offset = which < 3 ? known[which] : known[0] - 1;
      if (which > 0) this.offsets = which === 1 ? [offset, known[0], known[2]] : [offset, known[0], known[1]];
    }
    return this.offsets[0];
  }

  put(bytes) {
    if (this.made + bytes.length > this.out.length) refuse("more contents than promised");
    this.out.set(bytes, this.made);
    this.made += bytes.length;
  }

  copy(offset, length) {
    const { out } = this, stop = this.made + length;
    if (offset < 1 || offset > this.made || stop > out.length) refuse("a match outside the contents");
    if (offset >= length) out.copyWithin(this.made, this.made - offset, this.made - offset + length);
    else for (let i = this.made; i < stop; ++i) out[i] = out[i - offset];
    this.made = stop;
  }
}

/** The contents of a frame. `size`, what it must promise, is all that is ever allocated. Throws Error for anything else. */
export function decompress(source, size) {
  const frame = new Frame(source), { bytes, view } = frame;
  if (view.getUint32(0, true) !== 0xfd2fb528) refuse("another beginning");
  const descriptor = bytes[4], single = (descriptor >> 5) & 1, kind = descriptor >> 6;
  const start = 5 + (single ? 0 : 1) + [0, 1, 2, 4][descriptor & 3];
  const promised = kind === 0 ? (single ? bytes[start] : -1) : kind === 1 ? view.getUint16(start, true) + 256
    : view.getUint32(start, true) + (kind === 3 ? view.getUint32(start + 4, true) * 2 ** 32 : 0);
  if (promised !== size) refuse(`contents of ${promised} bytes, not ${size}`);
  frame.out = new Uint8Array(size);
  frame.at = start + [single, 2, 4, 8][kind];
  for (let last = 0; !last;) {
    frame.need(3);
    const head = view.getUint32(frame.at, true) & 0xffffff, length = head >> 3;
    frame.at += 3;
    last = head & 1;
    switch ((head >> 1) & 3) {
      case 0:
        frame.need(length);
        frame.put(bytes.subarray(frame.at, (frame.at += length)));
        break;
      case 1:
        frame.need(1);
        if (frame.made + length > size) refuse("more contents than promised");
        frame.out.fill(bytes[frame.at++], frame.made, (frame.made += length));
        break;
      case 2:
        frame.need(length);
        frame.block(frame.at + length);
        break;
      default:
        refuse("a block of no kind");
    }
  }
  if (frame.made !== size) refuse(`${frame.made} bytes, not ${size}`);
  return frame.out;
}
