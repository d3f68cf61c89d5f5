// One job: its state, its progress as it is told, and what it made.
import { $, ask, bytes, element, get, guard, hasToken, pause, Refused, seconds, send, tell } from "./ask.js";

let shown = null; // the job on the right
let listening = null; // AbortController of its events
let curve = [];
let pictures = {}; // object URLs by address
let changed = () => {}; // called when a job's state is another

export const shownJob = () => shown;
const isLive = (job) => ["accepted", "running"].includes(job.status);

export function hide() {
  if (listening) listening.abort();
  shown = null;
  $("job").hidden = true;
}

export async function show(id) {
  if (listening) listening.abort();
  listening = new AbortController();
  Object.values(pictures).forEach((url) => URL.revokeObjectURL(url));
  shown = id, curve = [], pictures = {};
  $("compare").hidden = $("curve").hidden = $("downloads").hidden = true;
  $("log").textContent = $("job-live").textContent = "";
  $("figures").replaceChildren();
  $("artifacts").replaceChildren();
  try {
    await refresh(id);
  } catch (error) {
    hide();
    throw error instanceof Refused && error.status === 404 ? new Error("there is no such job here, or it has expired") : error;
  }
  $("job").hidden = false;
  guard(() => listen(id, listening.signal))();
}

function stateOf(job) {
  const problem = job.problem ? `: ${job.problem.detail}${job.problem.hint ? `; ${job.problem.hint}` : ""}` : "";
  const kept = job.expires_at ? `; kept until ${new Date(job.expires_at).toLocaleString()}` : job.pinned ? "; pinned" : "";
  return job.status + problem + kept;
}

async function refresh(id) {
  const job = await get("/v1/jobs/" + id);
  if (id !== shown) return job;
  const live = isLive(job);
  $("job-name").textContent = job.name;
  document.title = `${job.name}, ${job.status}: splatpress`;
  $("job-state").textContent = stateOf(job);
  $("job-state").className = job.status;
  $("job-progress").value = job.progress;
  if (!live) $("job-live").textContent = "";
  $("cancel").textContent = live ? "Dismiss" : "Delete results";
  $("cancel").disabled = job.status === "dismissed" || (job.pinned && !live);
  $("retry").disabled = !["failed", "dismissed"].includes(job.status);
  $("pin").textContent = job.pinned ? "Unpin" : "Pin";
  $("pin").onclick = guard(async () => {
    await send("PATCH", "/v1/jobs/" + id, { pinned: !job.pinned });
    await refresh(id);
  });
  if (!live) await listArtifacts(job);
  return job;
}

// --- events

async function listen(id, signal) {
  let last = "0";
  while (id === shown) {
    try {
      const answer = await ask(`/v1/jobs/${id}/events`, { signal, headers: { "Last-Event-ID": last } });
      for await (const fields of events(answer)) {
        if (id !== shown) return;
        last = fields.id;
        hear(id, fields.event, JSON.parse(fields.data));
      }
      const job = await refresh(id);
      await changed();
      tell("");
      if (!isLive(job)) return;
    } catch (error) {
      if (error.name === "AbortError") return;
      if (error instanceof Refused && error.status !== 503) throw error;
      tell("the service does not answer; going on when it does");
    }
    await pause(1000, signal);
  }
}

async function* events(answer) {
  const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    const parts = (text + value).split("\n\n");
    text = parts.pop();
    for (const part of parts) {
      const lines = part.split("\n").map((line) => [line.slice(0, line.indexOf(": ")), line.slice(line.indexOf(": ") + 2)]);
      const fields = Object.fromEntries(lines);
      if (fields.data) yield fields;
    }
  }
}

function hear(id, kind, data) {
  if (kind === "progress") {
    $("job-progress").value = data.progress;
    const parts = [`${data.progress} %`, data.stage];
    if (data.splats_per_second) parts.push(`${data.splats_per_second.toLocaleString()} splats/s`);
    if (data.seconds_left !== null) parts.push(`about ${seconds(data.seconds_left)} left`);
    if (data.psnr_db !== null) parts.push(`training patches at ${data.psnr_db.toFixed(2)} dB`);
    $("job-live").textContent = parts.join(" · ");
  } else if (kind === "learning") {
    curve[data.iteration - 1] = data.psnr_db;
    drawCurve();
  } else if (kind === "log" && data.level !== "debug") {
    $("log").textContent += `${new Date(data.time).toLocaleTimeString()}  ${data.message}\n`;
    $("log").scrollTop = $("log").scrollHeight;
  } else if (kind === "status") {
    guard(async () => { await refresh(id); await changed(); })();
  }
}

function drawCurve() {
  const low = Math.min(...curve), high = Math.max(...curve, low + 0.1);
  const x = (i) => 40 + (curve.length > 1 ? (i * 345) / (curve.length - 1) : 0);
  const y = (value) => 120 - ((value - low) / (high - low)) * 100;
  const make = (name, attributes, text = "") => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    made.textContent = text;
    return made;
  };
  const svg = $("curve").querySelector("svg");
  svg.replaceChildren(
    ...curve.map((value, i) => make("circle", { cx: x(i), cy: y(value), r: 1.5 })),
    make("polyline", { points: curve.map((value, i) => `${x(i)},${y(value)}`).join(" ") }),
    make("text", { x: 2, y: y(high) + 3 }, high.toFixed(1)), make("text", { x: 2, y: y(low) + 3 }, low.toFixed(1)));
  $("curve-caption").textContent =
    `Learning the dictionary: PSNR of the patches it is trained on, after each of ${curve.length} iteration${curve.length > 1 ? "s" : ""}; now ` +
    `${curve.at(-1).toFixed(2)} dB. The file's own PSNR, of all its textures as they are coded, is measured at the end.`;
  $("curve").hidden = false;
}

// --- results

async function objectUrl(href) {
  return (pictures[href] ??= URL.createObjectURL(await (await ask(href)).blob()));
}

// A plain link, which the browser streams to disk; where a token is needed the page fetches it.
function download(text, href, name) {
  const link = element("a", text, { href, download: name });
  if (hasToken()) link.onclick = guard(async () => Object.assign(document.createElement("a"), { href: await objectUrl(href), download: name }).click());
  return link;
}

async function listArtifacts(job) {
  const id = job.jobID;
  const { artifacts } = await get(`/v1/jobs/${id}/artifacts`);
  if (id !== shown) return;
  const plain = artifacts.filter((a) => !a.name.startsWith("previews/"));
  $("downloads").hidden = !artifacts.length;
  const total = artifacts.reduce((sum, a) => sum + a.bytes, 0);
  $("all").replaceChildren(download(`All ${artifacts.length} files as one .zip`, `/v1/jobs/${id}/archive`, job.name + ".zip"), `, ${bytes(total)}`);
  $("artifacts").replaceChildren(...plain.map((a) => {
    const item = element("li", "");
    item.append(download(a.name, a.href, a.name), `, ${bytes(a.bytes)}`);
    if (a.name.endsWith(".splatpress")) item.append(" ", element("a", "Look at it", { href: `/view?content=${encodeURIComponent(a.href)}`, className: "look" }));
    return item;
  }));
  if (artifacts.some((a) => a.name === "report.json")) await showReport(id, artifacts);
}

async function showReport(id, artifacts) {
  const report = await get(`/v1/jobs/${id}/artifacts/report.json`);
  if (id !== shown) return;
  const { sizes, quality } = report;
  const figures = [["splats", report.splats.toLocaleString()], ["file", bytes(sizes.file_bytes)], ["bytes a splat", (sizes.own_bytes_per_splat ?? sizes.bytes_per_splat).toFixed(2)]];
  if (sizes.shipped_bytes) figures.push(["shipped atoms beside", bytes(sizes.shipped_bytes)]);
  const times = sizes.own_factor_total ?? sizes.compression_factor_total;
  if (times) figures.push(["compression", times.toFixed(1) + " times"]);
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
    const baseline = hrefs[view.pictures.baseline];  // points alone have none: one picture, and nothing to compare with
    $("compare-title").textContent = baseline ? "Packed beside baseline" : "Packed";
    for (const part of document.getElementsByClassName("of-two")) part.hidden = !baseline;
    const both = [hrefs[view.pictures.packed], baseline || hrefs[view.pictures.packed]];  // the one below gives the pair its height
    [$("packed").src, $("baseline").src] = await Promise.all(both.map(objectUrl));
    if (!baseline) $("slider").value = 100;
    $("view-figures").textContent = !baseline ? `splats cover ${(100 * view.coverage).toFixed(1)} % of the picture` :
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

export function jobControls(onChange) {
  changed = onChange;
  $("slider").oninput = slide;
  $("cancel").onclick = guard(async () => {
    if ($("cancel").textContent !== "Dismiss" && !confirm("Delete what this job made?")) return;
    await ask("/v1/jobs/" + shown, { method: "DELETE" });
    await refresh(shown);
    await changed();
  });
  $("retry").onclick = guard(async () => { await send("POST", `/v1/jobs/${shown}/retry`); await show(shown); await changed(); });
}
