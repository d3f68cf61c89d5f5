// Vectors of three, and rotations as rows: right, down, forward of a camera in the axes of the scan.

export const add = (a, b, t = 1) => a.map((x, i) => x + t * b[i]);
export const scaled = (a, t) => a.map((x) => x * t);
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const unit = (a) => scaled(a, 1 / Math.hypot(...a));

/** `v` turned by `angle` about the unit vector `axis` (Rodrigues). */
export function turned(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), along = dot(axis, v) * (1 - c), across = cross(axis, v);
  return v.map((x, i) => x * c + across[i] * s + axis[i] * along);
}

/** Rows of a camera that looks along `forward` with `up` towards the top. */
export function looking(forward, up) {
  const ahead = unit(forward);
  let right = cross(ahead, up);
  if (Math.hypot(...right) < 1e-6) right = cross(ahead, Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]);
  right = unit(right);
  return [right, cross(ahead, right), ahead];
}

/** Rows made orthonormal again, `forward` kept: rounding adds up over thousands of turns. */
export function squared([right, , forward]) {
  const ahead = unit(forward), across = unit(add(right, ahead, -dot(right, ahead)));
  return [across, cross(ahead, across), ahead];
}
