// The viewer: loads a packed file, draws it as it arrives and while one moves through it.

import { Camera } from "./camera.js";
import { Controls } from "./controls.js";
import { sharesOf } from "./detail.js";
import { Measure } from "./measure.js";
import { Packed } from "./packed.js";
import { Renderer, visibleGroups } from "./renderer.js";
import { Scene } from "./scene.js";
import { Section } from "./section.js";
import { dot, unit } from "./vectors.js";

const TARGET_MS = 50; // of a frame while one moves
const COARSEST = 0.25; // of the resolution, while one moves
const STILL_MS = 250; // after the last move, before a frame of full resolution
const BUDGET = 3e6, BUDGET_OF_TOUCH = 1e6; // splats at once, where a file has levels
const REST = 2; // times what a frame takes, between frames of a file that arrives
const MOST_ATOMS = 16; // of a splat, by the format
const $ = (id) => document.getElementById(id);

export class Viewer {
  /** `shaders` is the document of renderer/splats/gles.py. */
  constructor(shaders, options = {}) {
    Object.assign(this, { canvas: $("canvas"), options, scale: 1, lamp: null, maxAtoms: MOST_ATOMS, isMeasuring: false, queued: false, times: {} });
    this.budget = options.budget || (matchMedia("(pointer: coarse)").matches ? BUDGET_OF_TOUCH : BUDGET);
    this.renderer = new Renderer(this.canvas, shaders, options);
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  async load(source) {
    this.source = source;
    this.started = performance.now();
    const packed = await Packed.open(source);
    this.scene = new Scene(this.renderer.gl, packed, this.budget);
    await this.scene.load(() => this.wanted(), (stage) => this.heard(stage));
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
    clearTimeout(this.settling);
    this.settling = setTimeout(() => { this.draw(); this.toAddress(); this.scene.wake?.(); }, STILL_MS);
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

  frame(scale) {
    const [width, height] = this.size(1), started = performance.now();
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    const view = this.camera.view(...this.size(scale));
    this.splats = this.renderer.render(this.scene, view, { light: this.lamp, maxAtoms: this.maxAtoms, mostSplats: this.budget * scale * scale, section: this.section.box });
    this.renderer.present();
    this.renderer.wait();
    this.drawnAt = performance.now();
    this.frameMs = this.drawnAt - started;
    this.measure.draw(view, this.canvas.clientWidth, this.canvas.clientHeight);
    if (this.splats) this.times.picture ??= performance.now() - this.started, document.body.classList.add("begun"), this.first ??= { bytes: this.source.received, requests: this.source.requests };
    this.say();
  }

  /** The pixels (RGBA, top row first) that a camera of the header's kind would see: what tests compare. */
  picture({ width_px, height_px, fx_px, fy_px, cx_px, cy_px, rotation, centre }, mostSplats = Infinity) {
    const eye = centre.map((x, i) => x - this.scene.header.origin[i]);
    this.renderer.render(this.scene, { rotation, eye, width: width_px, height: height_px, fx: fx_px, fy: fy_px, cx: cx_px, cy: cy_px },
      { light: this.lamp, maxAtoms: this.maxAtoms, mostSplats, section: this.section.box });
    return this.renderer.pixels();
  }

  // Groups in the order in which they are wanted: coarse levels first, then those in view, the nearest first. Of levels those that the view
  // asks for, and all above them.
  wanted() {
    const { scene } = this, { groupBoxes: boxes, packed, tree } = scene, { eye, rows } = this.camera;
    const groups = Array.from({ length: packed.nGroups }, (_, group) => group);
    const far = groups.map((group) => {
      const to = [0, 1, 2].map((i) => (boxes[6 * group + i] + boxes[6 * group + 3 + i]) / 2 - eye[i]), away = Math.hypot(...to);
      return away * (dot(to, rows[2]) > 0.5 * away ? 1 : 10);
    });
    if (!tree) return groups.sort((a, b) => far[a] - far[b]);
    const view = this.camera.view(...this.size(1)), seen = new Set(visibleGroups(scene, view)), wanted = new Set();
    const shares = sharesOf(tree, view, { mostSplats: this.budget, isSeen: (group) => seen.has(group) });
    for (let group = packed.nGroups - 1; group >= 0; --group) {
      if ((shares[group] > 0 && seen.has(group)) || tree.level[group] === 0) wanted.add(group);
      if (wanted.has(group) && tree.parent[group] >= 0) wanted.add(tree.parent[group]), tree.children[tree.parent[group]].forEach((c) => seen.has(c) && wanted.add(c));
    }
    return [...wanted].sort((a, b) => tree.level[a] - tree.level[b] || far[a] - far[b]);
  }

  // --- words

  statistics() {
    const { source, scene, renderer } = this, view = this.shownView();
    return { splats: this.splats, allSplats: scene.header.n_splats, received: source.received, size: source.size, requests: source.requests, first: this.first, checked: scene.seals.checked,
      frameMs: this.frameMs, gpuBytes: scene.bytes, pixels: view.width * view.height, complete: !!this.complete, times: this.times,
      programs: [...renderer.programs.keys()], clipControl: !!renderer.clip };
  }

  say() {
    const s = this.statistics(), count = (n) => (n >= 1e6 ? (n / 1e6).toFixed(2) + " M" : n.toLocaleString("en"));
    $("statistics").textContent = `${count(s.splats)} of ${count(s.allSplats)} splats · ${(Math.min(s.received, s.size) / 1e6).toFixed(1)} of ${(s.size / 1e6).toFixed(1)} MB`
      + ` · ${s.frameMs.toFixed(0)} ms a frame`;
    $("loading").hidden = s.complete;
    $("loading").value = s.received / s.size;
  }

  toAddress() {
    history.replaceState(null, "", `#c=${this.camera.toText()}`);
  }

  fromAddress() {
    const found = /[#&]c=([^&]*)/.exec(location.hash);
    return !!found && this.camera.fromText(found[1]);
  }
}
