// Where one looks from: an eye against the scan's origin, rows right, down and forward, how far the point lies that one turns about, and a lens.

import { upOf } from "./packed.js";
import { add, cross, dot, looking, scaled, squared, turned, unit } from "./vectors.js";

const FIELD = (45 * Math.PI) / 180, HEIGHT = (20 * Math.PI) / 180, STRAYS = 0.02, TRIMMED = 0.1, LONGEST_TAIL = 1.3, MARGIN = 1.08, FRAMED_FROM = 8; // as renderer/splats/views.py
const PLAIN_LENS = { width: 1, height: 1, fx: 0.5 / Math.tan(FIELD / 2), fy: 0.5 / Math.tan(FIELD / 2), cx: 0.5, cy: 0.5 };
const CLOSEST_TO_UP = 0.02; // radians that turning keeps from looking straight up or down

export class Camera {
  constructor(scene) {
    this.header = scene.header;
    this.up = upOf(scene.header);
    this.corners = bulkOf(scene);
    this.middle = [0, 1, 2].map((i) => (extreme(this.corners, i, 1) + extreme(this.corners, i, -1)) / 2);
    this.nearest = 4 * scene.header.radius;
    this.home();
  }

  /** The view that `splatpress render --orbit` begins with. */
  home() {
    const { cameras, origin, ahead } = this.header;
    let towards = ahead;
    if (cameras.length) {
      const mean = [0, 1, 2].map((i) => cameras.reduce((sum, c) => sum + c.centre[i], 0) / cameras.length - origin[i] - this.middle[i]);
      const level = add(mean, this.up, -dot(mean, this.up));
      if (Math.hypot(...level) > 1e-6 * Math.hypot(...mean)) towards = level;
    }
    const start = unit(towards), side = cross(this.up, start), from = Array.from({ length: FRAMED_FROM }, (_, i) => (2 * Math.PI * i) / FRAMED_FROM);
    const outwards = from.map((a) => add(scaled(add(scaled(start, Math.cos(a)), side, Math.sin(a)), Math.cos(HEIGHT)), this.up, Math.sin(HEIGHT)));
    const [out] = outwards;
    this.distance = Math.max(this.header.radius, ...outwards.map((way) => this.framing(way)));
    this.eye = add(this.middle, out, this.distance);
    this.rows = looking(scaled(out, -1), this.up);
    this.lens = PLAIN_LENS;
  }

  /** How far along `out` all of the bulk is in a square picture; as _framing_distance of renderer/splats/views.py. */
  framing(out) {
    const [right, down] = looking(scaled(out, -1), this.up), most = Math.tan(FIELD / 2) / MARGIN;
    const distance = (off) => Math.max(Math.abs(dot(off, right)), Math.abs(dot(off, down))) / most + dot(off, out);
    return this.corners.reduce((far, corner) => Math.max(far, distance(add(corner, this.middle, -1))), 0);
  }

  /** Where a photograph was taken. */
  stand(photo) {
    this.eye = photo.centre.map((x, i) => x - this.header.origin[i]);
    this.rows = squared(photo.rotation);
    this.distance = Math.max(dot(add(this.middle, this.eye, -1), this.rows[2]), this.nearest);
    this.lens = { width: photo.width_px, height: photo.height_px, fx: photo.fx_px, fy: photo.fy_px, cx: photo.cx_px, cy: photo.cy_px };
  }

  /** Where a laser station stood, looking level along the scan's `ahead`. */
  standAt(centre) {
    this.eye = centre.map((x, i) => x - this.header.origin[i]);
    this.rows = looking(add(this.header.ahead, this.up, -dot(this.header.ahead, this.up)), this.up);
    this.distance = Math.max(Math.hypot(...add(this.middle, this.eye, -1)), this.nearest);
    this.lens = PLAIN_LENS;
  }

  /** What the renderer takes, for a picture of that size: all that the lens sees, and more to two sides where the shape differs. */
  view(width, height) {
    const { lens } = this, s = Math.min(width / lens.width, height / lens.height);
    return { rotation: this.rows, eye: this.eye, width, height, fx: lens.fx * s, fy: lens.fy * s,
      cx: width / 2 + (lens.cx - lens.width / 2) * s, cy: height / 2 + (lens.cy - lens.height / 2) * s };
  }

  get pivot() {
    return add(this.eye, this.rows[2], this.distance);
  }

  /** Around the point that one turns about; radians to the right and down. */
  orbit(right, down) {
    const pivot = this.pivot;
    this.turn(right, down);
    this.eye = add(pivot, this.rows[2], -this.distance);
  }

  /** Where one stands. */
  turn(right, down) {
    const pitch = Math.acos(Math.min(1, Math.max(-1, dot(this.rows[2], this.up))));
    const room = down > 0 ? Math.max(0, Math.PI - CLOSEST_TO_UP - pitch) : -Math.max(0, pitch - CLOSEST_TO_UP);
    const tilt = Math.abs(down) < Math.abs(room) ? down : room;
    const level = this.rows.map((row) => turned(row, this.up, -right));
    this.rows = squared(level.map((row) => turned(row, level[0], -tilt)));
  }

  /** Sideways in px of a picture `height` px high, so that what one turns about stays under the pointer. */
  pan(right, down, view) {
    const step = this.distance / view.fx;
    this.eye = add(add(this.eye, this.rows[0], -right * step), this.rows[1], -down * step);
  }

  /** Nearer by that factor. */
  dolly(factor) {
    const closer = Math.max(this.distance * factor, this.nearest);
    this.eye = add(this.eye, this.rows[2], this.distance - closer);
    this.distance = closer;
  }

  /** By shares of the distance: to the right, up, ahead. */
  fly(right, up, ahead) {
    this.eye = add(add(add(this.eye, this.rows[0], right * this.distance), this.up, up * this.distance), this.rows[2], ahead * this.distance);
  }

  /** Turn about that point from now on, without moving. */
  about(point) {
    this.distance = Math.max(dot(add(point, this.eye, -1), this.rows[2]), this.nearest);
  }

  /** Px of a point in a view; null behind the eye. */
  project(point, { rotation, eye, fx, fy, cx, cy }) {
    const [x, y, z] = rotation.map((row) => dot(row, add(point, eye, -1)));
    return z > 0 ? [(fx * x) / z + cx, (fy * y) / z + cy] : null;
  }

  // --- in an address: the eye in the scan's own numbers, forward and right, the distance

  toText() {
    const decimals = Math.max(0, Math.ceil(-Math.log10(this.header.radius)) + 1);
    const eye = this.eye.map((x, i) => (x + this.header.origin[i]).toFixed(Math.min(decimals, 12)));
    return [...eye, ...[...this.rows[2], ...this.rows[0]].map((x) => x.toFixed(4)), this.distance.toPrecision(4)].map((x) => String(x)).join(",");
  }

  /** Whether it was an address's. */
  fromText(text) {
    const numbers = text.split(",").map(Number);
    if (numbers.length !== 10 || !numbers.every(Number.isFinite)) return false;
    const forward = numbers.slice(3, 6), right = numbers.slice(6, 9);
    if (Math.hypot(...cross(forward, right)) < 0.5) return false;
    this.eye = numbers.slice(0, 3).map((x, i) => x - this.header.origin[i]);
    this.rows = squared([right, null, forward]);
    this.distance = Math.max(numbers[9], this.nearest);
    this.lens = PLAIN_LENS;
    return true;
  }
}

// The corners of the boxes that a picture of the whole shows; mirrors bulk_of of renderer/splats/views.py.
function bulkOf({ outline: { low, high, n }, header }) {
  const boxes = Array.from({ length: n }, (_, i) => i), centre = (i, axis) => (low[3 * i + axis] + high[3 * i + axis]) / 2;
  const quantile = (values, part) => {
    const sorted = Float64Array.from(values).sort(), place = part * (n - 1), i = Math.floor(place);
    return sorted[i] + (place - i) * (sorted[Math.min(i + 1, n - 1)] - sorted[i]);
  };
  const middle = [0, 1, 2].map((axis) => {
    const along = boxes.map((i) => centre(i, axis));
    return (quantile(along, TRIMMED) + quantile(along, 1 - TRIMMED)) / 2;
  });
  const off = (i) => Math.hypot(...middle.map((x, axis) => centre(i, axis) - x));
  const half = (i) => Math.hypot(...[0, 1, 2].map((axis) => high[3 * i + axis] - low[3 * i + axis])) / 2;
  const reach = boxes.map((i) => off(i) + half(i));
  const usual = Math.min(quantile(reach, 1 - STRAYS), LONGEST_TAIL * quantile(reach, 1 - TRIMMED));
  const most = header.effects.relighting?.lamp && !header.effects.relighting.strays ? Infinity : Math.max(usual, reach.reduce((a, b) => Math.min(a, b))); // a volume has no strays
  return boxes.filter((i) => reach[i] <= most).flatMap((i) => Array.from({ length: 8 }, (_, k) => [0, 1, 2].map((axis) => ((k >> axis) & 1 ? high : low)[3 * i + axis])));
}

function extreme(corners, axis, sign) {
  return sign * corners.reduce((most, corner) => Math.max(most, sign * corner[axis]), -Infinity);
}
