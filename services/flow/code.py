"""Patches resampled and coded, for the target or within a budget of bytes."""

from __future__ import annotations

from dataclasses import dataclass

from pipeline.execution.stage import StageRecord
from pipeline.geometry.frame import directions_of
from pipeline.planning.color_step import color_step
from pipeline.planning.settings import Settings
from pipeline.stages.maps.map_pictures import PicturesMade
from pipeline.stages.maps.resample_maps import ResampleMaps
from pipeline.stages.texture.multipliers import multiplier_for
from pipeline.stages.texture.resample import Resample
from pipeline.summaries import Ladder, PatchesMade, Training
from services.flow.budget import NO_ATOMS, Trial, check_budget, within_budget
from services.flow.maps import Mapped, map_pictures, map_textures
from services.flow.pack import pack, packed_gpu_bytes, texels_of_levels
from services.flow.prepare import Prepared, wants_texture
from services.flow.run import Run
from services.flow.textures import Coded, code_patches
from storage.maps import MOST_MAPS
from storage.packed.dictionaries.shipped import NEWEST

# What atoms take in the file beyond one colour a splat, at 36 dB (draft, a tenth of the points): 1.7 of pump_e57 over
# quadrics (129,704 bytes become 155,309 at 38.6 dB; with maps 179,811 at 36.1), 2.5 of fountain_3stations (488,866,
# 634,855; 740,686), 3.9 of conference_room (410,847 with one colour; with maps 739,610). Their geometric mean decides
# these three as their bytes do.
ATOM_BYTES_A_SPLAT = 2.5


def resample(run: Run, prepared: Prepared, kept: bool = True) -> StageRecord[PatchesMade]:
    """Sample the photographs, or the maps of stations, into patches; of photographs not `kept`, but made again where
    they are used."""
    scan, maps = prepared.scan, prepared.maps
    if maps is not None:
        return run.do(ResampleMaps(prepared.on_maps(maps.folder), maps.log_gain))
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


@dataclass(frozen=True)
class Texture:
    """Where the colours of a packed file come from: patches that are coded, or maps; neither: one colour a splat."""

    coded: Coded | None = None
    mapped: Mapped | None = None
    choice: str = ""  # why, of a scan with station maps

    @property
    def psnr_db(self) -> float | None:
        """Of all texels of what is coded, or of the maps where they show a surface."""
        if self.coded:
            return self.coded.codes.summary.texture_psnr_db
        return self.mapped.texture_psnr_db if self.mapped else None


def texture(run: Run, prepared: Prepared, settings: Settings) -> Texture:
    """The texture that the settings ask for; `auto`, of a scan with station maps, that of fewer bytes at the target's
    PSNR."""
    if not wants_texture(prepared, settings.texture):
        return Texture()
    pictures, choice = chosen_maps(run, prepared, settings)
    if pictures is None:
        return Texture(code(run, prepared, settings), choice=choice)
    return Texture(mapped=mapped_by(run, prepared, settings, pictures), choice=choice)


def chosen_maps(run: Run, prepared: Prepared, settings: Settings) -> tuple[StageRecord[PicturesMade] | None, str]:
    """The pictures of station maps where these themselves are the texture, None where atoms are, and why."""
    if prepared.maps is None or settings.texture == "atoms":
        return None, ""
    if settings.texture == "auto" and settings.budget_bytes is not None:
        return None, "atoms: a budget of bytes a splat has no room for pictures"
    maps, target = prepared.maps, settings.target_psnr_db
    pictures = map_pictures(run, maps, target)
    n_splats, psnr = prepared.splats.summary.n_splats, pictures.summary.texture_psnr_db or 0.0
    sizes = pictures.summary.color_bytes + pictures.summary.depth_bytes, ATOM_BYTES_A_SPLAT * n_splats
    words = f"maps take about {sizes[0] / 1e3:,.0f} kB at {psnr:.1f} dB, atoms about {sizes[1] / 1e3:,.0f} kB at {target:g} dB"
    if settings.texture == "auto" and (sizes[1] <= sizes[0] or psnr < target or len(maps.log_gain) > MOST_MAPS):
        return None, f"atoms: {words}"
    return pictures, f"map: {words}" + ("" if settings.texture == "auto" else "; asked for")


def mapped_by(run: Run, prepared: Prepared, settings: Settings, pictures: StageRecord[PicturesMade]) -> Mapped:
    """The splats, which have maps, with these as their texture."""
    assert prepared.maps is not None
    return map_textures(run, prepared.maps, prepared.on_maps(prepared.maps.folder), pictures, color_step(settings))


def shipped_for(prepared: Prepared, settings: Settings) -> str:
    """The name of the dictionary that ships with the program where atoms are of it; "" where they are the scan's own."""
    asked = settings.dictionary == "shipped" or settings.fits_shipped
    return NEWEST if asked and "shipped_dictionary" in prepared.effects.enabled else ""


def code(run: Run, prepared: Prepared, settings: Settings) -> Coded:
    """Resample patches, and code them. They are kept where the work folder is, or where all are coded several times."""
    kept = run.keeps_work or settings.budget_bytes is not None
    return code_prepared(run, prepared, resample(run, prepared, kept), settings)


def code_prepared(
    run: Run, prepared: Prepared, patches: StageRecord[PatchesMade], settings: Settings, n_splats: int | None = None
) -> Coded:
    """Code the patches of splats, which are all or a sample of `n_splats`, for the target or within the budget."""
    n_sample, most_texels = prepared.splats.summary.n_splats, texels_of_levels(prepared, settings)[0]
    shipped = shipped_for(prepared, settings)
    if settings.budget_bytes is None:
        return code_patches(run, patches, settings, n_splats, most_texels, shipped=shipped)
    share, first = n_sample / (n_splats or n_sample), []

    def attempt(multiplier: float) -> Trial:
        def multiplier_of(ladder: Ladder, training: Training) -> float:
            first.append(multiplier_for(ladder, training))
            return multiplier

        n_before = len(run.records)
        coded = code_patches(run, patches, settings, n_splats, most_texels, multiplier_of, shipped)
        known = {record.folder for record in run.records[:n_before]}
        run.records[n_before:] = [record for record in run.records[n_before:] if record.folder not in known]
        return Trial(multiplier, packed_gpu_bytes(pack(run, prepared, coded, settings, "trial", None), share), coded)

    bare = attempt(NO_ATOMS)
    if not first:  # nothing calls for atoms, or none are allowed
        check_budget(settings.budget_bytes, n_sample, bare.n_bytes)
        return bare.result
    return within_budget(
        settings.budget_bytes,
        n_sample,
        first[0],
        lambda multiplier: bare if multiplier == NO_ATOMS else attempt(multiplier),
    ).result
