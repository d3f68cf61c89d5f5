"""Programs of others that open what is made here: npm's, where they are."""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path

import pytest

PACKAGES = "@playcanvas/splat-transform 3d-tiles-tools gltf-validator zarrita @zarrita/storage axe-core"
HINT = f"npm install --no-save {PACKAGES}, and NODE_PATH to its node_modules"


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
    return run_module(
        {"validator": node_module("gltf-validator") / "index.js"},
        f"""import fs from "fs"; const v = validator.default;
        const found = await v.validateBytes(new Uint8Array(fs.readFileSync({json.dumps(str(path))}))); return found.issues.messages;""",
    )


def upgraded_by_tiles_tools(tileset: Path, out: Path) -> str:
    """What CesiumGS' 3d-tiles-tools says while it reads a tileset with all of its contents and writes them anew."""
    program = node_module("3d-tiles-tools") / "build" / "src" / "cli.mjs"
    command = ["node", str(program), "upgrade", "-i", str(tileset), "-o", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def read_by_zarrita(path: Path, array: str) -> dict:
    """Shape and values of an array of a packed file as zarrita.js reads them."""
    modules = {
        "zarr": node_module("zarrita") / "dist" / "src" / "index.js",
        "storage": node_module("@zarrita/storage") / "dist" / "src" / "index.js",
    }
    return run_module(
        modules,
        f"""import {{ openAsBlob }} from "fs"; const store = storage.ZipFileStore.fromBlob(await openAsBlob({json.dumps(str(path))}));
        const root = await zarr.open(zarr.root(store), {{ kind: "group" }});
        const found = await zarr.get(await zarr.open(root.resolve({json.dumps(array)}), {{ kind: "array" }}));
        return {{ shape: found.shape, values: [...found.data], attributes: root.attrs }};""",
    )


def run_module(modules: dict[str, Path], script: str):
    """What a script of JavaScript returns, that has `modules` by name; its own imports stand first."""
    own = re.match(r"\s*(?:import [^;]*;\s*)*", script)[0]
    imports = "".join(f"import * as {name} from {json.dumps(path.as_uri())};" for name, path in modules.items())
    text = f"{imports}{own}console.log(JSON.stringify(await (async () => {{{script[len(own) :]}}})()));"
    done = subprocess.run(["node", "--input-type=module", "-e", text], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
