"""What the cost model is asked and told: the costs of a stage, a job, and its stages as they are planned."""

from __future__ import annotations

from dataclasses import dataclass

from storage.packed.schema import ATOM_SIZES

ATOMS = 1.73  # a splat of the scan that costs of searches were measured on: `fountain_p11`, `balanced`
KILO, SMALLEST = 1024, min(ATOM_SIZES)  # indices of atoms, and texels to a side of the smallest


@dataclass(frozen=True)
class StageCost:
    """Of one stage. A unit is a splat, a training patch or a million pixels of photographs; a kilo 1,024 indices of
    atoms of 8x8 texels, of larger ones as many fewer as they have more texels: what products with all of them take goes
    by both."""

    task_us_a_unit: float  # of a worker's time
    once_s: float  # of one process, whatever the size: what `init` and `finalise` take
    once_us_a_unit: float
    written_bytes_a_unit: float
    memory_bytes: float  # of the worker that needs most, at any size
    memory_bytes_a_unit: float  # what comes to that with the size of the scan, up to MOST_HELD
    task_us_a_unit_a_kilo: float = 0.0
    once_s_a_kilo: float = 0.0
    written_bytes_a_kilo: float = 0.0
    # Of a beam, beside what OMP takes (`benchmarks/beam.py`): a support that is followed takes a row of products with all
    # indices a step, a child its weights.
    task_us_a_unit_a_node_a_kilo: float = 0.0
    task_us_a_unit_a_child: float = 0.0
    task_s: float = 0.0  # of each task, whatever its units
    once_s_a_task: float = 0.0  # of one process, of what each task tells
    task_us_a_splat: float = 0.0  # of a worker's time, where units are not splats and each is looked at


@dataclass(frozen=True)
class Dispatch:
    """What calls and tasks cost beside what tasks do (`benchmarks/alone.py`)."""

    call_s: float  # of the scheduler and its client, of each call
    task_s: float  # of these, of each task of a call
    around_s: float  # of a worker, around each task: its record, and being told


@dataclass(frozen=True)
class Job:
    """What is to be done, with what."""

    n_splats: int
    n_workers: int
    n_photographs: int = 0
    megapixels: float = 10.0  # of a photograph
    training_splats: int = 20_000
    iterations: int = 12
    n_indices: int = KILO  # of atoms in all their turns
    atom_size: int = SMALLEST  # texels to a side
    n_stations: int = 0  # of a laser scan that is textured from their maps
    pursuit: str = "omp"  # a word of `pipeline.coding.beam.form`
    max_atoms: int = 8
    atoms: float = ATOMS  # that a splat takes, on average
    keeps_patches: bool = False  # else they are made again where they are used, in the time that storing them took
    pages: bool = False  # whether photographs are packed in pages too
    geometry: str = "boxes"
    learns: bool = True  # a dictionary; else its atoms ship with the program
    n_voxels: int = 0  # of a volume, whose surfaces have `n_splats` points


@dataclass(frozen=True)
class StagePlan:
    """A stage of a job."""

    name: str
    n_tasks: int
    tasks_a_call: int  # that go to a worker at once
    task_s: float
    seconds: float
    once_s: float  # of the seconds: one process works, the others wait
    dispatch_s: float  # of the scheduler, for all tasks; part of the seconds only where it holds them up
    read_bytes: float
    written_bytes: float
    worker_bytes: float
