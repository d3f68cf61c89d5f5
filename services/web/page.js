// The job page. It uses the same API as everyone else: tus uploads, jobs, server-sent events, artifacts.
import { $, ask, bytes, element, get, guard, hasToken, seconds, send, setToken, tell } from "./ask.js";
import { accountControls } from "./account.js";
import { hide, jobControls, show, shownJob } from "./job.js";
import { listUnfinished, upload, uploadControls } from "./uploads.js";

const PAGE_OF_JOBS = 25;
let first = 0; // of the jobs that are listed
let scans = [];

// --- scans

async function take(file) {
  const scan = await upload(file);
  if (!scan) return;
  await listScans(scan.id);
  const about = `${size(scan)}, ${scan.cameras.count} photographs`;
  $("upload-state").textContent = [about, ...scan.calls_for, ...scan.warnings].join("; ");
}

const size = (scan) => scan.kind === "volume" ? `${scan.shape.join(" x ")} voxels` : `${scan.points.toLocaleString()} points`;

async function listScans(chosen = $("scan").value) {
  ({ scans } = await get("/v1/scans?limit=1000"));
  $("scan").replaceChildren(...scans.map((s) => element("option", `${s.file}, ${size(s)}`, { value: s.id, selected: s.id === chosen })));
  for (const id of ["start", "estimate", "tradeoff", "delete-scan"]) $(id).disabled = !scans.length;
  choose();
}

function choose() {
  $("tradeoff").disabled = !scans.find((s) => s.id === $("scan").value);
  $("estimated").replaceChildren();
}

const deleteScan = guard(async () => {
  const scan = scans.find((s) => s.id === $("scan").value);
  if (!confirm(`Delete the scan ${scan.file}? Results of its jobs stay.`)) return;
  await ask("/v1/scans/" + scan.id, { method: "DELETE" });
  await listScans();
});

// --- submitting

async function listOptions() {
  const [options, presets] = await Promise.all([get("/v1/options"), get("/v1/presets")]);
  $("preset").replaceChildren(...presets.map((p) => element("option", p.name, { value: p.name, selected: p.default })));
  const showPreset = () => {
    const settings = presets.find((p) => p.name === $("preset").value).settings;
    for (const input of document.querySelectorAll("#options input")) input.placeholder = settings[input.name] ?? "automatic";
    $("estimated").replaceChildren();
  };
  $("options").replaceChildren(...options.map((o) => {
    const label = element("label", o.name.replaceAll("_", " "));
    const allowed = o.domain.enum ? o.domain.enum.join(", ") : o.domain.description ?? ("minimum" in o.domain ? `${o.domain.minimum} to ${o.domain.maximum}` : "above 0");
    const type = o.type === "string" || (o.domain.enum || []).some((c) => typeof c === "string") ? "text" : "number";
    label.append(element("input", "", { name: o.name, type, step: "any", title: `buys: ${o.buys}\ncosts: ${o.costs}` }), element("small", `${o.help} (${allowed})`));
    return label;
  }));
  $("preset").onchange = showPreset;
  showPreset();
}

function chosenOptions() {
  const inputs = [...document.querySelectorAll("#options input")].filter((input) => input.value !== "");
  return Object.fromEntries(inputs.map((i) => [i.name, Number.isNaN(Number(i.value)) ? i.value : Number(i.value)]));
}

const submit = (process) => guard(async () => {
  const key = [...crypto.getRandomValues(new Uint8Array(16))].map((b) => b.toString(16).padStart(2, "0")).join("");
  const request = { scan: $("scan").value, process, preset: $("preset").value, options: chosenOptions(), name: $("name").value };
  const job = await send("POST", "/v1/jobs", request, { "Idempotency-Key": key });
  first = 0;
  $("name").value = "";
  await listJobs();
  location.hash = job.jobID;
});

const FIGURES = [["seconds", "time", seconds], ["peak_memory_bytes", "memory", bytes], ["gpu_bytes", "packed", bytes],
  ["texture_psnr_db", "texture PSNR", (db) => db.toFixed(1) + " dB"],
  ["picture_psnr_db", "picture PSNR", (db) => db.toFixed(1) + " dB"]];

const estimate = guard(async () => {
  $("estimate").disabled = true;
  $("estimated").replaceChildren(element("span", "a pilot runs on a sample of the scan"));
  try {
    const found = await get("/v1/jobs/estimate?" + new URLSearchParams({ scan: $("scan").value, preset: $("preset").value, ...chosenOptions() }));
    $("estimated").replaceChildren(...FIGURES.filter(([key]) => found[key]).map(([key, name, text]) => {
      const { value, low, high } = found[key];
      const box = element("span", name + " ");
      box.append(element("b", text(value)), low === undefined ? "" : ` (${text(low)} to ${text(high)})`);
      return box;
    }));
  } catch (error) {
    $("estimated").replaceChildren();
    throw error;
  } finally {
    $("estimate").disabled = false;
  }
});

// --- jobs

async function listJobs() {
  const words = new URLSearchParams({ limit: PAGE_OF_JOBS, offset: first, q: $("search").value });
  const { jobs, numberMatched } = await get("/v1/jobs?" + words);
  $("jobs").replaceChildren(...jobs.map((job) => {
    const name = element("td", ""), row = element("tr", "", { className: job.jobID === shownJob() ? "shown" : "" });
    name.append(element("a", job.name, { href: "#" + job.jobID, ariaCurrent: job.jobID === shownJob() ? "true" : null }));
    row.append(name, element("td", job.status === "running" ? job.progress + " %" : job.status, { className: job.status }),
      element("td", new Date(job.created).toLocaleString()));
    return row;
  }));
  $("older").disabled = first + jobs.length >= numberMatched;
  $("newer").disabled = first === 0;
  $("matched").textContent = numberMatched ? `${first + 1} to ${first + jobs.length} of ${numberMatched}` : "none";
}

const turn = (by) => guard(async () => { first = Math.max(0, first + by); await listJobs(); });

// The address says which job is shown, so that Back and Forward go from one to the other.
const follow = guard(async () => {
  const id = location.hash.slice(1);
  if (!id) return hide();
  if (!/^[0-9a-f]{32}$/.test(id)) { hide(); throw new Error(`${location.hash} names no job`); }
  try {
    await show(id);
  } finally {
    await listJobs();
  }
});

// --- start

// A link carries no token: the page trades it for a cookie first.
async function showDashboard(known) {
  if (known && hasToken()) await ask("/v1/dashboard", { method: "POST" });
  $("dashboard").hidden = !known;
}

const start = guard(async () => {
  const state = await get("/web-state");
  $("login").hidden = true;
  $("sign-out").hidden = !hasToken();
  $("owner").textContent = hasToken() ? state.owner : "";
  await showDashboard(state.dashboard);
  await Promise.all([listOptions(), listScans(), listJobs(), listUnfinished()]);
  if (location.hash) await follow();
});

$("login").onsubmit = guard(async () => {
  setToken($("token").value);
  $("token").value = "";
  await start();
});
$("sign-out").onclick = guard(async () => {
  await ask("/v1/dashboard", { method: "DELETE" }).catch(() => {}); // a token that is no longer good opens nothing there either
  setToken("");
  location.hash = "";
  location.reload();
});
$("file").onchange = guard(async () => { const file = $("file").files[0]; $("file").value = ""; if (file) await take(file); });
$("drop").ondragover = (event) => { event.preventDefault(); $("drop").classList.add("over"); };
$("drop").ondragleave = () => $("drop").classList.remove("over");
$("drop").ondrop = guard(async (event) => { $("drop").classList.remove("over"); if (event.dataTransfer.files[0]) await take(event.dataTransfer.files[0]); });
$("scan").onchange = choose;
$("delete-scan").onclick = deleteScan;
$("submit").onsubmit = submit("compress");
$("tradeoff").onclick = submit("tradeoff");
$("estimate").onclick = estimate;
$("search").oninput = guard(async () => { first = 0; await listJobs(); });
$("older").onclick = turn(PAGE_OF_JOBS);
$("newer").onclick = turn(-PAGE_OF_JOBS);
uploadControls(guard(take));
jobControls(listJobs);
accountControls();
window.addEventListener("hashchange", follow);
setInterval(() => { if (!document.hidden && $("login").hidden) listJobs().catch(() => {}); }, 5000); // also those begun elsewhere
tell("");
start();
