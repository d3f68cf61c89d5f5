// Which groups of a file with levels are drawn in a view, and with what share; mirrors renderer/splats/detail.py. Where children that are
// in view have not arrived their parent stays, so there is never a hole.

import { GROUP } from "./packed.js";

const FEWER = 4;
const STANDS_IN = 2; // added to the share of a group that is drawn for want of its children, see shaders/detail.glsl
const COMES = 1.5 ** -0.5, GONE = 1.5 ** 0.5, COARSER = 2 ** 0.25, MOST_STEPS = 64;

/** The groups of all levels, the coarsest first: boxes and sizes that hold those of their children, parents, children; by the table of groups. */
export function groupTree({ header, nGroups }, { group_low: groupLow, group_high: groupHigh, group_radius: radius }) {
  const counts = header.levels.map((n) => Math.ceil(n / GROUP)), parent = new Int32Array(nGroups).fill(-1), level = new Uint8Array(nGroups);
  for (let i = 0, first = 0; i < counts.length; first += counts[i++]) {
    level.fill(i, first, first + counts[i]);
    if (i) for (let j = 0; j < counts[i]; ++j) parent[first + j] = first - counts[i - 1] + Math.min(Math.floor(j / FEWER), counts[i - 1] - 1);
  }
  const low = Float64Array.from(groupLow.subarray(0, 3 * nGroups)), high = Float64Array.from(groupHigh.subarray(0, 3 * nGroups));
  const size = Float64Array.from({ length: nGroups }, (_, group) => radius[2 * group]), children = Array.from({ length: nGroups }, () => []);
  const nSplats = Uint32Array.from({ length: nGroups }, (_, group) => Math.min(GROUP, header.n_splats - group * GROUP));
  for (let group = nGroups - 1; group >= 0; --group) { // the finest come first
    const above = parent[group];
    if (above < 0) continue;
    children[above].push(group);
    size[above] = Math.max(size[above], size[group]);
    for (let axis = 0; axis < 3; ++axis) {
      low[3 * above + axis] = Math.min(low[3 * above + axis], low[3 * group + axis]);
      high[3 * above + axis] = Math.max(high[3 * above + axis], high[3 * group + axis]);
    }
  }
  return { low, high, size, parent, level, children, nSplats, firstLeaf: nGroups - counts.at(-1) };
}

/**
 * The share of each group, 0 where it is not drawn, and how large splats come to look at most. `pixels` of a splat's radius are wanted, more of
 * them where else more than `mostSplats` of the groups that `isSeen` were drawn; 0 draws the finest level alone. Without `isHere` as if
 * all had arrived.
 */
export function sharesOf(tree, view, { pixels = 1, mostSplats = Infinity, isSeen = () => true, isHere = null } = {}) {
  const look = pixelsOf(tree, view);
  let wanted = pixels, shares = cut(tree, look, wanted, isHere, isSeen);
  if (mostSplats === Infinity) return shares;
  wanted ||= look.subarray(tree.firstLeaf).reduce((least, x) => Math.min(least, x), Infinity);
  for (let step = 0; step < MOST_STEPS; ++step) {
    const n = shares.reduce((sum, share, group) => sum + (share > 0 && isSeen(group) ? tree.nSplats[group] : 0), 0);
    if (n <= mostSplats) break;
    shares = cut(tree, look, (wanted *= COARSER), isHere, isSeen);
  }
  return shares;
}

function pixelsOf({ low, high, size }, { eye, fx, fy }) {
  return Float64Array.from(size, (s, group) => {
    const off = eye.map((e, axis) => Math.max(0, low[3 * group + axis] - e, e - high[3 * group + axis]));
    return (Math.max(fx, fy) * s) / Math.hypot(...off);
  });
}

function cut({ parent, children, firstLeaf }, look, wanted, isHere, isSeen) {
  const refined = new Float32Array(look.length), shares = new Float32Array(look.length);
  for (let group = 0; group < look.length; ++group) { // parents come first
    const above = parent[group] < 0 ? 1 : refined[parent[group]];
    const share = wanted > 0 ? Math.min(1, Math.max(0, (look[group] / wanted - COMES) / (GONE - COMES))) : 1;
    const splits = group < firstLeaf && above > 0 && children[group].length > 0;
    const may = splits && (!isHere || children[group].every((child) => isHere(child) || !isSeen(child)));
    refined[group] = may ? share : 0;
    shares[group] = above * (1 - refined[group]) + (splits && !may && share > 0 ? STANDS_IN : 0);
  }
  return shares;
}
