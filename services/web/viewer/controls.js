// Mouse, touch, pen and keyboard moving a camera.

const TURN = 0.005; // radians a px
const WHEEL = 0.0015; // of the logarithm of the distance a px
const FLIGHT = 0.6, FAST = 4; // of the distance a second; with Shift
const KEY_TURN = 1.2; // radians a second
const TAP_PX = 6;
const TAP_S = 1 / 30; // what a key does at once, however short it is held
const FLYING = { KeyW: [0, 0, 1], KeyS: [0, 0, -1], KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyE: [0, 1, 0], KeyQ: [0, -1, 0] };
const TURNING = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

/** `moved()` is called after each change, `tapped(x, y, twice)` for a click or tap, in CSS px of the canvas; `view()` is the one on the canvas. */
export class Controls {
  constructor(canvas, camera, { moved, tapped, view }) {
    Object.assign(this, { canvas, camera, moved, tapped, view, pointers: new Map(), held: new Set(), fast: false, time: 0 });
    canvas.addEventListener("pointerdown", (event) => this.down(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => this.up(event));
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("dblclick", (event) => this.tapped(event.offsetX, event.offsetY, true));
    canvas.addEventListener("keydown", (event) => this.key(event, true));
    canvas.addEventListener("keyup", (event) => this.key(event, false));
    canvas.addEventListener("blur", () => this.held.clear());
  }

  get isMoving() {
    return this.held.size > 0 || this.pointers.size > 0;
  }

  down(event) {
    this.canvas.focus({ preventScroll: true });
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, { x: event.offsetX, y: event.offsetY, from: [event.offsetX, event.offsetY] });
  }

  move(event) {
    const pointer = this.pointers.get(event.pointerId);
    if (!pointer) return;
    const right = event.offsetX - pointer.x, down = event.offsetY - pointer.y;
    const other = [...this.pointers].find(([id]) => id !== event.pointerId)?.[1];
    const scale = this.view().width / this.canvas.clientWidth; // a picture's px to one of CSS
    if (other) {
      const before = Math.hypot(pointer.x - other.x, pointer.y - other.y), now = Math.hypot(event.offsetX - other.x, event.offsetY - other.y);
      this.camera.pan((right / 2) * scale, (down / 2) * scale, this.view());
      if (before > 0 && now > 0) this.camera.dolly(before / now);
    } else if (event.buttons & 6 || event.shiftKey) {
      this.camera.pan(right * scale, down * scale, this.view());
    } else {
      this.camera.orbit(right * TURN, down * TURN);
    }
    Object.assign(pointer, { x: event.offsetX, y: event.offsetY });
    if (right || down) this.moved();
  }

  up(event) {
    const pointer = this.pointers.get(event.pointerId);
    this.pointers.delete(event.pointerId);
    if (!pointer || this.pointers.size) return;
    this.moved();
    const [x, y] = pointer.from;
    if (event.type === "pointerup" && Math.hypot(event.offsetX - x, event.offsetY - y) < TAP_PX && event.button === 0) this.tapped(x, y, false);
  }

  wheel(event) {
    event.preventDefault();
    this.camera.dolly(Math.exp(event.deltaY * (event.deltaMode === 1 ? 16 : 1) * WHEEL));
    this.moved();
  }

  key(event, pressed) {
    this.fast = event.shiftKey;
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.code in FLYING || event.code in TURNING || ["+", "-", "="].includes(event.key)) {
      event.preventDefault();
      const name = event.code in FLYING || event.code in TURNING ? event.code : event.key === "-" ? "-" : "+";
      if (!pressed) this.held.delete(name);
      else if (!this.held.has(name)) {
        this.held.add(name);
        this.time = performance.now();
        this.go(name, TAP_S);
        this.moved();
      }
    }
  }

  /** Go on with what keys that are held do; whether there are any. */
  step(now) {
    const seconds = Math.min(0.1, Math.max(0, now - this.time) / 1000);
    this.time = now;
    for (const name of this.held) this.go(name, seconds);
    return this.held.size > 0;
  }

  go(name, seconds) {
    const flight = FLIGHT * seconds * (this.fast ? FAST : 1);
    if (name in FLYING) this.camera.fly(...FLYING[name].map((x) => x * flight));
    else if (name in TURNING) this.camera.turn(...TURNING[name].map((x) => x * KEY_TURN * seconds));
    else this.camera.dolly(Math.exp((name === "-" ? 1 : -1) * seconds));
  }
}
