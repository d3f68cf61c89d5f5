"""Dictionary learning by k-SVD as a map-reduce: sums over blocks of patches, merged over a fixed tree.

Papers: HPG 2021, section 3.3; Aharon et al. 2006. For all atoms at once, one power iteration on the residual matrices
E_k = {r_i + x_ik d_k} is one pass over the patches, with r_i = y_i - D x_i:

    v_ik = r_i . u_k + x_ik (d_k . u_k),        u_k <- sum_i v_ik r_i + (sum_i v_ik x_ik) d_k

Weights that are the least squares of their support leave r_i orthogonal to its atoms, so the first iteration, which
starts at u_k = d_k, has v_ik = x_ik and needs no product with r_i. No atom's inputs are gathered anywhere.

The paper's guarantee, an error that never rises, holds for one atom at a time. Moved side by side from one old
dictionary, n atoms that always occur together each mend the same residual and overshoot n times; coding mends most of
that, not all. So every dictionary is a trial, which the next pass over the patches measures anyway, and the best so far
is kept aside. Learning goes on from a trial that did a little worse (on such scans that ended 2 % better than taking it
back), but one that did much worse gives way to the best, from which the atoms set out again half as far. That costs no
pass where errors fall, and one pass each time they do not.

Atoms also go on by half of their last move (Polyak 1964): on `monstree` 6 passes then do what 12 did, on `fountain_p11`
5 what 8 did. With two thirds of it the first passes did worse, and steps that were longer by half overshot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pipeline.coding.coherence import coherent_with_earlier, distinct_directions
from pipeline.coding.omp import Pursuit, pursue_patches
from pipeline.coding.omp_kernels import squared_norms, subtract_rows
from pipeline.execution.compiled import FAST, kernel, part

BLOCK = 2048  # patches whose sums are made in one go; part of the result, as float sums depend on their order
WORST = 512  # how many badly represented patches a block offers as replacements
TOLERATED_RISE = 0.05  # of the error over the best so far, before a trial is taken back
MERGED_ATOMS = 4096  # whose moments are merged at a time
MOMENTUM = 0.5  # share of an atom's last move that it goes on by
SAME_ATOM = 0.7  # cosine above which an atom moved, and was not replaced
FEWEST_USERS = 4  # an atom with fewer users is replaced (as KSVD-Box)


@dataclass(frozen=True)
class Sums:
    """What a block of patches says about the dictionary; small, and independent of how many patches there are."""

    moment: (
        np.ndarray
    )  # (k, d): sum of v_ik r_i, float32 of a block, float64 once merged; (0, d) where it lies elsewhere
    gain: np.ndarray  # (k,) float64: sum of v_ik x_ik
    n_users: np.ndarray  # (k,) int64
    error: float  # sum of squared residuals
    n_patches: int
    worst_error: np.ndarray  # (<= WORST,) float64, descending
    worst_patch: np.ndarray  # (<= WORST, d) float32, unit rows


def initial_dictionary(patches: np.ndarray, n_atoms: int, seed: int) -> np.ndarray:
    """A random choice of the patches themselves, normalised, no two of them coherent (`coherence`); (m, d) float32 with
    m <= n_atoms unit rows.

    Fewer than `n_atoms` where there are fewer different patches.
    """
    order = np.random.default_rng(seed).permutation(len(patches))
    return distinct_directions(patches[order], np.empty((0, patches.shape[1]), np.float32), n_atoms)


def block_sums(patches: np.ndarray, dictionary: np.ndarray, pursuit: Pursuit) -> Sums:
    """The sums of one block. `patches` (n, d) float32 and what their pursuit in `dictionary` found."""
    codes, error = pursuit.codes, pursuit.residual
    n_atoms, dim = dictionary.shape
    moment = np.zeros((n_atoms, dim), np.float32)
    gain, n_users = np.zeros(n_atoms), np.zeros(n_atoms, np.int64)
    _accumulate(patches, dictionary, codes.atom_index, codes.weight, codes.n_atoms, moment, gain, n_users)
    worst = np.argsort(-error, kind="stable")[:WORST]
    rows = np.array(patches[worst], np.float32, copy=None)
    rows /= np.maximum(np.sqrt(squared_norms(rows)), np.finfo(np.float32).tiny).astype(np.float32)[:, None]
    return Sums(moment, gain, n_users, float(error.sum()), len(patches), error[worst], rows)


def merge_sums(a: Sums, b: Sums) -> Sums:
    """The sums of two runs of blocks; `a` comes before `b`."""
    error = np.concatenate([a.worst_error, b.worst_error])
    keep = np.argsort(-error, kind="stable")[:WORST]
    patch = np.concatenate([a.worst_patch, b.worst_patch])
    return Sums(
        np.add(a.moment, b.moment, dtype=np.float64),
        a.gain + b.gain,
        a.n_users + b.n_users,
        a.error + b.error,
        a.n_patches + b.n_patches,
        error[keep],
        patch[keep],
    )


def merge_in_order(load: Callable[[int], Sums], start: int, stop: int) -> Sums:
    """The sums of the blocks start..stop over a fixed tree: the result depends on the blocks' order alone.

    Holds as many blocks' sums at once as the tree is deep.
    """
    if stop - start == 1:
        return load(start)
    middle = (start + stop) // 2
    return merge_sums(merge_in_order(load, start, middle), merge_in_order(load, middle, stop))


def merge_moments(load: Callable[[int, slice], np.ndarray], n_blocks: int, shape: tuple[int, int]) -> np.ndarray:
    """The moments (k, d) of all blocks over the tree of `merge_in_order`, and its very bytes, a range of atoms at a
    time: `load(block, atoms)` is asked for no more than that, so that beside the result little is held."""
    merged = np.empty(shape)
    for start in range(0, shape[0], MERGED_ATOMS):
        atoms = slice(start, start + MERGED_ATOMS)
        merged[atoms] = _tree_sum(lambda block, atoms=atoms: load(block, atoms), 0, n_blocks)  # type: ignore[misc]
    return merged


def _tree_sum(load: Callable[[int], np.ndarray], start: int, stop: int) -> np.ndarray:
    if stop - start == 1:
        return load(start)
    middle = (start + stop) // 2
    return np.add(_tree_sum(load, start, middle), _tree_sum(load, middle, stop), dtype=np.float64)


def updated_dictionary(
    dictionary: np.ndarray, sums: Sums, step: float = 1.0, replace_unused: bool = True, before: np.ndarray | None = None
) -> tuple[np.ndarray, int]:
    """The dictionary after one update, and how many atoms were replaced. All atoms move from the same old ones.

    With a `step` below 1 they go only that share of the way; without `replace_unused` only coherent atoms are replaced.
    `before` is the dictionary (k, d) that this one came from: atoms go on in the direction that they came.

    Guarantees: unit rows, float32; an atom hardly used, or coherent with an earlier one, becomes one of the worst
    represented patches; no two become the same.
    """
    fewest = min(FEWEST_USERS, max(1, sums.n_patches // len(dictionary))) if replace_unused else 0
    used = sums.n_users >= fewest
    updated, norms = np.array(dictionary, np.float32), np.empty(len(dictionary))
    _move(dictionary, step, sums.moment, sums.gain, used, updated, norms)
    alive = used & ((norms > 0) | (fewest == 0))
    if before is not None:
        updated = _carried_on(updated, dictionary, before)
    alive &= ~coherent_with_earlier(updated, alive)
    vacant = np.flatnonzero(~alive)
    if not len(vacant):
        return updated, 0
    fresh = distinct_directions(sums.worst_patch, updated[alive], len(vacant))
    updated[vacant[: len(fresh)]] = fresh
    return updated, len(fresh)


@kernel(fastmath={"nsz", "reassoc", "contract"})
def _move(dictionary, step, moment, gain, used, updated, norms):
    """Atoms in use where the sums take them, as unit rows; and how long they were before, where none was no
    direction."""
    width = np.uintp(dictionary.shape[1])
    for a in range(dictionary.shape[0]):
        total = 0.0
        for d in range(width):
            moved = step * moment[a, d] + gain[a] * dictionary[a, d]
            total += moved * moved
        norms[a] = np.sqrt(total)
        if not used[a] or norms[a] == 0:
            continue
        scale = 1.0 / norms[a]
        for d in range(width):
            updated[a, d] = np.float32((step * moment[a, d] + gain[a] * dictionary[a, d]) * scale)


def _carried_on(updated: np.ndarray, dictionary: np.ndarray, before: np.ndarray) -> np.ndarray:
    """Atoms that were no others the last two times, further by a share of their move from `before` to `dictionary`."""
    goes_on = ((updated * dictionary).sum(axis=1) > SAME_ATOM) & ((dictionary * before).sum(axis=1) > SAME_ATOM)
    further = updated + np.where(goes_on, np.float32(MOMENTUM), np.float32(0))[:, None] * (dictionary - before)
    return (further / np.linalg.norm(further, axis=1, keepdims=True)).astype(np.float32)


@dataclass(frozen=True)
class Best:
    """The dictionary that did best so far, what a pass measured of it, and how far its atoms may go at once."""

    dictionary: np.ndarray
    sums: Sums
    step: float = 1.0


def judge(best: Best | None, dictionary: np.ndarray, sums: Sums) -> tuple[Best, bool]:
    """The better of `best` and a dictionary just measured, and whether that is the new one.

    Guarantees: the error of what is returned never rises from call to call; the step halves where the new one did much
    worse, and never grows again.
    """
    if best is None or sums.error <= best.sums.error:
        return Best(dictionary, sums, best.step if best else 1.0), True
    return Best(best.dictionary, best.sums, best.step if _is_near(best, sums) else best.step / 2), False


def next_trial(best: Best, dictionary: np.ndarray, before: np.ndarray | None, sums: Sums) -> tuple[np.ndarray, int]:
    """The dictionary to measure next, and how many of its atoms are replacements: an update of the one just measured,
    which came from the one `before`, or, where it did much worse, of the best; then unused atoms stay, as their
    replacements may have done the harm. Atoms go on from a trial that did best so far alone: where errors rise, they
    went too far."""
    if _is_near(best, sums):
        return updated_dictionary(dictionary, sums, before=before if sums.error <= best.sums.error else None)
    return updated_dictionary(best.dictionary, best.sums, best.step, replace_unused=False)


def _is_near(best: Best, sums: Sums) -> bool:
    return sums.error <= (1 + TOLERATED_RISE) * best.sums.error


def learn_dictionary(
    patches: np.ndarray,  # (n, patch_dim)
    n_atoms: int,
    *,
    max_atoms: int = 8,
    tolerance: float | np.ndarray = 0.0,
    iterations: int = 10,
    seed: int = 0,
    on_iteration: Callable[[int, float], None] = lambda iteration, mean_squared_error: None,
) -> np.ndarray:
    """Learn unit atoms (m, patch_dim) float32 from patches; m is `n_atoms`, or fewer where patches are too alike.

    `tolerance` is the cut-off of `sparse_encode`, a squared residual norm, for all patches or one each. `on_iteration`
    gets the mean squared residual norm of the best dictionary so far, each iteration before its update and once more at
    the end. The stages of the pipeline run these same sums block by block.

    Guarantees: same patches and seed, same dictionary; unit atoms; what `on_iteration` gets never rises, and the last
    is that of the dictionary returned.
    Raises ValueError as `sparse_encode`, and where no patch differs from zero.
    """
    patches = np.ascontiguousarray(patches, np.float32)
    dictionary = initial_dictionary(patches, n_atoms, seed)
    if not len(dictionary):
        raise ValueError(f"none of the {len(patches)} patches differs from zero: there is nothing to learn")
    best = before = None
    for iteration in range(iterations + 1):
        sums = _measured(patches, dictionary, max_atoms, tolerance)
        best, _ = judge(best, dictionary, sums)
        on_iteration(iteration, best.sums.error / best.sums.n_patches)
        if iteration < iterations:
            before, (dictionary, _) = dictionary, next_trial(best, dictionary, before, sums)
    return best.dictionary


def _measured(patches: np.ndarray, dictionary: np.ndarray, max_atoms: int, tolerance: float | np.ndarray) -> Sums:
    """What one pass over all patches says of a dictionary."""
    blocks = []
    tolerance = np.broadcast_to(np.asarray(tolerance, np.float64), len(patches))
    for start in range(0, len(patches), BLOCK):
        part = slice(start, start + BLOCK)
        pursuit = pursue_patches(
            patches[part], dictionary, max_atoms=min(max_atoms, len(dictionary)), tolerance=tolerance[part]
        )
        blocks.append(block_sums(patches[part], dictionary, pursuit))
    return merge_in_order(blocks.__getitem__, 0, len(blocks))


@part(fastmath={"contract"})
def _add_to_row(table, atom, row, x):
    a = np.uintp(atom)
    for d in range(np.uintp(row.shape[0])):
        table[a, d] += x * row[d]


@part(fastmath=FAST)
def _leave(row, patch, dictionary, support, weight, n):
    """row = patch - sum of weight_j * dictionary[support_j], n of them, at least one: the first four on the way, those
    there are not as the last with no weight. Rows that come from far caches are what costs."""
    last = n - 1
    a, b, c, d = (
        np.uintp(support[0]),
        np.uintp(support[min(1, last)]),
        np.uintp(support[min(2, last)]),
        np.uintp(support[min(3, last)]),
    )
    wa, wb = np.float32(weight[0]), np.float32(weight[1] if last > 0 else 0.0)
    wc, wd = np.float32(weight[2] if last > 1 else 0.0), np.float32(weight[3] if last > 2 else 0.0)
    for i in range(np.uintp(row.shape[0])):
        row[i] = patch[i] - (
            (wa * dictionary[a, i] + wb * dictionary[b, i]) + (wc * dictionary[c, i] + wd * dictionary[d, i])
        )
    if n > 4:
        subtract_rows(row, dictionary, support[4:], weight[4:], n - 4)


@kernel()
def _accumulate(patches, dictionary, atom_index, weight, n_atoms, moment, gain, n_users):
    """Add each patch's share to the sums of its atoms, with v_ik = x_ik. The residual lives for its patch alone: a
    matrix of them, written and read again, took twice as long."""
    residual = np.empty(patches.shape[1], np.float32)
    for i in range(patches.shape[0]):
        if n_atoms[i] == 0:
            continue
        _leave(residual, patches[i], dictionary, atom_index[i], weight[i], n_atoms[i])
        for t in range(n_atoms[i]):
            atom, x = atom_index[i, t], weight[i, t]
            _add_to_row(moment, atom, residual, x)
            gain[atom] += np.float64(x) * x
            n_users[atom] += 1
