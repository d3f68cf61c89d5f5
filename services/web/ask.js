// How the page speaks with the API, and a few words that all of it shares.

export const $ = (id) => document.getElementById(id);
let token = sessionStorage.getItem("token") || "";

export const hasToken = () => token !== "";
export function setToken(value) {
  token = value;
  if (value) sessionStorage.setItem("token", value);
  else sessionStorage.removeItem("token");
}

export class Refused extends Error {
  constructor(status, problem) {
    super(problem.detail + (problem.hint ? ` (${problem.hint})` : ""));
    this.status = status;
  }
}

export async function ask(path, options = {}) {
  const headers = { ...(token ? { Authorization: "Bearer " + token } : {}), ...options.headers };
  const answer = await fetch(path, { ...options, headers });
  if (answer.ok) return answer;
  const problem = await answer.json().catch(() => ({ detail: answer.statusText || `the service answered ${answer.status}` }));
  if (answer.status === 401) $("login").hidden = false;
  throw new Refused(answer.status, problem);
}

const JSON_TYPE = { "Content-Type": "application/json" };
export const get = async (path, options) => (await ask(path, options)).json();
export const send = async (method, path, body, headers = {}) =>
  (await ask(path, { method, body: body && JSON.stringify(body), headers: { ...JSON_TYPE, ...headers } })).json();

export function tell(text) {
  $("problem").textContent = text;
  $("problem").hidden = !text;
}

// What a handler throws is told at the top of the page; a lost connection is told as that.
export function guard(work) {
  return async (event) => {
    if (event && event.preventDefault) event.preventDefault();
    try {
      tell("");
      return await work(event);
    } catch (error) {
      if (error.name === "AbortError" || (error.status === 401 && !hasToken())) return undefined; // the form asks for one, and nothing is wrong yet
      tell(error instanceof TypeError ? "the service does not answer" : error.message);
      return undefined;
    }
  };
}

export function element(name, text, attributes = {}) {
  const made = document.createElement(name);
  made.textContent = text;
  return Object.assign(made, attributes);
}

export const bytes = (n) => (n < 1e6 ? (n / 1e3).toFixed(1) + " kB" : n < 1e9 ? (n / 1e6).toFixed(1) + " MB" : (n / 1e9).toFixed(2) + " GB");
export const seconds = (s) => (s < 90 ? s.toFixed(0) + " s" : s < 5400 ? (s / 60).toFixed(0) + " min" : (s / 3600).toFixed(1) + " h");
export const pause = (ms, signal) =>
  new Promise((done, fail) => {
    const timer = setTimeout(done, ms);
    signal?.addEventListener("abort", () => { clearTimeout(timer); fail(new DOMException("", "AbortError")); }, { once: true });
  });
