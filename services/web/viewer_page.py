"""The viewer's files: its page, its style and all its modules as one script, as a server sends them; or all in one page
that opens without one."""

from __future__ import annotations

import html
import json
import re
import zlib
from functools import cache
from pathlib import Path

import numpy as np
import rjsmin

from renderer.splats.gles import shader_document
from storage.packed.dictionaries.shipped import FOLDER as ATOMS
from storage.packed.dictionaries.shipped import SUFFIX

FOLDER = Path(__file__).parent / "viewer"
PAGE, SCRIPT, SHADERS = "index.html", "page.js", "shaders.json"
MEDIA_TYPES = {".js": "text/javascript", ".css": "text/css", ".html": "text/html", ".json": "application/json"}
MEDIA_TYPES |= {SUFFIX: "application/octet-stream"}
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' blob: data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# Of the one page: its script is text of its own, and becomes modules of its own; nothing is asked of anyone.
_POLICY_OF_ONE_PAGE = "default-src 'none'; script-src 'unsafe-inline' blob:; style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'"
_IMPORT = re.compile(r'^import \{ ([\w, ]+) \} from "\./([\w.]+)";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:function|class|const) (\w+))", re.MULTILINE)


@cache
def viewer_file(name: str) -> tuple[bytes, str] | None:
    """Contents and media type of a file of the viewer; None where there is none of that name. SCRIPT comes with all
    that it imports, and bare; its modules alone are for who looks at them."""
    media_type = MEDIA_TYPES.get(Path(name).suffix)
    if name == SHADERS:
        return json.dumps(shader_document()).encode(), media_type
    path = (ATOMS if name.endswith(SUFFIX) else FOLDER) / name
    if media_type is None or Path(name).name != name or not path.is_file():
        return None
    return (_script() if name == SCRIPT else path.read_bytes()), media_type


def _script() -> bytes:
    page = _IMPORT.sub(_taken, (FOLDER / SCRIPT).read_text())
    return rjsmin.jsmin(f"{bundle('start.js')}\n{page}").encode()


def one_page(packed: bytes, title: str, atoms: bytes = b"") -> bytes:
    """One page that holds the viewer, a packed file, and the file of the dictionary that it names if it does; it opens
    from a disk and asks nothing of anyone.

    Guarantees: at most 16/13 of these files and 60 kB.
    """
    style, page = (viewer_file(name)[0].decode() for name in ("viewer.css", PAGE))
    body = page[page.index("<body>") + len("<body>") : page.index("</body>")]
    program = rjsmin.jsmin(f"{bundle('start.js')}\nexport const begin = modules['start.js'].begin;")
    viewer = json.dumps([style, body, program, shader_document()], separators=(",", ":"))
    parts = {"viewer": zlib.compress(viewer.encode(), 9), "packed": packed} | ({"shipped": atoms} if atoms else {})
    return "\n".join(
        [
            '<!doctype html>\n<html lang="en">\n<meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY_OF_ONE_PAGE}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f'<title>{html.escape(title)}</title>\n<link rel="icon" href="data:,">\n<body>',
            *(
                f'<script type="application/octet-stream" id="{name}" data-bytes="{len(data)}">{as_text(data)}</script>'
                for name, data in parts.items()
            ),
            f'<script type="module">{rjsmin.jsmin(_LOADER)}</script>\n</body>\n</html>\n',
        ]
    ).encode()


def as_text(data: bytes) -> str:
    """Bytes as printable ASCII but `"`, `&` and `<`: 13 bits, the lowest first, as two of 91 characters, the first the
    higher one.

    >>> as_text(b"a")
    '#)'
    """
    digits = np.array([c for c in range(33, 127) if chr(c) not in '"&<'], np.uint8)
    weight, text = 1 << np.arange(13), []
    for start in range(0, len(data), _BLOCK):
        block = np.frombuffer(data[start : start + _BLOCK], np.uint8)
        bits = np.unpackbits(block, bitorder="little")
        numbers = np.pad(bits, (0, -len(bits) % 13)).reshape(-1, 13) @ weight
        text.append(digits[np.stack(np.divmod(numbers, 91), axis=1)].tobytes().decode())
    return "".join(text)


_BLOCK = 13 << 16  # whole pairs of characters
_LOADER = """
const bytesOf = (id) => {
  const element = document.getElementById(id), text = element.textContent, bytes = new Uint8Array(Number(element.dataset.bytes));
  const digit = (i, c = text.charCodeAt(i)) => c - 33 - (c > 34) - (c > 38) - (c > 60);
  for (let i = 0, at = 0, bits = 0, n = 0; at < bytes.length; i += 2) {
    bits |= (91 * digit(i) + digit(i + 1)) << n;
    for (n += 13; n > 7; n -= 8, bits >>>= 8) bytes[at++] = bits;
  }
  element.remove();
  return bytes;
};
const stream = new Blob([bytesOf("viewer")]).stream().pipeThrough(new DecompressionStream("deflate"));
const [style, body, program, shaders] = await new Response(stream).json();
document.head.append(Object.assign(document.createElement("style"), { textContent: style }));
document.body.insertAdjacentHTML("afterbegin", body);
const { begin } = await import(URL.createObjectURL(new Blob([program], { type: "text/javascript" })));
begin(shaders, bytesOf("packed"), document.getElementById("shipped") && bytesOf("shipped"));
"""


def _taken(found: re.Match) -> str:
    return f"const {{ {found[1]} }} = modules['{found[2]}'];\n"


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
    text = _IMPORT.sub(_taken, text)
    text = _EXPORT.sub("", text)
    if re.search(r"^(import|export)\b", text, re.MULTILINE):
        raise AssertionError(f"{name} imports or exports in another way than the others")
    return f"modules['{name}'] = (() => {{\n{text}\nreturn {{ {', '.join(sorted(exported))} }};\n}})();", exported
