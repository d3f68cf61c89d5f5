"""Patches resampled and coded, for the target or within a budget of bytes."""

from __future__ import annotations

from pipeline.execution.stage import StageRecord
from pipeline.geometry.frame import directions_of
from pipeline.planning.settings import Settings
from pipeline.stages.maps.resample_maps import ResampleMaps
from pipeline.stages.texture.prices import price_for
from pipeline.stages.texture.resample import Resample
from pipeline.summaries import Ladder, PatchesMade, Training
from services.flow.budget import NO_ATOMS, Trial, check_budget, within_budget
from services.flow.pack import pack, packed_gpu_bytes, texels_of_levels
from services.flow.prepare import Prepared
from services.flow.run import Run
from services.flow.textures import Coded, code_patches


def resample(run: Run, prepared: Prepared, kept: bool = True) -> StageRecord[PatchesMade]:
    """Sample the photographs, or the maps of stations, into patches; of photographs not `kept`, but made again where they are used."""
    scan, maps = prepared.scan, prepared.maps
    if maps is not None:
        splats, directions = prepared.splats.folder, directions_of(scan.summary.cameras)
        partition, radius = prepared.partition.folder, prepared.radius
        return run.do(ResampleMaps(maps.folder, partition, splats, radius, *directions, maps.log_gain))
    return run.do(
        Resample(
            prepared.photos,
            prepared.partition.folder,
            prepared.splats.folder,
            prepared.radius,
            *directions_of(scan.summary.cameras),
            "antialiasing" in prepared.effects.enabled,
            kept,
        )
    )


def code(run: Run, prepared: Prepared, settings: Settings) -> Coded:
    """Resample patches, and code them. They are kept where the work folder is, or where all are coded several times."""
    kept = run.keeps_work or settings.budget_bytes is not None
    return code_prepared(run, prepared, resample(run, prepared, kept), settings)


def code_prepared(
    run: Run, prepared: Prepared, patches: StageRecord[PatchesMade], settings: Settings, n_splats: int | None = None
) -> Coded:
    """Code the patches of splats, which are all or a sample of `n_splats`, for the target or within the budget."""
    n_sample, most_texels = prepared.splats.summary.n_splats, texels_of_levels(prepared, settings)[0]
    if settings.budget_bytes is None:
        return code_patches(run, patches, settings, n_splats, most_texels)
    share, first = n_sample / (n_splats or n_sample), []

    def attempt(price: float) -> Trial:
        def priced(ladder: Ladder, training: Training) -> float:
            first.append(price_for(ladder, training))
            return price

        n_before = len(run.records)
        coded = code_patches(run, patches, settings, n_splats, most_texels, priced)
        known = {record.folder for record in run.records[:n_before]}
        run.records[n_before:] = [record for record in run.records[n_before:] if record.folder not in known]
        return Trial(price, packed_gpu_bytes(pack(run, prepared, coded, settings, "trial", None), share), coded)

    bare = attempt(NO_ATOMS)
    if not first:  # nothing calls for atoms, or none are allowed
        check_budget(settings.budget_bytes, n_sample, bare.n_bytes)
        return bare.result
    return within_budget(
        settings.budget_bytes, n_sample, first[0], lambda price: bare if price == NO_ATOMS else attempt(price)
    ).result
