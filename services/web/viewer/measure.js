// Points picked on the surface: the distance between two, the angle and the area of more; drawn over the picture, told in the scan's unit.

import { add, cross, dot, scaled } from "./vectors.js";

const SVG = "http://www.w3.org/2000/svg";
const MOST_POINTS = 26;

export class Measure {
  constructor(overlay, output, camera, header) {
    Object.assign(this, { overlay, output, camera, header, points: [] });
    this.say();
  }

  add(point) {
    this.points = [...this.points.slice(0, MOST_POINTS - 1), point];
    this.say();
  }

  /** Take the last point back. */
  undo() {
    this.points = this.points.slice(0, -1);
    this.say();
  }

  clear() {
    this.points = [];
    this.say();
  }

  /** Of the last two points: in a straight line, along the scan's up, and across it. Null with fewer. */
  get lengths() {
    if (this.points.length < 2) return null;
    const [from, to] = this.points.slice(-2), between = add(to, from, -1), height = dot(between, this.camera.up);
    return { distance: Math.hypot(...between), height, level: Math.hypot(...add(between, this.camera.up, -height)) };
  }

  /** Along all points; the angle at the last but one in degrees; the area that they surround, of the plane in which it is largest. Null below three. */
  get shape() {
    if (this.points.length < 3) return null;
    const sides = this.points.slice(1).map((point, i) => add(point, this.points[i], -1)), [before, after] = sides.slice(-2);
    const middle = scaled(this.points.reduce((sum, point) => add(sum, point)), 1 / this.points.length);
    const around = this.points.map((point) => add(point, middle, -1));
    const area = around.reduce((sum, point, i) => add(sum, cross(point, around[(i + 1) % around.length])), [0, 0, 0]);
    return {
      length: sides.reduce((sum, side) => sum + Math.hypot(...side), 0),
      angle: (Math.atan2(Math.hypot(...cross(before, after)), -dot(before, after)) * 180) / Math.PI,
      area: Math.hypot(...area) / 2,
    };
  }

  coordinates(point) {
    const decimals = Math.min(9, Math.max(0, Math.ceil(-Math.log10(this.header.radius)) + 1));
    return point.map((x, i) => (x + this.header.origin[i]).toFixed(decimals)).join(", ");
  }

  say() {
    const unit = { unknown: "units", metre: "m" }[this.header.unit] || this.header.unit, digits = (x) => Number(x.toPrecision(5));
    const name = (i) => String.fromCharCode(65 + i), last = this.points.length - 1, { lengths, shape } = this;
    const lines = this.points.map((point, i) => `${name(i)}: ${this.coordinates(point)}`).slice(-4);
    if (lengths) lines.push(`${name(last - 1)} to ${name(last)}: ${digits(lengths.distance)} ${unit}, up ${digits(lengths.height)} ${unit}, level ${digits(lengths.level)} ${unit}`);
    if (shape) lines.push(`angle at ${name(last - 1)}: ${digits(shape.angle)}°`, `A to ${name(last)} in all: ${digits(shape.length)} ${unit}, area ${digits(shape.area)} square ${unit}`);
    this.output.textContent = lines.length ? lines.join("\n") : "Choose points: click, tap, or Enter for the middle of the picture; Backspace takes one back.";
  }

  /** Over a picture of `view`, shown on a canvas of that many CSS px. */
  draw(view, width, height) {
    const at = this.points.map((point) => this.camera.project(point, view)?.map((x, i) => x * [width / view.width, height / view.height][i]));
    const lines = at.slice(1).map((to, i) => to && at[i] && shape("line", { x1: at[i][0], y1: at[i][1], x2: to[0], y2: to[1] }));
    this.overlay.replaceChildren(...lines.filter(Boolean), ...at.filter(Boolean).map(([x, y]) => shape("circle", { cx: x, cy: y, r: 5 })));
  }
}

function shape(name, attributes) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}
