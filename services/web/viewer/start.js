// Begins the viewer's page: what it is to show stands in its address, or in the page itself.

import { ArchiveForm, plainForm } from "./plain.js";
import { BytesSource, HttpSource } from "./source.js";
import { Viewer } from "./viewer.js";

function fail(error) {
  const problem = document.getElementById("problem");
  problem.textContent = error.message;
  problem.hidden = false;
}

/** `bytes` of a file that the page holds, and of the dictionary that the file names if it does, else the address's `content` is asked for, on this host alone. */
export async function begin(shaders, bytes = null, atoms = null) {
  const parameters = new URLSearchParams(location.search);
  document.body.classList.toggle("noui", parameters.has("noui"));
  const poster = parameters.get("poster");
  if (poster) document.getElementById("canvas").style.backgroundImage = `url("${encodeURI(poster)}")`;
  try {
    const number = (name) => (parameters.has(name) ? Number(parameters.get(name)) : undefined);
    const viewer = (globalThis.viewer = new Viewer(shaders, { ownDepth: parameters.has("own-depth"), budget: number("budget"), settled: number("settled") }));
    await (bytes ? viewer.load(new BytesSource(bytes, atoms)) : loadFrom(viewer, contentOf(parameters)));
  } catch (error) {
    fail(error);
  }
}

/** The file at an address of this host; where it is in archive form and a job's, its plain form. */
async function loadFrom(viewer, content) {
  const source = new HttpSource(content, sessionToken());
  try {
    await viewer.load(source);
  } catch (error) {
    if (!(error instanceof ArchiveForm)) throw error;
    const waiting = document.getElementById("waiting");
    const plain = await plainForm(content, source.headers, () => { waiting.hidden = false; }).finally(() => { waiting.hidden = true; });
    if (!plain) throw error;
    await viewer.load(new HttpSource(plain, sessionToken()));
  }
}

function contentOf(parameters) {
  const content = new URL(parameters.get("content") ?? "/content", location.href);
  if (content.origin !== location.origin) throw new Error(`content is ${content.href}; allowed: addresses of this host`);
  return content;
}

function sessionToken() {
  try {
    return sessionStorage.getItem("token") || "";
  } catch {
    return ""; // a page that may keep nothing
  }
}
