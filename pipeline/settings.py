"""What a compress job may be told, and the presets."""

from __future__ import annotations

from dataclasses import dataclass, replace

from storage.schema import MAX_ATOMS


@dataclass(frozen=True)
class Settings:
    """All that decides the bytes of a packed file, beside the scan itself."""

    preset: str = "balanced"
    dictionary_bits: int = 8
    weight_bits: int = 4
    max_atoms: int = MAX_ATOMS
    target_psnr_db: float = 40.0
    iterations: int = 6
    training_splats: int = 40_000
    radius: float | None = None
    seed: int = 0


PRESETS = {
    "draft": Settings("draft", target_psnr_db=36.0, iterations=3, training_splats=10_000),
    "balanced": Settings("balanced"),
    "high": Settings("high", dictionary_bits=12, weight_bits=8, target_psnr_db=44.0, iterations=8, training_splats=80_000),
}
ALLOWED = {
    "preset": tuple(PRESETS),
    "dictionary_bits": (8, 12, 16),
    "weight_bits": (4, 8),
    "max_atoms": (0, MAX_ATOMS),
    "target_psnr_db": (10.0, 80.0),
    "iterations": (1, 1000),
    "training_splats": (256, 100_000_000),
    "seed": (0, 2**63 - 1),
}


def settings_for(preset: str = "balanced", **changes) -> Settings:
    """A preset with changes; None leaves the preset's value. Raises ValueError naming the setting and what it allows."""
    if preset not in PRESETS:
        raise ValueError(f"preset is {preset!r}; allowed: {', '.join(PRESETS)}")
    settings = replace(PRESETS[preset], **{k: v for k, v in changes.items() if v is not None})
    for name in ("dictionary_bits", "weight_bits"):
        if getattr(settings, name) not in ALLOWED[name]:
            raise ValueError(f"{name} is {getattr(settings, name)}; allowed: {ALLOWED[name]}")
    for name in ("max_atoms", "target_psnr_db", "iterations", "training_splats", "seed"):
        low, high = ALLOWED[name]
        if not low <= getattr(settings, name) <= high:
            raise ValueError(f"{name} is {getattr(settings, name)}; allowed: {low} to {high}")
    if settings.radius is not None and not 0 < settings.radius < float("inf"):
        raise ValueError(f"radius is {settings.radius}; allowed: a positive length in the scan's unit")
    return settings
