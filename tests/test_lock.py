"""The lock file: what it pins has wheels on every Python and processor that README names, told from its own wheel
list."""

import re
from pathlib import Path

import pytest
from packaging.markers import Marker
from packaging.tags import compatible_tags, cpython_tags
from packaging.utils import canonicalize_name, parse_wheel_filename

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
PYTHONS = sorted({int(minor) for minor in re.findall(r"\b3\.(1\d)\b", README)})
WITHOUT_ARM_WHEELS = {"bc7enc-py", "flip-evaluator", "glcontext", "moderngl", "pycolmap", "pye57"}  # README: a compiler
PIN = re.compile(r"^([\w.-]+)==([\w.]+)(?: ; (.*?))? \\$", re.M)


def pins(lock: str) -> list[tuple[str, str, Marker | None]]:
    found = PIN.findall((ROOT / lock).read_text())
    return [(name, version, Marker(marker) if marker else None) for name, version, marker in found]


def tags(minor: int, processor: str) -> set:
    """That pip takes on a Debian 12 or later (glibc 2.36)."""
    platforms = [f"manylinux_2_{glibc}_{processor}" for glibc in range(36, 4, -1)]
    platforms += [f"{old}_{processor}" for old in ("manylinux2014", "manylinux2010", "manylinux1", "linux")]
    return {
        *cpython_tags((3, minor), platforms=platforms),
        *compatible_tags((3, minor), interpreter=f"cp3{minor}", platforms=platforms),
    }


def applies(marker: Marker | None, minor: int, processor: str) -> bool:
    here = {
        "python_version": f"3.{minor}",
        "python_full_version": f"3.{minor}.0",
        "platform_machine": processor,
        "sys_platform": "linux",
        "platform_system": "Linux",
        "os_name": "posix",
        "platform_python_implementation": "CPython",
        "implementation_name": "cpython",
    }
    return marker is None or marker.evaluate(here)


def without_wheel(lock: str, minor: int, processor: str) -> set[str]:
    fitting = tags(minor, processor)
    wheels: dict[tuple[str, str], list] = {}
    for line in (ROOT / "deploy" / "wheels.txt").read_text().split():
        name, version, _, of = parse_wheel_filename(line)
        wheels.setdefault((canonicalize_name(name), str(version)), []).append(of)
    return {
        name
        for name, version, marker in pins(lock)
        if applies(marker, minor, processor) and not any(of & fitting for of in wheels.get((name, version), ()))
    }


def test_lock__readme_names_the_pythons_that_set_up_takes():
    assert PYTHONS == [11, 12, 13, 14]
    setup = (ROOT / "deploy" / "setup.sh").read_text()
    assert f"(3, {PYTHONS[0]}) <= sys.version_info < (3, {PYTHONS[-1] + 1})" in setup


@pytest.mark.parametrize("minor", PYTHONS)
@pytest.mark.parametrize("lock", ["requirements.lock", "deploy/requirements.lock"])
def test_lock__all_pins_have_wheels(lock, minor):
    assert len(pins(lock)) > 60
    assert without_wheel(lock, minor, "x86_64") == set()
    assert without_wheel(lock, minor, "aarch64") <= WITHOUT_ARM_WHEELS


def test_lock__the_service_has_the_versions_that_were_tested():
    tested = {(name, version) for name, version, _ in pins("requirements.lock")}
    assert {(name, version) for name, version, _ in pins("deploy/requirements.lock")} <= tested
