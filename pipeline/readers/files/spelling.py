"""Names of files as other programs spell them: bytes that may be UTF-8, cp437 (zip), cp1252 (Windows), composed or not.

A name travels as Python's file functions give it (bytes that are no UTF-8 as surrogates); `shown` is for people.
"""

from __future__ import annotations

import os
import re
import tempfile
import unicodedata
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

_ENCODINGS = ("utf-8", "cp437", "cp1252")
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\ud800-\udfff]")
JUNK = (".ds_store", "thumbs.db", "desktop.ini", "ehthumbs.db", ".spotlight-v100", ".trashes", ".fseventsd")
JUNK_FOLDERS = ("__macosx", ".git", ".spotlight-v100", ".trashes", "@eadir", "$recycle.bin")


def name_of(raw: bytes) -> str:
    """The name as Python's file functions have it."""
    return raw.decode("utf-8", "surrogateescape")


def raw_of(name: str) -> bytes:
    """The inverse of `name_of`."""
    return name.encode("utf-8", "surrogateescape")


def shown(name: str) -> str:
    """A name that can be printed and kept in any file: bytes that are no UTF-8 are taken as Windows' Western European.

    >>> shown(name_of("für".encode("latin-1"))), shown("a b.png")
    ('für', 'a b.png')
    """
    raw = raw_of(name)
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError:
        text = raw.decode("cp1252", "replace")
    return _CONTROL.sub("�", text)


def composed(name: str) -> str:
    """The name as it is shown, with accents composed: what only encodings tell apart is equal."""
    return unicodedata.normalize("NFC", shown(name))


def is_junk(name: str) -> bool:
    """Whether a member, by its path, is what a file manager left behind."""
    parts = name.lower().split("/")
    return parts[-1] in JUNK or parts[-1].startswith("._") or any(p in JUNK_FOLDERS for p in parts[:-1])


def _spellings(raw: bytes) -> set[str]:
    """All that the bytes may have been meant to say, composed."""
    if raw.isascii():
        return {raw.decode("ascii")}
    found = set()
    for encoding in _ENCODINGS:
        try:
            found.add(unicodedata.normalize("NFC", raw.decode(encoding)))
        except UnicodeDecodeError:
            continue
    return found or {name_of(raw)}


@dataclass
class Names:
    """The files of a scan, to be found by names that are spelled otherwise."""

    exact: set[str] = field(default_factory=set)
    _spelled: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    _folded: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    _ending: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))

    @staticmethod
    def of(names: Iterable[str]) -> Names:
        made = Names()
        for name in names:
            made.exact.add(name)
            for spelled in _spellings(raw_of(name)):
                made._spelled[spelled].add(name)
                made._folded[spelled.casefold()].add(name)
                made._ending[spelled.casefold().rpartition("/")[2]].add(name)
        return made

    def find(self, wanted: str) -> tuple[str, ...]:
        """The files that a name can mean, at the first of these that any fits: as it is, in another encoding, in another case."""
        if wanted in self.exact:
            return (wanted,)
        for raw in dict.fromkeys((raw_of(wanted), raw_of(wanted).replace(b"\\", b"/"))):
            for index, fold in ((self._spelled, str), (self._folded, str.casefold)):
                found: set[str] = set()
                for spelled in _spellings(raw):
                    found |= index.get(fold(spelled), set())
                if found:
                    return tuple(sorted(found))
        return ()

    def find_ending(self, wanted: str) -> tuple[str, ...]:
        """The files whose paths end with a name, whatever folders it lies in."""
        wanted = wanted.replace("\\", "/").lstrip("./")
        found: set[str] = set()
        for spelled in _spellings(raw_of(wanted)):
            ending = "/" + spelled.casefold()
            candidates = self._ending.get(ending.rpartition("/")[2], set())
            found |= {
                n for n in candidates if any(("/" + s.casefold()).endswith(ending) for s in _spellings(raw_of(n)))
            }
        return tuple(sorted(found))


@contextmanager
def plain_path(path: str) -> Iterator[str]:
    """A path to the same file that is UTF-8, for libraries that take no other."""
    try:
        path.encode("utf-8")
        yield path
    except UnicodeEncodeError:
        with tempfile.TemporaryDirectory(prefix="splatpress-") as folder:
            link = os.path.join(folder, "scan" + re.sub(r"[^.\w]", "", os.path.splitext(shown(path))[1]))
            os.symlink(os.path.abspath(path), link)
            yield link


def by_name(text: str, path: str) -> str:
    """A warning that calls the scan at `path`, and what lies beside it, by their names: reports travel, folders do not.

    >>> by_name("/data/a/scan.e57: no unit; /data/a/scan.json is not read", "/data/a/scan.e57")
    'scan.e57: no unit; scan.json is not read'
    """
    for scan in (Path(path), Path(path).resolve()):
        text = text.replace(str(scan), scan.name)
        if scan.is_absolute():
            text = text.replace(f"{scan.parent}/", "")
    return text
