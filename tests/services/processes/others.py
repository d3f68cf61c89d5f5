"""Programs of others that open what is exported: npm's, where they are."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

HINT = "npm install --no-save @playcanvas/splat-transform gltf-validator, and NODE_PATH to its node_modules"


def node_module(name: str) -> Path:
    """Where an npm package lies; skips the test where it is not."""
    folders = [Path(folder) for folder in os.environ.get("NODE_PATH", "").split(os.pathsep) if folder]
    for folder in (*folders, Path.cwd() / "node_modules"):
        if (folder / name / "package.json").is_file():
            return folder / name
    pytest.skip(f"needs {name} ({HINT})")


def read_by_splat_transform(path: Path) -> tuple[list[str], list[list[float]]]:
    """Columns and rows of Gaussians as splat-transform reads them."""
    program, table = node_module("@playcanvas/splat-transform") / "bin" / "cli.mjs", path.with_suffix(".csv")
    done = subprocess.run(
        ["node", str(program), "-q", "-w", "-g", "cpu", str(path), str(table)],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    names, *rows = table.read_text().splitlines()
    return names.split(","), [[float(x) for x in row.split(",")] for row in rows]


def complaints_of_gltf_validator(path: Path) -> list[dict]:
    """What Khronos' validator finds wrong, hints and warnings included."""
    index = node_module("gltf-validator") / "index.js"
    script = (
        "import v from process.argv[1]".replace("process.argv[1]", json.dumps(index.as_uri()))
        + f"; import fs from 'fs'; const r = await v.validateBytes(new Uint8Array(fs.readFileSync({json.dumps(str(path))})));"
        + " console.log(JSON.stringify(r.issues.messages))"
    )
    done = subprocess.run(["node", "--input-type=module", "-e", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
