"""The viewer's files: one by one as a server sends them, or all in one page that opens without one."""

from __future__ import annotations

import gzip
import html
import json
import re
from base64 import b64encode
from functools import cache
from pathlib import Path

from renderer.splats.gles import shader_document
from storage.errors import UnsupportedScan
from storage.packed.schema import Header

FOLDER = Path(__file__).parent / "viewer"
PAGE, SHADERS = "index.html", "shaders.json"
MEDIA_TYPES = {".js": "text/javascript", ".css": "text/css", ".html": "text/html", ".json": "application/json"}
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' blob: data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# Of the one page: its script is text of its own, and becomes modules of its own; nothing is asked of anyone.
_POLICY_OF_ONE_PAGE = "default-src 'none'; script-src 'unsafe-inline' blob:; style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'"
_IMPORT = re.compile(r'^import \{ ([\w, ]+) \} from "\./([\w.]+)";\n', re.MULTILINE)
_COMMENTS = re.compile(r"^ *(?://[^\n]*|/\*\*.*?\*/)\n", re.MULTILINE | re.DOTALL)  # on lines of their own
_EXPORT = re.compile(r"^export (?=(?:async )?(?:function|class|const) (\w+))", re.MULTILINE)


@cache
def viewer_file(name: str) -> tuple[bytes, str] | None:
    """Contents and media type of a file of the viewer; None where there is none of that name."""
    media_type = MEDIA_TYPES.get(Path(name).suffix)
    if name == SHADERS:
        return json.dumps(shader_document()).encode(), media_type
    path = FOLDER / name
    if media_type is None or Path(name).name != name or not path.is_file():
        return None
    return path.read_bytes(), media_type


def refuse_undrawn(packed: Path, header: Header) -> None:
    """Raises: UnsupportedScan for a file of a geometry that the viewer does not draw, as its page says too (packed.js)."""
    if header.geometry != "boxes":
        raise UnsupportedScan(
            str(packed),
            f"geometry {header.geometry}, which the viewer does not draw",
            "files of --geometry boxes",
            "splatpress render makes pictures of it, export points and Gaussians",
        )


def one_page(packed: bytes, title: str) -> bytes:
    """One page that holds the viewer and a packed file; it opens from a disk and asks nothing of anyone.

    Guarantees: at most 4/3 of the file and 60 kB.
    """
    style, page = (viewer_file(name)[0].decode() for name in ("viewer.css", PAGE))
    body = page[page.index("<body>") :].removesuffix("</html>\n")
    program = f"{bundle('start.js')}\nexport const begin = modules['start.js'].begin;"
    code = b64encode(gzip.compress(program.encode(), 9, mtime=0)).decode()
    shaders = b64encode(gzip.compress(viewer_file(SHADERS)[0], 9, mtime=0)).decode()
    return "\n".join(
        [
            '<!doctype html>\n<html lang="en">\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY_OF_ONE_PAGE}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<title>{html.escape(title)}</title>\n<link rel="icon" href="data:,">',
            f"<style>{style}</style>",
            body,
            *(
                f'<script type="application/octet-stream" id="{name}">{data}</script>'
                for name, data in (("code", code), ("shaders", shaders), ("packed", b64encode(packed).decode()))
            ),
            f'<script type="module">{_LOADER}</script>\n</html>\n',
        ]
    ).encode()


_LOADER = """
const bytesOf = (id) => Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
const unpacked = (id) => new Response(new Blob([bytesOf(id)]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
const { begin } = await import(URL.createObjectURL(new Blob([await unpacked("code")], { type: "text/javascript" })));
begin(JSON.parse(await unpacked("shaders")), bytesOf("packed"));
"""


def bundle(entry: str) -> str:
    """A module of the viewer and all that it imports as one text, each a function of its own under its name in
    `modules`."""
    done: dict[str, tuple[str, set[str]]] = {}

    def take(name: str) -> None:
        if name in done:
            return
        text = viewer_file(name)[0].decode()
        for names, other in _IMPORT.findall(text):
            take(other)
            if unknown := set(names.split(", ")) - done[other][1]:
                raise AssertionError(f"{name} imports {unknown}, which {other} does not export")
        done[name] = _as_function(name, text)

    take(entry)
    return "const modules = {};\n" + "\n".join(text for text, _ in done.values())


def _as_function(name: str, text: str) -> tuple[str, set[str]]:
    """A module as a function that is called at once, and what it exports."""
    exported = set(_EXPORT.findall(text))
    text = _COMMENTS.sub("", text)
    text = _IMPORT.sub(lambda match: f"const {{ {match[1]} }} = modules['{match[2]}'];\n", text)
    text = _EXPORT.sub("", text)
    if re.search(r"^(import|export)\b", text, re.MULTILINE):
        raise AssertionError(f"{name} imports or exports in another way than the others")
    return f"modules['{name}'] = (() => {{\n{text}\nreturn {{ {', '.join(sorted(exported))} }};\n}})();", exported
