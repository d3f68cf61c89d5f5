// The job page. It uses the same API as everyone else: tus uploads, jobs, server-sent events, artifacts.
"use strict";
const $ = (id) => document.getElementById(id);
const PIECE_BYTES = 8 << 20;
const TUS = { "Tus-Resumable": "1.0.0" };
let token = sessionStorage.getItem("token") || "";
let shown = null; // the job on the right
let listening = null; // AbortController of its events
let curve = [];
let pictures = {}; // object URLs by artifact name

async function ask(path, options = {}) {
  const headers = { ...(token ? { Authorization: "Bearer " + token } : {}), ...options.headers };
  const answer = await fetch(path, { ...options, headers });
  if (answer.ok) return answer;
  const problem = await answer.json().catch(() => ({ detail: answer.statusText }));
  if (answer.status === 401) $("login").hidden = false;
  throw new Error(problem.detail + (problem.hint ? " (" + problem.hint + ")" : ""));
}
const get = async (path) => (await ask(path)).json();
const post = async (path, body, headers = {}) =>
  (await ask(path, { method: "POST", body: body && JSON.stringify(body), headers: { "Content-Type": "application/json", ...headers } })).json();

function guard(work) {
  return async (event) => {
    if (event && event.preventDefault) event.preventDefault();
    try {
      $("problem").hidden = true;
      await work(event);
    } catch (error) {
      if (error.name === "AbortError") return;
      $("problem").textContent = error.message;
      $("problem").hidden = false;
    }
  };
}

function element(name, text, attributes = {}) {
  const made = document.createElement(name);
  made.textContent = text;
  return Object.assign(made, attributes);
}

// --- uploads

async function upload(file) {
  const name = btoa(String.fromCharCode(...new TextEncoder().encode(file.name)));
  const made = await ask("/v1/uploads", { method: "POST", headers: { ...TUS, "Upload-Length": file.size, "Upload-Metadata": "filename " + name } });
  const where = made.headers.get("Location");
  let offset = 0, scan = null;
  $("sent").hidden = false;
  while (!scan) {
    $("sent").value = file.size ? offset / file.size : 0;
    $("upload-state").textContent = offset < file.size ? `${file.name}: ${bytes(offset)} of ${bytes(file.size)}` : "looking at the scan";
    const answer = await sent(where, offset, file.slice(offset, offset + PIECE_BYTES));
    offset = Number(answer.headers.get("Upload-Offset"));
    scan = answer.headers.get("Splatpress-Scan");
    if (offset >= file.size && !scan) $("upload-state").textContent = "looking at the scan";
  }
  $("sent").hidden = true;
  return get("/v1/scans/" + scan);
}

async function sent(where, offset, piece) {
  const headers = { ...TUS, "Upload-Offset": offset, "Content-Type": "application/offset+octet-stream" };
  try {
    return await ask(where, { method: "PATCH", body: piece, headers });
  } catch (error) {
    if (!(error instanceof TypeError)) throw error; // fetch's word for a lost connection
    await new Promise((done) => setTimeout(done, 1000));
    return ask(where, { method: "HEAD", headers: TUS });
  }
}

const take = (file) => guard(async () => {
  const scan = await upload(file);
  await listScans(scan.id);
  const about = `${scan.points.toLocaleString()} points, ${scan.cameras.count} photographs`;
  $("upload-state").textContent = [about, ...scan.calls_for, ...scan.warnings].join("; ");
})();

async function listScans(chosen) {
  const { scans } = await get("/v1/scans");
  $("scan").replaceChildren(...scans.map((s) => element("option", `${s.file}, ${s.points.toLocaleString()} points`, { value: s.id, selected: s.id === chosen })));
  $("start").disabled = !scans.length;
}

// --- submitting

async function listOptions() {
  const [options, presets] = await Promise.all([get("/v1/options"), get("/v1/presets")]);
  $("preset").replaceChildren(...presets.map((p) => element("option", p.name, { value: p.name, selected: p.default })));
  const showPreset = () => {
    const settings = presets.find((p) => p.name === $("preset").value).settings;
    for (const input of document.querySelectorAll("#options input")) input.placeholder = settings[input.name] ?? "automatic";
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

const submit = guard(async () => {
  const options = {};
  for (const input of document.querySelectorAll("#options input")) if (input.value !== "") options[input.name] = Number.isNaN(Number(input.value)) ? input.value : Number(input.value);
  const key = [...crypto.getRandomValues(new Uint8Array(16))].map((b) => b.toString(16).padStart(2, "0")).join("");
  const job = await post("/v1/jobs", { scan: $("scan").value, preset: $("preset").value, options }, { "Idempotency-Key": key });
  await listJobs();
  await show(job.jobID);
});

// --- jobs

async function listJobs() {
  const { jobs } = await get("/v1/jobs?limit=50");
  $("jobs").replaceChildren(...jobs.map((job) => {
    const row = element("tr", "", { onclick: guard(() => show(job.jobID)), className: job.jobID === shown ? "shown" : "" });
    row.append(element("td", job.name), element("td", job.status === "running" ? job.progress + " %" : job.status, { className: job.status }),
      element("td", new Date(job.created).toLocaleString()));
    return row;
  }));
}

async function show(id) {
  if (listening) listening.abort();
  listening = new AbortController();
  Object.values(pictures).forEach((url) => URL.revokeObjectURL(url));
  shown = id, curve = [], pictures = {};
  location.hash = id;
  $("job").hidden = false;
  $("compare").hidden = $("curve").hidden = true;
  $("log").textContent = "";
  $("figures").replaceChildren();
  $("artifacts").replaceChildren();
  await refresh(id);
  guard(() => listen(id, listening.signal))();
}

async function refresh(id) {
  const job = await get("/v1/jobs/" + id);
  if (id !== shown) return job;
  const live = ["accepted", "running"].includes(job.status);
  $("job-name").textContent = job.name;
  $("job-state").textContent = job.status + (job.problem ? `: ${job.problem.detail}${job.problem.hint ? `; ${job.problem.hint}` : ""}` : "") + (job.expires_at ? `; kept until ${new Date(job.expires_at).toLocaleString()}` : job.pinned ? "; pinned" : "");
  $("job-state").className = job.status;
  $("job-progress").value = job.progress;
  if (!live) $("job-live").textContent = "";
  $("cancel").textContent = live ? "Dismiss" : "Delete results";
  $("cancel").disabled = job.status === "dismissed" || (job.pinned && !live);
  $("retry").disabled = !["failed", "dismissed"].includes(job.status);
  $("pin").textContent = job.pinned ? "Unpin" : "Pin";
  $("pin").onclick = guard(async () => {
    await ask("/v1/jobs/" + id, { method: "PATCH", body: JSON.stringify({ pinned: !job.pinned }), headers: { "Content-Type": "application/json" } });
    await refresh(id);
  });
  if (!live) await listArtifacts(id);
  return job;
}

async function listen(id, signal) {
  let last = "0";
  while (id === shown) {
    try {
      const answer = await ask(`/v1/jobs/${id}/events`, { signal, headers: { "Last-Event-ID": last } });
      const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
      let text = "";
      for (;;) {
        const { value, done } = await reader.read();
        if (done) break;
        const parts = (text + value).split("\n\n");
        text = parts.pop();
        for (const part of parts) {
          const fields = Object.fromEntries(part.split("\n").map((line) => [line.slice(0, line.indexOf(": ")), line.slice(line.indexOf(": ") + 2)]));
          if (fields.data && id === shown) {
            last = fields.id;
            hear(id, fields.event, JSON.parse(fields.data));
          }
        }
      }
    } catch (error) {
      if (error.name === "AbortError") return;
    }
    const job = await refresh(id);
    await listJobs();
    if (!["accepted", "running"].includes(job.status)) return;
    await new Promise((wait) => setTimeout(wait, 1000));
  }
}

function hear(id, kind, data) {
  if (kind === "progress") {
    $("job-progress").value = data.progress;
    const parts = [`${data.progress} %`, data.stage];
    if (data.splats_per_second) parts.push(`${data.splats_per_second.toLocaleString()} splats/s`);
    if (data.seconds_left !== null) parts.push(`about ${Math.round(data.seconds_left)} s left`);
    if (data.psnr_db !== null) parts.push(`${data.psnr_db.toFixed(2)} dB`);
    $("job-live").textContent = parts.join(" · ");
  } else if (kind === "learning") {
    curve[data.iteration - 1] = data.psnr_db;
    drawCurve();
  } else if (kind === "log" && data.level !== "debug") {
    $("log").textContent += `${new Date(data.time).toLocaleTimeString()}  ${data.message}\n`;
    $("log").scrollTop = $("log").scrollHeight;
  } else if (kind === "status") {
    guard(async () => { await refresh(id); await listJobs(); })();
  }
}

function drawCurve() {
  const low = Math.min(...curve), high = Math.max(...curve, low + 0.1);
  const x = (i) => 40 + (curve.length > 1 ? (i * 345) / (curve.length - 1) : 0);
  const y = (value) => 120 - ((value - low) / (high - low)) * 100;
  const svg = $("curve").querySelector("svg");
  const make = (name, attributes, text = "") => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    made.textContent = text;
    return made;
  };
  svg.replaceChildren(make("polyline", { points: curve.map((value, i) => `${x(i)},${y(value)}`).join(" ") }),
    make("text", { x: 2, y: y(high) + 3 }, high.toFixed(1)), make("text", { x: 2, y: y(low) + 3 }, low.toFixed(1)));
  $("curve-caption").textContent = `PSNR in dB after each of ${curve.length} iterations; now ${curve.at(-1).toFixed(2)} dB`;
  $("curve").hidden = false;
}

// --- results

const bytes = (n) => (n < 1e6 ? (n / 1e3).toFixed(1) + " kB" : (n / 1e6).toFixed(1) + " MB");

async function objectUrl(href) {
  return (pictures[href] ??= URL.createObjectURL(await (await ask(href)).blob()));
}

async function listArtifacts(id) {
  const { artifacts } = await get(`/v1/jobs/${id}/artifacts`);
  if (id !== shown) return;
  const plain = artifacts.filter((a) => !a.name.startsWith("previews/"));
  $("artifacts").replaceChildren(...plain.map((a) => {
    const link = element("a", a.name, { href: a.href, download: a.name });
    if (token) link.onclick = guard(async () => Object.assign(document.createElement("a"), { href: await objectUrl(a.href), download: a.name }).click());
    const item = element("li", "");
    item.append(link, `, ${bytes(a.bytes)}`);
    if (a.name.endsWith(".splatpress")) item.append(" ", element("a", "Look at it", { href: `/view?content=${encodeURIComponent(a.href)}`, className: "look" }));
    return item;
  }));
  if (artifacts.some((a) => a.name === "report.json")) await showReport(id, artifacts);
}

async function showReport(id, artifacts) {
  const report = await get(`/v1/jobs/${id}/artifacts/report.json`);
  if (id !== shown) return;
  const { sizes, quality } = report;
  const figures = [["splats", report.splats.toLocaleString()], ["file", bytes(sizes.file_bytes)], ["bytes a splat", sizes.bytes_per_splat.toFixed(2)]];
  if (sizes.compression_factor_total) figures.push(["compression", sizes.compression_factor_total.toFixed(1) + " times"]);
  if (quality.texture_psnr_db) figures.push(["texture PSNR", quality.texture_psnr_db.toFixed(2) + " dB"]);
  if (quality.visible_psnr_db) figures.push(["visible PSNR", quality.visible_psnr_db.toFixed(2) + " dB"]);
  const effects = (report.effects || []).filter((row) => row.enabled);
  if (effects.length) figures.push(["effects", effects.map((row) => row.title).join(", ")]);
  $("figures").replaceChildren(...figures.map(([name, value]) => { const box = element("span", name + " "); box.append(element("b", value)); return box; }));
  const hrefs = Object.fromEntries(artifacts.map((a) => [a.name, a.href]));
  const views = quality.views.filter((v) => v.pictures.packed && hrefs[v.pictures.packed]);
  $("compare").hidden = !views.length;
  if (!views.length) return;
  $("view").replaceChildren(...views.map((v, i) => element("option", v.camera, { value: i })));
  const showView = guard(async () => {
    const view = views[$("view").value];
    const baseline = hrefs[view.pictures.baseline] || hrefs[view.pictures.packed];
    [$("packed").src, $("baseline").src] = await Promise.all([objectUrl(hrefs[view.pictures.packed]), objectUrl(baseline)]);
    $("view-figures").textContent = view.psnr_vs_baseline_db === null ? "" :
      `against the baseline ${view.psnr_vs_baseline_db.toFixed(2)} dB, SSIM ${view.ssim_vs_baseline.toFixed(4)}`;
    slide();
  });
  $("view").onchange = showView;
  await showView();
}

function slide() {
  const share = $("slider").value;
  $("packed").style.clipPath = `inset(0 ${100 - share}% 0 0)`;
  $("divider").style.left = share + "%";
}

// --- start

const start = guard(async () => {
  const state = await get("/web-state");
  $("login").hidden = true;
  $("dashboard").hidden = !state.dashboard;
  $("dashboard").href = state.dashboard;
  await Promise.all([listOptions(), listScans(), listJobs()]);
  if (/^#[0-9a-f]{32}$/.test(location.hash)) await show(location.hash.slice(1));
});

$("login").onsubmit = guard(async () => {
  token = $("token").value;
  sessionStorage.setItem("token", token);
  await start();
});
$("file").onchange = () => $("file").files[0] && take($("file").files[0]);
$("drop").ondragover = (event) => { event.preventDefault(); $("drop").classList.add("over"); };
$("drop").ondragleave = () => $("drop").classList.remove("over");
$("drop").ondrop = (event) => { event.preventDefault(); $("drop").classList.remove("over"); if (event.dataTransfer.files[0]) take(event.dataTransfer.files[0]); };
$("submit").onsubmit = submit;
$("slider").oninput = slide;
$("cancel").onclick = guard(async () => {
  if ($("cancel").textContent !== "Dismiss" && !confirm("Delete what this job made?")) return;
  await ask("/v1/jobs/" + shown, { method: "DELETE" });
  await refresh(shown);
  await listJobs();
});
$("retry").onclick = guard(async () => { await post(`/v1/jobs/${shown}/retry`); await show(shown); await listJobs(); });
setInterval(() => { if (!document.hidden && $("login").hidden) listJobs().catch(() => {}); }, 5000); // also those begun elsewhere
start();
