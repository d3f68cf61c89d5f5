"""The real scans beside the repository; tests that need one skip where it is missing."""

from pathlib import Path

import pytest

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"


def shared_scan(name: str) -> Path:
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{path} is not there; see shared/data/README.md of the project")
    return path
