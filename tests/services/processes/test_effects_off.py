"""An effect that is asked to be off leaves no stage, no bytes and no shader code, and takes nothing of another effect
along."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from pipeline.effects.ellipsoids import stage
from pipeline.effects.plan.registry import effects
from pipeline.execution.executors import SerialExecutor
from pipeline.planning.settings import settings_for
from renderer.splats.glsl import shader_source
from renderer.splats.renderer import Renderer
from renderer.splats.scene import GpuScene
from services.processes.compress import compress
from storage.packed.packed import PackedFile
from tests.effects_scans import step_scan
from tests.pipeline.execution.test_stage import Heard


@dataclass(frozen=True)
class Traces:
    """What an effect that is on is to be seen by."""

    stages: tuple[str, ...] = ()
    arrays: tuple[str, ...] = ()
    outcome: bool = True  # an entry in the header's `effects`
    words: tuple[str, ...] = ()  # in the names of programs
    define: str | None = None  # behind which its shader code stands


TRACES = {
    "sizes": Traces(("sizes",), ("size_scale", "sizes"), words=("bits=3",), define="SIZE_BITS"),
    "levels": Traces(define="DETAIL"),  # of scans of 32,768 splats and more: tests/renderer/test_detail.py
    "cliplines": Traces(("nearest-points", "cliplines"), ("cliplines",), words=("clipline",), define="CLIPLINE"),
    "ellipsoids": Traces(("ellipsoids",), ("ellipsoids",), words=("ellipsoid",), define="ELLIPSOID"),
    "exposure": Traces(("exposure",)),
    "station_maps": Traces(),  # of laser scans: tests/services/processes/test_station_maps.py
    "pages": Traces(("photo-pages",)),
    "depth_margin": Traces(),
    "accumulation": Traces(),
    "mip_levels": Traces(arrays=("atoms_4", "atoms_2", "atoms_1"), words=("levels",), define="LEVELS"),
    "shipped_dictionary": Traces(),
    "level_blending": Traces(words=("blended",), define="BLENDED"),
    "antialiasing": Traces(),
    "relighting": Traces(words=("lit",), define="LIT"),
    "normal_smoothing": Traces(words=("smooth",), define="SMOOTH"),
}


SETTINGS = settings_for("draft", target_psnr_db=50.0, max_atoms=2, atom_size=16, training_splats=256, iterations=1)


@pytest.fixture(scope="module")
def made(tmp_path_factory, renderer):
    """A function from a request to the report, the packed scene, the programs that drew it and what it was added up
    in."""
    folder = tmp_path_factory.mktemp("off")
    scan = step_scan(folder / "step", n_side=41)
    known = {}

    def make(request: str):
        if request not in known:
            out = folder / str(len(known))
            report = compress(
                scan,
                out,
                replace(SETTINGS, effects=request),
                SerialExecutor(),
                Heard(),
                render=False,
                work=folder / "work",
            )
            with PackedFile(out / "step.splatpress") as packed:
                scene = packed.load()
            gpu_scene = GpuScene(scene, renderer.context)
            picture = renderer.render(gpu_scene, scene.header.cameras[0])
            gpu_scene.release()
            known[request] = report, scene, picture
        return known[request]

    with pytest.MonkeyPatch.context() as patch:  # the scan has nothing thin
        patch.setattr(stage, "thin_splats", lambda point, *_: np.arange(len(point)) % 5 == 0)
        yield make


def seen(traces: Traces, name: str, report: dict, scene, picture) -> dict[str, set]:
    """By kind of trace, those of an effect that are there."""
    programs = {word for program in picture.programs for word in program.split()}
    return {
        "stages": {s["name"] for s in report["stages"]} & set(traces.stages),
        "arrays": scene.arrays.keys() & set(traces.arrays),
        "outcome": {name} & scene.header.effects.keys(),
        "words": programs & set(traces.words),
    }


def test_off__the_table_has_every_effect():
    assert TRACES.keys() == effects().keys()


@pytest.mark.parametrize("name", TRACES)
def test_off__removes_stage_bytes_and_shader_code_of_one_effect_and_of_no_other(made, name):
    report, *rest = made(f"all=on,{name}=off")
    row = next(row for row in report["effects"] if row["effect"] == name)
    assert not row["enabled"] and row["measure"] is None, "what is off is not even measured"
    for other, traces in TRACES.items():
        found = seen(traces, other, report, *rest)
        if name in (other, effects()[other].needs):
            assert not any(found.values())
        else:
            assert found == {
                "stages": set(traces.stages),
                "arrays": set(traces.arrays),
                "outcome": {other},
                "words": set(traces.words),
            }


@pytest.mark.parametrize("name", [name for name, traces in TRACES.items() if traces.arrays])
def test_off__a_file_is_smaller_by_the_arrays_of_what_is_off(made, name):
    (with_it, scene, _), (without, _, _) = made("all=on"), made(f"all=on,{name}=off")
    own = sum(scene.arrays[array].nbytes for array in TRACES[name].arrays)
    assert (
        own > 0 and with_it["sizes"]["gpu_bytes"] - without["sizes"]["gpu_bytes"] >= 0.5 * own
    )  # lines move to freed splats


@pytest.mark.parametrize("name", [name for name, traces in TRACES.items() if traces.define])
def test_off__shaders_without_the_define_are_shorter_and_do_not_name_what_it_brings(name):
    define = TRACES[name].define
    with_it, without = (preprocessed("attribute.frag.glsl", N_ATOMS=2, **{define: on}) for on in (1, 0))
    assert len(without) < len(with_it)


def preprocessed(name: str, **defines: int) -> str:
    """A shader's text without the lines that its #ifdefs leave out."""
    defined = {line.split()[1] for line in shader_source(name, **defines).splitlines() if line.startswith("#define")}
    kept, open_ = [], []
    for line in shader_source(name, **defines).splitlines():
        word, *rest = line.split() or [""]
        if word in ("#ifdef", "#ifndef"):
            open_.append((rest[0] in defined) == (word == "#ifdef"))
        elif word == "#if":
            open_.append(any(name in line for name in defined))
        elif word == "#else":
            open_[-1] = not open_[-1]
        elif word == "#endif":
            open_.pop()
        elif all(open_):
            kept.append(line)
    return "\n".join(kept)


def test_off__all_is_the_shortest_path(made):
    report, scene, picture = made("all=off")
    assert not scene.header.effects and "measure-effects" not in [s["name"] for s in report["stages"]]
    assert {word for program in picture.programs for word in program.split() if "=" not in word} == {
        "cull",
        "visibility",
        "attribute",
        "turned",
        "by",
        "batch",
        "color",
        "resolve",
    }
    assert scene.header.color_step and any(f"color boxes={scene.header.color_step}" in p for p in picture.programs)
    assert picture.accumulation == "RGBA16F"


# --- accumulation: what stays off however thick splats lie
# ---------------------------------------------------------------


def test_off__sums_stay_in_16_bits_and_nobody_looks_whether_that_shows(made, renderer: Renderer):
    from tests.hard_cases.test_blending import VIEW, stack
    from tests.scenes import build_scene

    scene = build_scene(stack(400, "bright", True, 0.0))
    drawn = {}
    for request in ("", "accumulation=off"):
        scene.header.settings["effects"] = request
        gpu_scene = GpuScene(scene, renderer.context)
        drawn[request] = renderer.render(gpu_scene, VIEW)
        gpu_scene.release()
    assert drawn[""].accumulation == "RGBA32F" and drawn["accumulation=off"].accumulation == "RGBA16F"
    assert not any("watched" in program for program in drawn["accumulation=off"].programs)
    assert np.abs(drawn[""].rgb.astype(int) - drawn["accumulation=off"].rgb).max() > 1
