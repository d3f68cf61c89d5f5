// Points picked on the surface, and the distance between two of them: drawn over the picture, told in the scan's unit.

import { add, dot } from "./vectors.js";

const SVG = "http://www.w3.org/2000/svg";

export class Measure {
  constructor(overlay, output, camera, header) {
    Object.assign(this, { overlay, output, camera, header, points: [] });
    this.say();
  }

  /** A third point begins anew. */
  add(point) {
    this.points = this.points.length === 2 ? [point] : [...this.points, point];
    this.say();
  }

  clear() {
    this.points = [];
    this.say();
  }

  /** Of the two points: in a straight line, along the scan's up, and across it. Null with fewer. */
  get lengths() {
    if (this.points.length < 2) return null;
    const between = add(this.points[1], this.points[0], -1), height = dot(between, this.camera.up);
    return { distance: Math.hypot(...between), height, level: Math.hypot(...add(between, this.camera.up, -height)) };
  }

  coordinates(point) {
    const decimals = Math.min(9, Math.max(0, Math.ceil(-Math.log10(this.header.radius)) + 1));
    return point.map((x, i) => (x + this.header.origin[i]).toFixed(decimals)).join(", ");
  }

  say() {
    const unit = { unknown: "units", metre: "m" }[this.header.unit] || this.header.unit, digits = (x) => `${Number(x.toPrecision(5))} ${unit}`;
    const lines = this.points.map((point, i) => `${"AB"[i]}: ${this.coordinates(point)}`);
    const lengths = this.lengths;
    if (lengths) lines.push(`A to B: ${digits(lengths.distance)}, up ${digits(lengths.height)}, level ${digits(lengths.level)}`);
    this.output.textContent = lines.length ? lines.join("\n") : "Choose a point: click, tap, or Enter for the middle of the picture.";
  }

  /** Over a picture of `view`, shown on a canvas of that many CSS px. */
  draw(view, width, height) {
    const at = this.points.map((point) => this.camera.project(point, view)?.map((x, i) => x * [width / view.width, height / view.height][i]));
    const shapes = at.filter(Boolean).map(([x, y]) => shape("circle", { cx: x, cy: y, r: 5 }));
    if (at.length === 2 && at[0] && at[1]) shapes.unshift(shape("line", { x1: at[0][0], y1: at[0][1], x2: at[1][0], y2: at[1][1] }));
    this.overlay.replaceChildren(...shapes);
  }
}

function shape(name, attributes) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}
