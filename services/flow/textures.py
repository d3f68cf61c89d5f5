"""The order of the stages that code patches: average colours, what a dictionary is learned from, learning, the Lagrange
multiplier, codes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.coding.grid import SYMMETRIES, AtomForm
from pipeline.coding.passes import learning_pursuit, passes_as_coded, quantised_share, rounds_of_passes
from pipeline.execution.stage import StageRecord
from pipeline.numerics.accuracy import psnr_db, squared_error_at
from pipeline.planning.color_step import color_step
from pipeline.planning.dictionary_size import (
    FEWEST_INDEX_BITS,
    PATCHES_AN_ATOM,
    affordable_size,
    bits_for_codes,
    codes_bytes_a_splat,
    index_bits,
)
from pipeline.planning.settings import Settings
from pipeline.stages.texture.colors import Colors
from pipeline.stages.texture.dictionary import DictionarySeed, KsvdUpdate
from pipeline.stages.texture.encode import Encode
from pipeline.stages.texture.multipliers import WHILE_LEARNING, Multipliers, multiplier_for
from pipeline.stages.texture.quantise import Quantisation
from pipeline.stages.texture.training import HELD, MOST_HELD, Coefficients, Components, TrainingSet
from pipeline.summaries import AverageColors, CodesMade, Ladder, PatchesMade, Quantised, Training, Updated
from pipeline.texture.resample import PATCH_DIM
from renderer.report.document import LearningPass
from services.flow.run import Run
from storage.packed.dictionaries.shipped import ATOM_SIZE
from storage.packed.schema import ATOM_SIZES, PATCH_SIZE

SHIPPED_FORM = AtomForm(ATOM_SIZE, SYMMETRIES)  # of atoms that ship with the program
# Squared error of a scan at its target that atoms of a size may leave, whatever their number: 6 dB below it. 8 texels
# are then taken for fountain_p11 (51 dB), 16 for monstree (41 and 51 dB), each the better one there at the bytes of its
# target.
BEYOND_ATOMS = 0.25


@dataclass(frozen=True)
class Stop:
    """When a patch has enough atoms: at a squared error, or where the next lowers it by no more than the Lagrange
    multiplier."""

    tolerance: float
    multiplier: float = 0.0


@dataclass(frozen=True)
class Coded:
    """Splats with texture: what the settings of the coder decide."""

    patches: StageRecord[PatchesMade]
    colors: StageRecord[AverageColors]
    codes: StageRecord[CodesMade]
    quantised: StageRecord[Quantised] | None
    learning: tuple[LearningPass, ...]  # passes with exact weights; those as coded have errors of another kind
    n_dictionary: int
    safeguard_steps: int  # dictionaries that did worse than the best before them
    shipped: str = ""  # the dictionary that ships with the program, where that is the one


def code_patches(
    run: Run,
    patches: StageRecord[PatchesMade],
    settings: Settings,
    n_splats: int | None = None,
    most_texels: int = PATCH_SIZE,
    multiplier_of: Callable[[Ladder, Training], float] = multiplier_for,
    shipped: str = "",
) -> Coded:
    """Learn a dictionary if any patch calls for one, and code all patches; with as many atoms as a scan of `n_splats`
    pays for, where the patches are a sample of it, of `most_texels` to a side at most, where that is left to the scan.
    `multiplier_of(ladder, training)` is the Lagrange multiplier that patches are coded with; both are summaries.
    `shipped` names a dictionary that ships with the program, of which the atoms then are."""
    tolerance = squared_error_at(settings.target_psnr_db, PATCH_DIM)
    stop = Stop(tolerance) if settings.coder == "paper" else Stop(0.0, WHILE_LEARNING * tolerance)
    colors = run.do(Colors(patches.folder, color_step(settings)))
    map_texels = patches.summary.map_texels
    least, n_wanted = max(stop.tolerance, stop.multiplier), settings.training_splats + n_held(settings)
    training = run.do(TrainingSet(patches.folder, colors.folder, least, n_wanted, settings.seed, tolerance))
    if not (settings.max_atoms and training.summary.n_patches):
        return Coded(patches, colors, encode(run, patches.folder, colors.folder, None, settings), None, (), 0, 0)
    if map_texels is not None:
        most_texels = min(most_texels, min(ATOM_SIZES, key=lambda size: abs(np.log2(size / map_texels))))
    n_of_all = n_splats or training.summary.n_splats
    form = SHIPPED_FORM if shipped else _form(training.summary, settings, tolerance, most_texels, n_of_all)
    if form is None:
        space: StageRecord = run.do(Components(training.folder, tolerance * 10 ** (-settings.subspace_floor_db / 10)))
    else:
        space = run.do(Coefficients(training.folder, form.size))
    learning: tuple[LearningPass, ...] = ()
    if shipped:
        settled = settings.max_atoms, stop.tolerance, settings.weight_bits
        quantising = Quantisation(
            space.folder,
            None,
            *settled,
            multiplier=stop.multiplier,
            form=form,
            shipped=shipped,
            share=_quantised_share(space, form),
        )
        quantised, n_taken_back = run.do(quantising), 0
    else:
        bits = index_bits(settings, form, n_of_all, map_texels is not None)
        counted = n_of_all if form is not None and map_texels is None and settings.dictionary_bits == "auto" else None
        learned, learning = _learn(run, training, space, settings, stop, form, bits, counted)
        quantised, quantising, n_taken_back = _quantise_best(run, space, learned, settings, stop, form)
    n_taken_back += sum(not row.accepted for row in learning)
    multiplier = 0.0
    if form is not None:
        # Learning is at a lower multiplier than coding: levels for weights that are never used then are lost to others.
        quantising = replace(quantising, pursuit=settings.pursuit, chosen=training.folder)
        narrow = replace(settings, pursuit=learning_pursuit(settings.pursuit))
        ladder = _ladder(run, training, space, narrow, tolerance, quantised)
        if math.isfinite(multiplier := multiplier_of(ladder, training.summary)):
            if not shipped and (n_passes := passes_as_coded(settings.iterations)):
                # At the target's multiplier, so that all trials of a budget share these passes.
                price = multiplier_for(ladder, training.summary)
                priced = replace(quantising, multiplier=price, pursuit=narrow.pursuit)
                learned, n_worse = _learn_as_coded(run, priced, n_passes, settings.iterations)
                n_taken_back += n_worse
                last = "dictionary" if learned.summary.accepted else "best"
                quantising = replace(quantising, learned=learned.folder, learned_array=last)
            quantised = run.do(replace(quantising, multiplier=multiplier))
            ladder = _ladder(run, training, space, settings, tolerance, quantised)
            multiplier = multiplier_of(ladder, training.summary)
    codes = encode(run, patches.folder, colors.folder, quantised, settings, multiplier)
    return Coded(patches, colors, codes, quantised, learning, quantised.summary.n_atoms, n_taken_back, shipped)


def n_held(settings: Settings) -> int:
    """How many patches are chosen besides those that are learned from, to find the multiplier by."""
    return 0 if settings.coder == "paper" else min(HELD, int(settings.training_splats * MOST_HELD / (1 - MOST_HELD)))


def _form(training: Training, settings: Settings, tolerance: float, most_texels: int, n_splats: int) -> AtomForm | None:
    """The atoms of the default coder: of the fewest texels that show what the target asks for, of no more than views
    show, and of no more than the scan pays for; None for the paper's."""
    if settings.coder == "paper":
        return None
    share = training.n_active / training.n_splats
    fine = [s for s in ATOM_SIZES if training.beyond[str(s)] * share <= BEYOND_ATOMS * tolerance]
    if settings.atom_size != "auto":
        return AtomForm(int(settings.atom_size), SYMMETRIES)
    return AtomForm(min(*fine, most_texels, affordable_size(n_splats, settings.dictionary_bits)), SYMMETRIES)


def encode(
    run: Run, patches: Path, colors: Path, quantised: StageRecord | None, settings: Settings, multiplier: float = 0.0
) -> StageRecord[CodesMade]:
    """Code patches by a dictionary that is there; None gives every splat its average colour alone."""
    if settings.coder == "paper":
        tolerance = squared_error_at(settings.target_psnr_db, PATCH_DIM)
        return run.do(
            Encode(
                patches,
                colors,
                quantised.folder if quantised else None,
                settings.max_atoms,
                tolerance,
                search=settings.atom_search,
            )
        )
    form = AtomForm(quantised.summary.atom_size, quantised.summary.n_turns) if quantised else None
    return run.do(
        Encode(
            patches,
            colors,
            quantised.folder if quantised else None,
            settings.max_atoms,
            0.0,
            multiplier,
            form,
            settings.atom_search,
            settings.pursuit,
        )
    )


def _learn(
    run: Run,
    training: StageRecord[Training],
    space: StageRecord,
    settings: Settings,
    stop: Stop,
    form: AtomForm | None,
    bits: int,
    n_splats: int | None,
) -> tuple[StageRecord[Updated], tuple[LearningPass, ...]]:
    """The last iteration with exact weights, and the learning curve as estimates for the whole scan: of the best
    dictionary so far.

    Passes end early where one gains less than `least_gain_db`. Of `n_splats` there are fewer atoms than `bits` name
    where the codes that the first iteration counts do not pay for them.
    """
    seconds = 0.0  # of the passes as they were made, now or by an earlier run
    of_turns, n_patches = form or AtomForm(), space.summary.n_patches
    share, n_passes = rounds_of_passes(settings.iterations, n_patches)[0] if form else (1.0, settings.iterations)

    def updated(previous: Path, iteration: int) -> StageRecord[Updated]:
        stops = settings.max_atoms, stop.tolerance, iteration, stop.multiplier, of_turns
        return run.do(KsvdUpdate(space.folder, previous, *stops, share, _quantised_share(space, form)))

    def seeded(bits: int) -> Path:
        n_atoms = max(1, min(2**bits // of_turns.n_turns, n_patches // PATCHES_AN_ATOM))
        return run.do(DictionarySeed(space.folder, n_atoms, settings.seed, of_turns)).folder

    learned, first = seeded(bits), None
    if n_splats and bits > FEWEST_INDEX_BITS:
        first = updated(learned, 0)
        codes = codes_bytes_a_splat(bits + settings.weight_bits, training.summary, first.summary)
        if (fewer := bits_for_codes(form, bits, n_splats, codes)) < bits:
            learned, first = seeded(fewer), None
    curve: list[LearningPass] = []
    for iteration in range(n_passes):
        record = first if first and iteration == 0 else updated(learned, iteration)
        seconds += record.made_seconds
        learned, found = record.folder, record.summary
        curve.append(
            LearningPass(seconds, estimated_psnr_db(training.summary, found), found.n_replaced, found.accepted)
        )
        if _is_settled(curve, settings.least_gain_db):
            break
    return record, tuple(curve)


def _is_settled(curve: list[LearningPass], least_gain_db: float) -> bool:
    """Whether the last iteration was one that did better, by less than that."""
    if len(curve) < 2 or not curve[-1].accepted or curve[-1].psnr_db is None:
        return False
    return curve[-1].psnr_db - curve[-2].psnr_db < least_gain_db


def _quantised_share(space: StageRecord, form: AtomForm | None) -> float:
    """Of the training set, what quantising looks at; all for the paper's coder."""
    return 1.0 if form is None else quantised_share(space.summary.n_patches)


def _quantise_best(
    run: Run, space: StageRecord, learned: StageRecord[Updated], settings: Settings, stop: Stop, form: AtomForm | None
) -> tuple[StageRecord[Quantised], Quantisation, int]:
    """The better of the last dictionary and the best before it, in bytes, its stage, and whether (0 or 1) the last was
    taken back.

    Quantising codes patches of the training set once more, so the last dictionary, which no iteration has measured, is
    measured there. The one before it is quantised too only where the last looks worse.
    """
    settled, share = (settings.max_atoms, stop.tolerance, settings.weight_bits), _quantised_share(space, form)
    of_last, of_best = (
        Quantisation(space.folder, learned.folder, *settled, name, stop.multiplier, form, share=share)
        for name in ("dictionary", "best")
    )
    last = run.do(of_last)
    if last.summary.squared_error <= learned.summary.quantised_error:
        return last, of_last, 0
    best = run.do(of_best)
    return (best, of_best, 1) if best.summary.squared_error < last.summary.squared_error else (last, of_last, 0)


def _learn_as_coded(run: Run, priced: Quantisation, n_passes: int, iterations: int) -> tuple[StageRecord[Updated], int]:
    """The last passes, by all patches as they will be coded: with the pursuit, the multiplier and the weight levels of a
    quantising, from its atoms as they will be decoded; and how many of them did worse than the best before them."""
    quantised = run.do(priced)
    previous, stops, n_worse = quantised.folder, (priced.multiplier, priced.form), 0
    for iteration in range(iterations - n_passes, iterations):
        place, coding = (priced.training, previous, priced.max_atoms, 0.0), (quantised.folder, priced.pursuit)
        record: StageRecord[Updated] = run.do(KsvdUpdate(*place, iteration, *stops, 1.0, 1.0, *coding))
        previous = record.folder
        n_worse += not record.summary.accepted
    return record, n_worse


def _ladder(
    run: Run,
    training: StageRecord[Training],
    space: StageRecord,
    settings: Settings,
    tolerance: float,
    quantised: StageRecord[Quantised],
) -> Ladder:
    """What patches lose and take at several multipliers, by these atoms and weight levels."""
    places = space.folder, training.folder, quantised.folder
    return run.do(Multipliers(*places, settings.max_atoms, tolerance, settings.pursuit)).summary


def estimated_psnr_db(training: Training, update: Updated) -> float:
    """PSNR of the whole scan as far as an iteration's error over the training set tells; both are summaries."""
    error = update.squared_error / update.n_patches * training.n_active + training.settled_energy
    return psnr_db(error, training.n_splats * PATCH_DIM)
