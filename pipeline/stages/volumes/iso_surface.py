"""Voxels -> the points of iso-surfaces, as the ingest of a scan has them: with normals, and a colour each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.geometry.chunks import bounds
from pipeline.geometry.hcp import cell_of, centre_of, centres_of
from pipeline.geometry.runs.frame import GridFrame
from pipeline.numerics.limits import check_bounds
from pipeline.stages.volumes.voxels import slab
from pipeline.summaries import ScanRead, SurfaceFound, VolumeRead, VolumeSurfaces
from pipeline.volumes.field import SUPPORT
from pipeline.volumes.lattice import HALO, Lattice, auto_size, lattice_of
from pipeline.volumes.request import CLOSED, Iso
from pipeline.volumes.surface import sampled, surface_in
from storage.errors import InvalidScan
from storage.work import arrays, work

OF_VOLUME = ("shape", "dtype", "spacing", "origin", "directions", "frame", "unit", "low", "high")
SAMPLE = 1 << 18  # positions of the sample, as the ingest's
CLOSE_CELLS = 0.01  # off a surface by more than so much of a cell: counted as left away from it


@dataclass(frozen=True)
class BrickOfSurfaces:
    """What a task tells of its slices: the box of its points, None where there are none; by iso value how many there
    are, were added, lie off the surface, and had no direction, and by how many cells the others are off, summed; the
    largest value of its voxels at the border of the volume, None where it has none."""

    n_splats: int
    low: list[float] | None
    high: list[float] | None
    n_points: list[int]
    n_added: list[int]
    n_off: list[int]
    n_flat: list[int]
    off: list[float]
    highest_at_border: float | None


@dataclass(frozen=True)
class IsoSurface:
    """A task some slices of the HCP grid, with the slices about them as halos.

    Arrays: position (n, 3) float64 in the volume's frame, normal (n, 3) float32 towards lower values, zero where the
    volume tells none, color (n, 3) uint8; sample (m, 3) float64: every so many-th position. By task, by iso value, by
    slice, row and column of the grid.

    Raises: InvalidScan where no iso value makes a point, or cells are too many.
    """

    voxels: Path
    isos: tuple[Iso, ...]
    cell: float | None = None
    method: str = "trilinear"
    border: str = "open"
    is_proposed: bool = False  # nobody asked for the iso value: the volume proposed it
    on_cells: bool = (
        False  # points stay at the centres of their cells, for runs of these; their normals are those of the surface
    )
    looks_like_labels: bool = False  # whatever the header says
    name = "iso-surface"

    def init(self, folder: Path) -> int:
        _, lattice = self._lattice()
        return -(-lattice.counts[2] // self._slices(lattice))

    def run(self, folder: Path, index: int) -> BrickOfSurfaces:
        pad, lattice = self._lattice()
        n = self._slices(lattice)
        begin, end = index * n, min((index + 1) * n, lattice.counts[2])
        k0, k1 = lattice.voxel_slices(max(0, begin - HALO), min(lattice.counts[2], end + HALO), SUPPORT)
        voxels = slab(self.voxels, k0, k1, pad)
        values, first = sampled(voxels, k0, lattice, begin, end, self.method)
        found = [
            surface_in(voxels, k0, values, first, lattice, begin, end, iso.value, self.method) for iso in self.isos
        ]
        place = [centres_of(s.key, lattice.size) if self.on_cells else s.position for s in found]
        position = lattice.in_frame(np.concatenate(place))
        gradient = np.concatenate([s.gradient for s in found]) @ lattice.turn.T
        length = np.linalg.norm(gradient, axis=1, keepdims=True)
        normal = -np.divide(gradient, length, out=np.zeros_like(gradient), where=length > 0)
        color = np.concatenate(
            [np.tile(np.array(iso.color, np.uint8), (len(s.key), 1)) for iso, s in zip(self.isos, found)]
        )
        rows = {"position": position, "normal": normal.astype(np.float32), "color": color}
        work.write_parts(work.parts(folder) / f"{index:06d}.npz", **rows)
        low, high = (b.tolist() for b in bounds(position)) if len(position) else (None, None)
        off = [s.off[np.isfinite(s.off)] / lattice.size for s in found]
        return BrickOfSurfaces(
            n_splats=len(position),
            low=low,
            high=high,
            n_points=[len(s.key) for s in found],
            n_added=[s.n_added for s in found],
            n_off=[int((~(s.off <= CLOSE_CELLS * lattice.size)).sum()) for s in found],
            n_flat=[int((~np.isfinite(s.off)).sum()) for s in found],
            off=[float(o[o <= CLOSE_CELLS].sum()) for o in off],
            highest_at_border=highest_at_border(voxels, k0, self._n_slices(pad)),
        )

    def finalise(self, folder: Path, results: list[BrickOfSurfaces]) -> ScanRead:
        volume = work.summary(self.voxels, VolumeRead)
        _, lattice = self._lattice()
        n_points = sum(r.n_splats for r in results)
        if not n_points:
            asked = ", ".join(f"{iso.value:g}" for iso in self.isos)
            raise InvalidScan(
                f"iso {asked}",
                f"no surface in {volume.path}",
                f"values pass from {volume.low:g} to {volume.high:g}",
            )
        self._gather(folder, len(results), n_points)
        some = [r for r in results if r.n_splats]
        low, high = np.min([r.low for r in some], axis=0), np.max([r.high for r in some], axis=0)
        check_bounds(volume.path, low, high)
        surfaces = [self._surface(i, results) for i in range(len(self.isos))]
        warnings = [*volume.warnings, *self._warnings(surfaces, volume)]
        if volume.is_labels or self.looks_like_labels:
            warnings.append(
                "values look like names of regions, not like grey: a surface lies between all that are higher and all that are lower; "
                "a region alone takes a volume of its own"
            )
        if self.is_proposed:
            warnings.append(f"no iso value was given: {self.isos[0].value:g} is what the volume proposes first")
        surfaces_of = VolumeSurfaces(
            **{name: getattr(volume, name) for name in OF_VOLUME},
            cell=lattice.size,
            method=self.method,
            border=self.border,
            is_closed=self._is_closed(volume, results),
            surfaces=tuple(surfaces),
        )
        return ScanRead(
            format=volume.format,
            unit=volume.unit,
            n_points=n_points,
            n_read=n_points,
            n_dropped=0,
            low=tuple(low.tolist()),
            high=tuple(high.tolist()),
            intensity_range=None,
            cameras=(),
            stations=(),
            has_visibility=False,
            has_colors=True,
            warnings=tuple(warnings),
            is_albedo=True,
            volume=surfaces_of,
            grid=grid_of(lattice, (low + high) / 2) if self.on_cells else None,
        )

    def _is_closed(self, volume: VolumeRead, results: list[BrickOfSurfaces]) -> bool:
        """Whether all surfaces end nowhere and look outwards: all voxels are known, and those of the border lower than
        any of their values."""
        highest = max(r.highest_at_border for r in results if r.highest_at_border is not None)
        return not volume.n_unknown and highest < min(iso.value for iso in self.isos)

    def _n_slices(self, pad: float | None) -> int:
        return work.summary(self.voxels, VolumeRead).shape[2] + (0 if pad is None else 2)

    def _surface(self, i: int, results: list[BrickOfSurfaces]) -> SurfaceFound:
        total = {
            name: sum(getattr(r, name)[i] for r in results)
            for name in ("n_points", "n_added", "n_off", "n_flat", "off")
        }
        n_on = total["n_points"] - total["n_off"]
        mean = total.pop("off") / n_on if n_on else None
        return SurfaceFound(self.isos[i].value, self.isos[i].color, **total, mean_off_cells=mean)

    def _warnings(self, surfaces: list[SurfaceFound], volume: VolumeRead) -> list[str]:
        found = []
        for surface in surfaces:
            value, n = surface.iso, surface.n_points
            if not n:
                found.append(f"iso {value:g}: no voxel passes it; values go from {volume.low:g} to {volume.high:g}")
                continue
            if surface.n_off:
                found.append(
                    f"iso {value:g}: {surface.n_off:,} of {n:,} points lie more than {CLOSE_CELLS:g} of a cell off it, "
                    "where it is thinner than a cell or the volume is flat"
                )
            if surface.n_added:
                found.append(f"iso {value:g}: {surface.n_added:,} of {n:,} points stand for parts thinner than a cell")
        return found

    def _gather(self, folder: Path, n_tasks: int, n_points: int) -> None:
        """The parts of all tasks, one behind the other."""
        writers = {
            "position": arrays.Appender(folder, "position", (3,), "float64"),
            "normal": arrays.Appender(folder, "normal", (3,), "float32"),
            "color": arrays.Appender(folder, "color", (3,), "uint8"),
            "sample": arrays.Appender(folder, "sample", (3,), "float64"),
        }
        step, at = max(1, n_points // SAMPLE), 0
        for index in range(n_tasks):
            with work.open_parts(work.parts(folder) / f"{index:06d}.npz") as part:
                for name in ("position", "normal", "color"):
                    writers[name].append(part[name])
                writers["sample"].append(part["position"][-at % step :: step])
                at += len(part["position"])
        for writer in writers.values():
            writer.close()

    def _lattice(self) -> tuple[float | None, Lattice]:
        """The grid; and the value outside the volume, where surfaces are to be closed there."""
        volume = work.summary(self.voxels, VolumeRead)
        shape, directions, origin = volume.shape, np.array(volume.directions), np.array(volume.origin)
        size = self.cell or auto_size(volume.spacing)
        if self.border != CLOSED:
            return None, lattice_of(shape, directions, origin, size)
        wider = (shape[0] + 2, shape[1] + 2, shape[2] + 2)
        return volume.low, lattice_of(wider, directions, origin - directions.sum(axis=1), size)

    def _slices(self, lattice: Lattice) -> int:
        n_i, n_j, _ = work.summary(self.voxels, VolumeRead).shape
        return lattice.slices_a_task(n_i * n_j)


def highest_at_border(voxels: np.ndarray, first: int, n: int) -> float | None:
    """Of slices from `first` on, (n_k, n_j, n_i), of a volume of `n`, the largest value in the planes that bound it."""
    planes = [voxels[:, (0, -1)], voxels[:, :, (0, -1)]]
    planes += [voxels[:1]] if first == 0 else []
    planes += [voxels[-1:]] if first + len(voxels) == n else []
    found = max(float(np.nanmax(plane, initial=-np.inf)) for plane in planes)
    return found if np.isfinite(found) else None


def grid_of(lattice: Lattice, middle: np.ndarray) -> GridFrame:
    """The lattice as a grid of runs has it; its origin is the cell near `middle` (3,) in even rows and slices, from
    which all others lie as they do from cell (0, 0, 0)."""
    x, y, z = (float(x) for x in (middle - lattice.origin) @ lattice.turn)
    column, row, slice_ = cell_of(x, y, z, lattice.size)
    origin = lattice.in_frame(np.array(centre_of(column, row - row % 2, slice_ - slice_ % 2, lattice.size)))
    return GridFrame(tuple(origin.tolist()), tuple(lattice.turn.ravel().tolist()))
