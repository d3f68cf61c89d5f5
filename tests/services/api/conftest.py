"""The reference client of tus, got once for the tests that run it in node and in a browser."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

CLIENT = "tus-js-client@4.3.1"


@pytest.fixture(scope="session")
def modules(tmp_path_factory) -> Path:
    """Where tus-js-client lies: SPLATPRESS_NODE_MODULES, else put there by npm."""
    if given := os.environ.get("SPLATPRESS_NODE_MODULES"):
        return Path(given)
    if not (shutil.which("node") and shutil.which("npm")):
        pytest.skip(f"needs node and npm, for {CLIENT}")
    folder = tmp_path_factory.mktemp("node")
    command = ["npm", "install", "--silent", "--no-audit", "--no-fund", "--prefix", str(folder), CLIENT]
    found = subprocess.run(command, capture_output=True, text=True, timeout=120)
    if found.returncode:
        pytest.skip(f"npm could not get {CLIENT}: {found.stderr.strip()[-200:]}")
    return folder / "node_modules"
