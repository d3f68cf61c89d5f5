// Begins the viewer's page: what it is to show stands in its address, or in the page itself.

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
    await viewer.load(bytes ? new BytesSource(bytes, atoms) : new HttpSource(contentOf(parameters), sessionToken()));
  } catch (error) {
    fail(error);
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
