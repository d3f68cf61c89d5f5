// Uploads by tus: in pieces, on where they were after a restart of the service or of this page, paused and cancelled.
import { $, ask, bytes, element, get, guard, pause, Refused, tell } from "./ask.js";

const PIECE_BYTES = 8 << 20;
const FIRST_BYTES = 1 << 16;
const TUS = { "Tus-Resumable": "1.0.0" };
const AGAIN = [408, 409, 423, 429, 460, 503, 507]; // another request was faster, or the service is not well for a moment
let current = null; // { file, abort, where }

// FNV-1a, for `crypto.subtle` is there on secure pages alone
function hash(block) {
  let value = 0x811c9dc5;
  for (const byte of block) value = Math.imul(value ^ byte, 0x01000193) >>> 0;
  return value.toString(16);
}

// The same while the file is the same, as far as its name, size, time and first bytes tell.
async function keyOf(file) {
  const first = new Uint8Array(await file.slice(0, FIRST_BYTES).arrayBuffer());
  return `upload ${file.name} ${file.size} ${file.lastModified} ${hash(first)}`;
}

async function head(where, signal) {
  const answer = await ask(where, { method: "HEAD", headers: TUS, signal });
  return { offset: Number(answer.headers.get("Upload-Offset")), scan: answer.headers.get("Splatpress-Scan") };
}

async function begun(file, key, signal) {
  const known = localStorage.getItem(key);
  if (known) {
    try {
      const state = await head(known, signal);
      if (state.scan) await ask("/v1/scans/" + state.scan, { signal });
      return { where: known, ...state };
    } catch (error) {
      if (!(error instanceof Refused) || ![404, 410].includes(error.status)) throw error;
    }
  }
  const name = btoa(String.fromCharCode(...new TextEncoder().encode(file.name)));
  const headers = { ...TUS, "Upload-Length": file.size, "Upload-Metadata": "filename " + name };
  const made = await ask("/v1/uploads", { method: "POST", headers, signal });
  const where = made.headers.get("Location");
  localStorage.setItem(key, where);
  return { where, offset: 0, scan: null };
}

// Asks again and again while the service does not answer; what it refuses is thrown.
async function patiently(work, signal, file) {
  for (let attempt = 0; ; attempt++) {
    try {
      return await work();
    } catch (error) {
      const lost = error instanceof TypeError; // fetch's word for a lost connection
      if (!lost && !(error instanceof Refused && AGAIN.includes(error.status))) throw error;
      if (attempt > 0) say(`${file.name}: ${lost ? "the service does not answer" : error.message}; trying again`);
      await pause(Math.min(10000, 500 * 2 ** attempt), signal);
    }
  }
}

function say(text) {
  $("upload-state").textContent = text;
}

function show(file, offset) {
  $("sent").hidden = false;
  $("sent").value = file.size ? offset / file.size : 0;
  say(offset < file.size ? `${file.name}: ${bytes(offset)} of ${bytes(file.size)}` : `${file.name}: looking at the scan`);
}

function controls(running, file = null) {
  $("upload-pause").hidden = !running;
  $("upload-cancel").hidden = !file;
  $("upload-resume").hidden = running || !file;
  if (!file) $("sent").hidden = true;
}

async function pieces(file, signal) {
  const key = await keyOf(file);
  let { where, offset, scan } = await patiently(() => begun(file, key, signal), signal, file);
  current.where = where;
  while (!scan) {
    show(file, offset);
    const headers = { ...TUS, "Upload-Offset": offset, "Content-Type": "application/offset+octet-stream" };
    const body = file.slice(offset, offset + PIECE_BYTES);
    try {
      const answer = await ask(where, { method: "PATCH", body, headers, signal });
      offset = Number(answer.headers.get("Upload-Offset"));
      scan = answer.headers.get("Splatpress-Scan");
    } catch (error) {
      if (!(error instanceof TypeError) && !(error instanceof Refused && AGAIN.includes(error.status))) {
        if (error instanceof Refused && error.status !== 401) localStorage.removeItem(key);
        throw error;
      }
      await pause(500, signal);
      ({ offset, scan } = await patiently(() => head(where, signal), signal, file));
    }
  }
  localStorage.removeItem(key);
  return scan;
}

// The scan that the file becomes; undefined where it was paused or cancelled, or refused, which stays told beside it.
export async function upload(file) {
  if (current && !current.abort.signal.aborted) {
    tell(`${current.file.name} is still on its way: pause or cancel it first`);
    return undefined;
  }
  current = { file, abort: new AbortController(), where: null };
  controls(true, file);
  tell("");
  try {
    const scan = await pieces(file, current.abort.signal);
    controls(false);
    current = null;
    return await get("/v1/scans/" + scan);
  } catch (error) {
    if (error.name === "AbortError") return undefined;
    controls(false, error.status === 401 ? file : null);
    if (error.status !== 401) current = null;
    say(`${file.name} was refused: ${error.message}`);
    return undefined;
  } finally {
    listUnfinished().catch(() => {});
  }
}

// Uploads of an earlier page or another program: their bytes are there, the file has to be chosen again.
export async function listUnfinished() {
  const { uploads } = await get("/v1/uploads");
  const others = uploads.filter((u) => !current || current.where !== `/v1/uploads/${u.id}`);
  $("unfinished").replaceChildren(...others.map((u) => {
    const size = u.length < 0 ? "" : ` of ${bytes(u.length)}`;
    const item = element("li", `${u.file}: ${bytes(u.offset)}${size} are here; choose the file again to go on `);
    const discard = element("button", "Discard", { type: "button", ariaLabel: `Discard the unfinished upload of ${u.file}` });
    discard.onclick = guard(async () => {
      await ask(`/v1/uploads/${u.id}`, { method: "DELETE", headers: TUS });
      await listUnfinished();
    });
    item.append(discard);
    return item;
  }));
}

export function uploadControls(take) {
  $("upload-pause").onclick = () => {
    current.abort.abort();
    controls(false, current.file);
    say(`${current.file.name}: paused`);
  };
  $("upload-resume").onclick = () => take(current.file);
  $("upload-cancel").onclick = guard(async () => {
    const { abort, where, file } = current;
    abort.abort();
    current = null;
    controls(false);
    if (where) await ask(where, { method: "DELETE", headers: TUS }).catch(() => {});
    localStorage.removeItem(await keyOf(file));
    say(`${file.name}: cancelled`);
    await listUnfinished();
  });
}
