// A view as the shaders take it, and which groups reach into it, are wanted for it, and in which order.

import { sharesOf } from "./detail.js";
import { dot } from "./vectors.js";

export const NEAR_IN_RADII = 0.01;
const SPARE_PX = 1;

/** The uniform block `View` of shaders/view.glsl; mirrors renderer/splats/projection.py. */
export function viewBlock({ rotation, eye, fx, fy, cx, cy, width, height }, { radius, margin_radii }) {
  const block = new Float32Array(28), high = eye.map(Math.fround);
  rotation.forEach((row, i) => block.set(row, 4 * i));
  block.set(high, 12);
  block.set(eye.map((e, i) => e - high[i]), 16);
  block.set([fx, fy, cx, cy, width, height, NEAR_IN_RADII * radius, margin_radii], 20);
  return block;
}

/** Groups whose boxes reach into a view, as shaders/cull.comp.glsl tells them. */
export function visibleGroups(scene, { rotation, eye, fx, fy, cx, cy, width, height }) {
  const planes = [[0, 0, 1], [fx, 0, cx + SPARE_PX], [-fx, 0, width - cx + SPARE_PX], [0, fy, cy + SPARE_PX], [0, -fy, height - cy + SPARE_PX]]
    .map((plane) => [0, 1, 2].map((i) => plane[0] * rotation[0][i] + plane[1] * rotation[1][i] + plane[2] * rotation[2][i]));
  const groups = [], boxes = scene.groupBoxes;
  const { nGroups } = scene.packed;
  for (let group = 0, at = 0; group < nGroups; ++group, at += 6) {
    const inside = planes.every((inward) => {
      let reach = 0;
      for (let i = 0; i < 3; ++i) reach += inward[i] * (boxes[at + (inward[i] > 0 ? 3 : 0) + i] - eye[i]);
      return reach >= 0;
    });
    if (inside) groups.push(group);
  }
  return groups;
}

/**
 * Groups in the order in which they are wanted: coarse levels first, then those in view, the nearest first. Of levels those that the view
 * asks for, and all above them.
 */
export function wantedGroups(scene, { eye, rows }, view, mostSplats) {
  const { groupBoxes: boxes, packed, tree } = scene;
  const groups = Array.from({ length: packed.nGroups }, (_, group) => group);
  const far = groups.map((group) => {
    const to = [0, 1, 2].map((i) => (boxes[6 * group + i] + boxes[6 * group + 3 + i]) / 2 - eye[i]), away = Math.hypot(...to);
    return away * (dot(to, rows[2]) > 0.5 * away ? 1 : 10);
  });
  if (!tree) return groups.sort((a, b) => far[a] - far[b]);
  const seen = new Set(visibleGroups(scene, view)), wanted = new Set();
  const shares = sharesOf(tree, view, { mostSplats, isSeen: (group) => seen.has(group) });
  for (let group = packed.nGroups - 1; group >= 0; --group) {
    if ((shares[group] > 0 && seen.has(group)) || tree.level[group] === 0) wanted.add(group);
    if (wanted.has(group) && tree.parent[group] >= 0) wanted.add(tree.parent[group]), tree.children[tree.parent[group]].forEach((c) => seen.has(c) && wanted.add(c));
  }
  return [...wanted].sort((a, b) => tree.level[a] - tree.level[b] || far[a] - far[b]);
}
