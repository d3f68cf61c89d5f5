// The members of a packed file: a zip in which all are stored as they are, without extra fields (docs/FORMAT.md, "The zip").

const TAIL_BYTES = 1 << 15;
const SEAL = "splatpress sha256 ";
const SEAL_BYTES = 82, END_BYTES = 22, LOCATOR_BYTES = 20, END64_BYTES = 56;
const LARGEST_GAP = 1 << 16; // rather than another request
const MOST_AT_ONCE = 4;

/** Every member's name with where its bytes start and stop. Asks for the end of the file, and the rest of a long directory. */
export async function readDirectory(source) {
  const tail = await source.tail(TAIL_BYTES), view = viewOf(tail);
  const end = tail.length - SEAL_BYTES - END_BYTES;
  if (end < 0 || text(tail.subarray(end + END_BYTES, end + END_BYTES + SEAL.length)) !== SEAL || view.getUint32(end, true) !== 0x06054b50)
    throw new Error("no packed file, or a truncated one: it does not end in a seal");
  let count = view.getUint16(end + 10, true), size = view.getUint32(end + 12, true), offset = view.getUint32(end + 16, true);
  let stop = source.size - SEAL_BYTES - END_BYTES;
  if (end >= LOCATOR_BYTES + END64_BYTES && view.getUint32(end - LOCATOR_BYTES, true) === 0x07064b50) {
    const at = end - LOCATOR_BYTES - END64_BYTES;
    [count, size, offset] = [32, 40, 48].map((field) => Number(view.getBigUint64(at + field, true)));
    stop -= LOCATOR_BYTES + END64_BYTES;
  }
  if (offset + size !== stop) throw new Error("a zip whose directory does not end where it should");
  let directory = tail.subarray(Math.max(0, offset - (source.size - tail.length)), tail.length - (source.size - stop));
  if (directory.length < size) directory = await readSpan(source, offset, stop);
  return parsed(directory, count, offset);
}

function parsed(directory, count, end) {
  const view = viewOf(directory), members = new Map();
  for (let at = 0, i = 0; i < count; ++i) {
    if (view.getUint32(at, true) !== 0x02014b50) throw new Error("a zip with a damaged directory");
    const [length, extra, comment] = [28, 30, 32].map((field) => view.getUint16(at + field, true));
    const name = text(directory.subarray(at + 46, at + 46 + length)), size = view.getUint32(at + 24, true);
    let header = view.getUint32(at + 42, true);
    if (header === 0xffffffff) header = Number(view.getBigUint64(at + 46 + length + 4, true));
    const start = header + 30 + length;
    if (view.getUint16(at + 10, true) !== 0 || start + size > end) throw new Error(`the member ${name} is compressed, or outside the file`);
    members.set(name, { name, start, stop: start + size });
    at += 46 + length + extra + comment;
  }
  return members;
}

/** Ask for members; `onMember(name, bytes)` hears each when it is whole. What lies close together is one request. */
export async function readMembers(source, members, onMember, signal, largestGap = LARGEST_GAP, again = false) {
  const spans = [];
  for (const member of [...members].sort((a, b) => a.start - b.start)) {
    const last = spans.at(-1);
    if (last && member.start - last.stop <= largestGap) last.members.push(member), (last.stop = member.stop);
    else spans.push({ start: member.start, stop: member.stop, members: [member] });
  }
  const queue = spans.values();
  const work = async () => { for (const span of queue) await readWhole(source, span, onMember, signal, again); };
  await Promise.all(Array.from({ length: Math.min(MOST_AT_ONCE, spans.length) }, work));
}

async function readWhole(source, { start, stop, members }, onMember, signal, again) {
  const bytes = new Uint8Array(stop - start);
  let next = 0;
  await source.stream(start, stop, (offset, part) => {
    bytes.set(part, offset - start);
    for (const arrived = offset + part.length; next < members.length && members[next].stop <= arrived; ++next) {
      const member = members[next];
      onMember(member.name, bytes.subarray(member.start - start, member.stop - start));
    }
  }, signal, again);
}

async function readSpan(source, start, stop) {
  const bytes = new Uint8Array(stop - start);
  await source.stream(start, stop, (offset, part) => bytes.set(part, offset - start));
  return bytes;
}

export const text = (bytes) => new TextDecoder().decode(bytes);
export const viewOf = (bytes) => new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
