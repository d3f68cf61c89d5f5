"""What a compress job may be told, and the presets."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from pipeline.planning.knobs import BY_NAME, KNOBS
from pipeline.readers.attributes.options import ReadOptions
from storage.limits import MAX_ATOMS

if TYPE_CHECKING:
    from pipeline.volumes.volume import Choice


@dataclass(frozen=True)
class Settings:
    """All that decides the bytes of a packed file, beside the scan itself: a value for each row of `knobs.KNOBS`."""

    preset: str = "balanced"
    coder: str = "default"
    atom_size: int | str = "auto"
    dictionary: str = "auto"  # own, shipped, or auto
    dictionary_bits: int | str = "auto"
    weight_bits: int = 4
    max_atoms: int = 8
    target_psnr_db: float = 40.0
    budget_bytes: float | None = None
    atom_search: str = "certified"
    pursuit: str = "8x2"
    iterations: int = 14
    least_gain_db: float = 0.01
    training_splats: int = 60_000
    subspace_floor_db: float = 10.0
    density: float = 1.0
    radius: float | None = None
    levels: int | None = None
    view_distance: float | None = None
    iso: str = ""  # of a volume, as pipeline.volumes.request writes it; "" leaves the value to the volume
    geometry: str = "auto"  # boxes, quadrics, runs, or auto
    geometry_error: float | None = None
    normal_error: float | None = None
    archive: str = "off"
    run_length: int = 25
    cell: float | None = None
    resampling: str = "trilinear"
    border: str = "open"
    spacing: str = ""
    component: int | None = None
    time: int | None = None
    texture: str = "auto"
    seed: int = 0
    marked_points: str = ""  # what is asked of points that the scan marks, as readers.attributes.marks writes it
    station: str = ""  # x,y,z of a scanner that saw all points; "" leaves stations to the scan
    sparse_model: str = ""  # the folder of a workspace's model; "" leaves the choice to the points
    height_scale: float = 1.0
    page_codec: str = "jpeg"
    page_quality: int = 90
    effects: str = ""  # what is asked of effects, as pipeline.effects.plan.request writes it; "" leaves all to the scan

    @property
    def reading(self) -> ReadOptions:
        """What of it decides how a scan is read."""
        return ReadOptions(self.marked_points, self.station, self.sparse_model, self.height_scale)

    @property
    def fits_shipped(self) -> bool:
        """Whether nothing asks for other atoms than those that ship with the program, or for their bytes on the GPU."""
        as_they_are = self.atom_size in ("auto", 16) and self.dictionary_bits in ("auto", 12)
        has_atoms = self.coder == "default" and self.max_atoms > 0
        return has_atoms and as_they_are and self.budget_bytes is None and self.dictionary != "own"

    @property
    def choice(self) -> Choice:
        """Which of the volumes of a file is meant. Raises ValueError as `parse_spacing`."""
        from pipeline.volumes.request import parse_spacing
        from pipeline.volumes.volume import Choice

        return Choice(self.component, self.time, parse_spacing(self.spacing))

    @property
    def asked_effects(self) -> str:
        """What is asked of effects, with what `texture` says of station maps, and a number of `levels` of these."""
        from pipeline.effects.plan.request import canonical_request  # finds all effects, which `inspect` can do without

        asked = {"color": "off", "atoms": "on", "map": "on"}.get(self.texture)
        parts = [f"station_maps={asked}"] if asked else []
        atoms = {"own": "off", "shipped": "on"}.get(self.dictionary, "auto" if self.fits_shipped else "off")
        parts += [] if atoms == "auto" else [f"shipped_dictionary={atoms}"]
        parts += [] if self.levels is None else [f"levels={'on' if self.levels else 'off'}"]
        return canonical_request([self.effects, *parts])


PRESETS = {
    "draft": Settings("draft", target_psnr_db=36.0, pursuit="2x2", iterations=6, training_splats=10_000),
    "balanced": Settings("balanced"),
    "high": Settings(
        "high",
        dictionary_bits=12,
        max_atoms=MAX_ATOMS,
        target_psnr_db=44.0,
        pursuit="4x2",
        iterations=14,
        training_splats=80_000,
    ),
    "archive": Settings(
        "archive",
        dictionary_bits=12,
        weight_bits=6,
        max_atoms=MAX_ATOMS,
        target_psnr_db=48.0,
        pursuit="4x2",
        iterations=12,
        least_gain_db=0.005,
        training_splats=50_000,
    ),
}
DEFAULT_PRESET = Settings().preset


def settings_for(preset: str = DEFAULT_PRESET, **changes) -> Settings:
    """A preset with changes; None leaves the preset's value. Raises ValueError naming the setting and what it
    allows."""
    if preset not in PRESETS:
        raise ValueError(f"preset is {preset!r}; allowed: {', '.join(PRESETS)}")
    for name in changes:
        if name not in BY_NAME:
            raise ValueError(f"{name!r} is no setting; allowed: {', '.join(BY_NAME)}")
    settings = replace(PRESETS[preset], **{k: v for k, v in changes.items() if v is not None})
    settings = replace(settings, **{knob.name: knob.checked(getattr(settings, knob.name)) for knob in KNOBS})
    if settings.dictionary == "shipped" and (settings.coder == "paper" or settings.atom_size not in ("auto", 16)):
        raise ValueError(
            f"dictionary is shipped with coder {settings.coder} and atom_size {settings.atom_size}; allowed: coder default, "
            "atom_size auto or 16, which its atoms have"
        )
    if settings.budget_bytes is not None and settings.coder == "paper":
        raise ValueError(
            f"budget_bytes is {settings.budget_bytes:g} with coder paper, which has a cut-off and no Lagrange multiplier; allowed: coder default"
        )
    return settings
