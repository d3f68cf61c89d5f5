// A view at rest with all of its splats, however many there are: its groups go through the pool batch after batch, first for their depths, then for
// their colours, some of them in each frame of the browser, into targets that the canvas shows when they are whole. As renderer/residency/pooled.py.

import { sharesOf } from "./detail.js";
import { visibleGroups } from "./view.js";

const TARGET_MS = 50; // of what is drawn in one frame
const AT_ONCE = 16; // groups that are read together
const LEAST = 4; // slots for groups that the picture while one moves does not want

/** The groups of a view with at most `mostSplats` of the finest level, else of coarser ones, in the order of the file; and the shares of all groups. */
export function allOf(scene, view, mostSplats) {
  const seen = visibleGroups(scene, view), inView = new Set(seen);
  const shares = sharesOf(scene.tree, view, { pixels: 0, mostSplats, isSeen: (group) => inView.has(group) });
  return { groups: seen.filter((group) => shares[group] > 0), shares };
}

/**
 * Draw `groups` of `allOf` with their shares. `kept` are groups that stay in the pool, the most wanted first; `look` as `Renderer.render` takes it.
 * Ends with `signal`, after one more frame at the latest, by an error.
 */
export async function settle(scene, renderer, view, { groups, shares }, kept, look, signal, onProgress) {
  const { pool } = scene, places = pool.nSlots - 1; // the last group has its own
  const stay = kept.slice(0, Math.max(scene.nCoarsest, places - 2 * LEAST)), size = Math.min(AT_ONCE, (places - stay.length) >> 1);
  let batches = Array.from({ length: Math.ceil(groups.length / size) }, (_, i) => groups.slice(i * size, (i + 1) * size));
  const read = async (i) => {
    const some = batches[i] ?? [];
    pool.want([...stay, ...(batches[i - 1] ?? []), ...some]); // those that are still to be drawn, too
    for (let chunks; !signal.aborted && (chunks = scene.batch(some, scene.packed.ofGroups)).length;) await scene.read(chunks, () => {}, signal, undefined, true);
  };
  let atOnce = LEAST, done = 0, coming;
  const frame = async (draw, some) => {
    await new Promise(requestAnimationFrame);
    signal.throwIfAborted();
    const started = performance.now();
    scene.share(shares);
    renderer[draw](some);
    renderer.wait();
    atOnce = Math.max(1, Math.round(atOnce * Math.min(2, TARGET_MS / (performance.now() - started))));
    onProgress((done += some.length) / (2 * groups.length));
  };
  renderer.begin(scene, view, { ...look, wide: true });
  try {
    for (const draw of ["drawDepth", "drawColors"]) {
      coming = read(0);
      for (const [i, batch] of batches.entries()) {
        await coming;
        coming = read(i + 1);
        for (let at = 0; at < batch.length;) {
          const some = batch.slice(at, at + atOnce);
          at += some.length;
          await frame(draw, some);
        }
      }
      batches = batches.reverse(); // the last ones are still here
    }
  } finally {
    await coming?.catch(() => {}); // the pool is left alone from here on
  }
  return renderer.end(groups);
}
