// The viewer: loads a packed file, draws it as it arrives and while one moves through it.

import { Camera } from "./camera.js";
import { Controls } from "./controls.js";
import { Measure } from "./measure.js";
import { Packed } from "./packed.js";
import { Renderer } from "./renderer.js";
import { Scene } from "./scene.js";
import { Section } from "./section.js";
import { allOf, settle } from "./settling.js";
import { unit } from "./vectors.js";
import { wantedGroups } from "./view.js";

const TARGET_MS = 50; // of a frame while one moves
const COARSEST = 0.25; // of the resolution, while one moves
const STILL_MS = 250; // after the last move, before a frame of full resolution
const BUDGET = 3e6, BUDGET_OF_TOUCH = 1e6; // splats at once, where a file has levels
const SETTLED = 10; // times the budget, the most splats of a view that rests
const REST = 2; // times what a frame takes, between frames of a file that arrives
const MOST_ATOMS = 16; // of a splat, by the format
const $ = (id) => document.getElementById(id);

export class Viewer {
  /** `shaders` is the document of renderer/splats/gles.py. */
  constructor(shaders, options = {}) {
    Object.assign(this, { canvas: $("canvas"), options, scale: 1, lamp: null, maxAtoms: MOST_ATOMS, isMeasuring: false, queued: false, times: {} });
    this.budget = options.budget || (matchMedia("(pointer: coarse)").matches ? BUDGET_OF_TOUCH : BUDGET);
    this.mostSettled = options.settled ?? SETTLED * this.budget;
    this.renderer = new Renderer(this.canvas, shaders, options);
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  async load(source) {
    this.source = source;
    this.started = performance.now();
    const packed = await Packed.open(source);
    this.scene = new Scene(this.renderer.gl, packed, this.budget);
    await this.scene.load(() => this.wanted(), (stage) => this.heard(stage), () => this.settle());
  }

  heard(stage) {
    if (stage === "tables") this.begin();
    this.times[stage] ??= performance.now() - this.started;
    this.complete = stage === "all";
    if (this.complete || !(performance.now() - this.drawnAt < REST * this.frameMs)) this.draw(); // else it would draw more than load
  }

  begin() {
    const { scene } = this, { header } = scene;
    this.camera = new Camera(scene);
    this.fromAddress();
    addEventListener("hashchange", () => { if (this.fromAddress()) this.draw(); });
    this.measure = new Measure($("overlay"), $("measured"), this.camera, header);
    this.controls = new Controls(this.canvas, this.camera, {
      moved: () => this.moved(), view: () => this.shownView(), tapped: (x, y, twice) => this.tapped(x, y, twice),
    });
    document.title = `${header.scan.name ?? "scan"} - splatpress`;
    this.canvas.setAttribute("aria-label", `${header.scan.name ?? "A scan"}, ${header.n_splats.toLocaleString("en")} splats`);
    const stations = (header.maps || []).map((_, i) => new Option(`station ${i + 1}`, header.cameras.length + i));
    $("photos").replaceChildren(new Option(stations.length ? "stations" : "photographs", ""), ...header.cameras.map((camera, i) => new Option(camera.name, i)), ...stations);
    $("photos").hidden = !header.cameras.length && !stations.length;
    $("photos").onchange = () => { if ($("photos").value !== "") this.stand(Number($("photos").value)); };
    $("home").onclick = () => { this.camera.home(); this.moved(); };
    $("light").onclick = () => this.light(!this.lamp);
    $("side").oninput = () => this.light(true);
    this.section = new Section($("section"), header, this.camera.corners, () => this.moved());
    const most = Math.max(0, ...header.batches.map((batch) => batch.n_atoms));
    Object.assign($("atoms"), { max: most, value: most, oninput: () => this.limit(Number($("atoms").value)) });
    $("atoms-shown").textContent = most;
    $("atoms-label").hidden = !most;
    $("measure").onclick = () => this.toggleMeasuring();
    $("save").onclick = () => this.save();
    this.canvas.addEventListener("keydown", (event) => this.key(event));
    this.light(Boolean(header.effects.relighting?.lamp)); // colours that have no light in them
  }

  // --- what one does

  stand(photo) {
    const { cameras, maps } = this.scene.header;
    if (photo < cameras.length) this.camera.stand(cameras[photo]);
    else this.camera.standAt(maps[photo - cameras.length].centre);
    this.moved();
    $("photos").value = photo;
  }

  key(event) {
    const { cameras, maps } = this.scene.header, places = cameras.length + (maps?.length ?? 0);
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key >= "0" && event.key <= "9") {
      const photo = (Number(event.key) + 9) % 10;
      if (photo < places) this.stand(photo);
    } else if (event.code === "KeyF") $("home").click();
    else if (event.code === "KeyL") $("light").click();
    else if (event.code === "KeyM") $("measure").click();
    else if (event.key === "Escape" && this.isMeasuring) this.toggleMeasuring();
    else if (event.key === "Backspace" && this.isMeasuring) this.measure.undo(), this.draw();
    else if (event.key === "Enter" && this.isMeasuring) this.tapped(this.canvas.clientWidth / 2, this.canvas.clientHeight / 2, false);
    else return;
    event.preventDefault();
  }

  tapped(x, y, twice) {
    const point = this.pick(x, y);
    if (!point) return;
    if (this.isMeasuring && !twice) this.measure.add(point);
    else if (twice) this.camera.about(point);
    this.draw();
  }

  /** The point of the surface at CSS px of the canvas, against the origin; null where there is none. */
  pick(x, y) {
    if (this.settling) this.stop(); // its depths are not whole yet
    this.frame(1);
    const { width, height } = this.shownView();
    return this.renderer.pointAt((x * width) / this.canvas.clientWidth, (y * height) / this.canvas.clientHeight);
  }

  toggleMeasuring() {
    this.isMeasuring = !this.isMeasuring;
    $("measure").setAttribute("aria-pressed", this.isMeasuring);
    $("measured").hidden = $("cross").hidden = !this.isMeasuring;
    if (!this.isMeasuring) this.measure.clear();
    this.canvas.focus({ preventScroll: true });
    this.draw();
  }

  /** The product's usual lamp (renderer/effects/relighting.py), turned about the line of sight to the chosen side; or as photographed. */
  light(on) {
    const turn = (Number($("side").value) * Math.PI) / 180, [s, c] = [Math.sin(turn), Math.cos(turn)];
    this.lamp = on ? { towards: unit([-0.4 * c + 0.7 * s, -0.7 * c - 0.4 * s, -1]), ambient: 0.3, diffuse: 0.7 } : null;
    $("side-label").hidden = !on;
    $("light").setAttribute("aria-pressed", on);
    this.draw();
  }

  /** Draw each splat with so many of its atoms at most: 0 are average colours alone. */
  limit(atoms) {
    this.maxAtoms = atoms;
    $("atoms-shown").textContent = atoms;
    this.moved();
  }

  save() {
    if (this.settling) this.stop();
    this.frame(1);
    const { width, height } = this.shownView(), pixels = new Uint8ClampedArray(this.renderer.pixels().buffer);
    const canvas = Object.assign(document.createElement("canvas"), { width, height });
    canvas.getContext("2d").putImageData(new ImageData(pixels, width, height), 0, 0);
    canvas.toBlob((blob) => {
      const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: "splatpress.png" });
      link.click();
      URL.revokeObjectURL(link.href);
    });
  }

  // --- frames

  moved() {
    this.lastMove = performance.now();
    $("photos").value = "";
    this.draw();
    clearTimeout(this.waiting);
    this.waiting = setTimeout(() => { this.draw(); this.toAddress(); this.scene.wake?.(); }, STILL_MS);
    if (this.lastMove - (this.lastLook ?? 0) > STILL_MS) this.lastLook = this.lastMove, this.scene.wake?.(); // while one flies, too
  }

  draw() {
    if (this.queued || !this.camera) return;
    this.queued = true;
    requestAnimationFrame((now) => {
      this.queued = false;
      if (this.controls.step(now)) this.moved();
      const moves = performance.now() - (this.lastMove ?? -Infinity) < STILL_MS;
      this.frame(moves ? this.scale : 1);
      if (moves) this.adapt();
    });
  }

  // A frame's time follows its pixels and its splats; only the pixels are ours to change.
  adapt() {
    const wanted = this.scale * Math.sqrt(TARGET_MS / Math.max(1, this.frameMs));
    this.scale = Math.min(1, Math.max(COARSEST, 0.5 * (this.scale + wanted)));
  }

  shownView() {
    return this.renderer.shown?.view ?? this.camera.view(...this.size(1));
  }

  size(scale) {
    const density = scale * (globalThis.devicePixelRatio || 1);
    return [this.canvas.clientWidth, this.canvas.clientHeight].map((side) => Math.max(1, Math.round(side * density)));
  }

  // All that a picture depends on, but what has arrived and the budget.
  look(scale) {
    const view = this.camera.view(...this.size(scale)), look = { light: this.lamp, maxAtoms: this.maxAtoms, section: this.section.box };
    return { view, look, key: JSON.stringify([view, look]) };
  }

  frame(scale) {
    const [width, height] = this.size(1), started = performance.now(), { view, look, key } = this.look(scale);
    if (this.settled !== key && this.settling?.key !== key) {
      this.stop();
      if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
      this.splats = this.renderer.render(this.scene, view, { ...look, mostSplats: this.budget * scale * scale });
      this.show(started);
    }
    this.measure.draw(view, this.canvas.clientWidth, this.canvas.clientHeight);
    if (this.splats) this.times.picture ??= performance.now() - this.started, document.body.classList.add("begun"), this.first ??= { bytes: this.source.received, requests: this.source.requests };
    this.say();
  }

  show(started) {
    this.renderer.present();
    this.renderer.wait();
    this.drawnAt = performance.now();
    this.frameMs = this.drawnAt - started;
  }

  // The picture of all splats of a view that rests, where there are more than the budget lets one move through.
  async settle() {
    while (this.queued) await new Promise(requestAnimationFrame);
    const { view, look, key } = this.look(1), { scene } = this;
    if (!scene.tree || !this.mostSettled || this.settled === key || performance.now() - (this.lastMove ?? -Infinity) < STILL_MS) return;
    const all = allOf(scene, view, this.mostSettled);
    if (all.groups.reduce((n, group) => n + scene.splatsOf(group), 0) === this.splats) return (this.settled = key); // it is that already
    const stop = new AbortController();
    this.settling = { key, stop, done: 0 };
    try {
      this.splats = await settle(scene, this.renderer, view, all, this.wanted(), look, stop.signal, (done) => { this.settling.done = done; this.say(); });
      this.settled = key;
      this.renderer.present();
      this.times.settled ??= performance.now() - this.started;
    } catch (error) {
      if (!stop.signal.aborted) throw error;
    }
    this.settling = null;
    this.say();
  }

  // What rests no longer; where the view comes to rest again, it settles again.
  stop() {
    this.settling?.stop.abort();
    if (this.settling || this.settled) this.scene.wake?.();
    this.settling = this.settled = null;
  }

  /** The pixels (RGBA, top row first) that a camera of the header's kind would see: what tests compare. */
  picture({ width_px, height_px, fx_px, fy_px, cx_px, cy_px, rotation, centre }, mostSplats = Infinity) {
    const eye = centre.map((x, i) => x - this.scene.header.origin[i]);
    this.stop();
    this.renderer.render(this.scene, { rotation, eye, width: width_px, height: height_px, fx: fx_px, fy: fy_px, cx: cx_px, cy: cy_px },
      { light: this.lamp, maxAtoms: this.maxAtoms, mostSplats, section: this.section.box });
    return this.renderer.pixels();
  }

  wanted() {
    return wantedGroups(this.scene, this.camera, this.camera.view(...this.size(1)), this.budget);
  }

  // --- words

  statistics() {
    const { source, scene, renderer } = this, view = this.shownView();
    return { splats: this.splats, allSplats: scene.header.n_splats, received: source.received, size: source.size, requests: source.requests, first: this.first, checked: scene.seals.checked,
      frameMs: this.frameMs, gpuBytes: scene.bytes, pixels: view.width * view.height, complete: !!this.complete, settled: !!this.settled, times: this.times,
      programs: [...renderer.programs.keys()], clipControl: !!renderer.clip };
  }

  say() {
    const s = this.statistics(), count = (n) => (n >= 1e6 ? (n / 1e6).toFixed(2) + " M" : n.toLocaleString("en"));
    $("statistics").textContent = `${count(s.splats)} of ${count(s.allSplats)} splats · ${(Math.min(s.received, s.size) / 1e6).toFixed(1)} of ${(s.size / 1e6).toFixed(1)} MB`
      + ` · ${s.frameMs.toFixed(0)} ms a frame`;
    $("loading").hidden = s.complete && !this.settling;
    $("loading").value = this.settling ? this.settling.done : s.received / s.size;
  }

  toAddress() {
    history.replaceState(null, "", `#c=${this.camera.toText()}`);
  }

  fromAddress() {
    const found = /[#&]c=([^&]*)/.exec(location.hash);
    return !!found && this.camera.fromText(found[1]);
  }
}
