"""The page file: photographs cut into pages, each coded alone, behind one table of where they lie (docs/PAGES.md).

    8 bytes       magic
    4 bytes       length of the header, little-endian
    header        JSON: version, scan, page_px, border_px, codec, one_light, photographs [{name, width_px, height_px}],
                  n_pages, bytes
    table         a row a page: offset uint64, length uint32, check 8 bytes (BLAKE2b of the page)
    32 bytes      SHA-256 of all before it
    pages         in the order of their numbers (storage/pages/layout.py)

A reader takes everything before the pages by one Range, and each page by one more.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from storage.errors import InvalidPackedFile
from storage.packed.schema import Camera
from storage.pages.layout import PageLayout
from storage.whole import whole

MAGIC, VERSION = b"SPLPAGES", 1
SUFFIX = ".pages"
CODECS = ("jpeg", "webp", "png", "bc7")
CHECK_BYTES = 8
ROW = np.dtype([("offset", "<u8"), ("length", "<u4"), ("check", "V8")])
MOST_HEADER = 64 << 20
MOST_PHOTOS, MOST_SIDE, MOST_PAGE_PX = 1 << 20, 1 << 17, 1024


@dataclass(frozen=True)
class PageHeader:
    """What all pages of a file share."""

    names: tuple[str, ...]  # of the photographs
    layout: PageLayout
    border_px: int  # on each side of a page, of the texels of its neighbours
    codec: str
    scan: str  # `scan_digest` of the scan's cameras, or `stations_digest`
    one_light: bool = False  # photographs as the effect `exposure` corrected them, else as they were taken

    @property
    def side_px(self) -> int:
        """Of a stored page."""
        return self.layout.page_px + 2 * self.border_px

    def to_json(self, n_bytes: int) -> bytes:
        photographs = [
            {"name": name, "width_px": width, "height_px": height}
            for name, (width, height) in zip(self.names, self.layout.sizes_px, strict=True)
        ]
        return json.dumps(
            {
                "version": VERSION,
                "scan": self.scan,
                "page_px": self.layout.page_px,
                "border_px": self.border_px,
                "codec": self.codec,
                "one_light": self.one_light,
                "photographs": photographs,
                "n_pages": self.layout.n_pages,
                "bytes": n_bytes,
            }
        ).encode()


def scan_digest(cameras: Sequence[Camera]) -> str:
    """What a page file and a packed file of one scan share: names, sizes and poses of its photographs, as 16
    hexadecimal digits."""
    text = json.dumps([asdict(camera) for camera in cameras], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def stations_digest(centres: Sequence[tuple[float, float, float]]) -> str:
    """What a page file of station maps is told by: where the stations stood, as 16 hexadecimal digits."""
    return hashlib.sha256(json.dumps([list(centre) for centre in centres]).encode()).hexdigest()[:16]


def page_check(page: bytes) -> bytes:
    """The check of a page's bytes: blake2b, CHECK_BYTES long."""
    return hashlib.blake2b(page, digest_size=CHECK_BYTES).digest()


def write_pages(path: Path, header: PageHeader, pages: Iterable[bytes]) -> int:
    """Write all pages, in the order of their numbers; returns the file's bytes. The file is there whole, or not at all.

    The pages are streamed: only the table (20 bytes a page) is held.
    """
    rows = np.zeros(header.layout.n_pages, ROW)
    # The header states the file's length, which has as many digits as room is left for.
    length = len(header.to_json(10**18))
    start = len(MAGIC) + 4 + length + rows.nbytes + 32
    with whole(path) as partial, open(partial, "wb") as stream:
        stream.seek(start)
        at = start
        count = 0
        for count, page in enumerate(pages, 1):
            rows[count - 1] = (at, len(page), page_check(page))
            stream.write(page)
            at += len(page)
        if count != len(rows):
            raise ValueError(f"{count} pages for a layout of {len(rows)}")
        head = MAGIC + struct.pack("<I", length) + header.to_json(at).ljust(length) + rows.tobytes()
        stream.seek(0)
        stream.write(head + hashlib.sha256(head).digest())
        stream.flush()
        os.fsync(stream.fileno())
    return at


class PageFile:
    """An open page file. `read(page)` gives the bytes of one page.

    Raises: InvalidPackedFile for a file that is cut, altered or of another version; of a page, when it is read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._stream = open(path, "rb")
        try:
            self.header, self._rows = self._head()
        except BaseException:
            self._stream.close()
            raise

    def __enter__(self) -> PageFile:
        return self

    def __exit__(self, *error) -> None:
        self._stream.close()

    @property
    def layout(self) -> PageLayout:
        return self.header.layout

    def lengths(self) -> np.ndarray:
        """(n_pages,) bytes of each page."""
        return self._rows["length"].astype(np.int64)

    def read(self, page: int) -> bytes:
        """The coded bytes of a page; threads may read side by side."""
        row = self._rows[page]
        data = os.pread(self._stream.fileno(), int(row["length"]), int(row["offset"]))
        if page_check(data) != row["check"].tobytes():
            raise InvalidPackedFile(str(self.path), f"page {page} differs from its check", "a whole page", "altered")
        return data

    def _head(self) -> tuple[PageHeader, np.ndarray]:
        size = os.fstat(self._stream.fileno()).st_size
        start = self._stream.read(len(MAGIC) + 4)
        if not start.startswith(MAGIC) or len(start) < len(MAGIC) + 4:
            raise self._wrong("no page file's first bytes")
        (length,) = struct.unpack("<I", start[len(MAGIC) :])
        if length > min(MOST_HEADER, size):
            raise self._wrong(f"a header of {length} bytes")
        text = self._stream.read(length)
        header, n_bytes = self._parsed(text)
        n_table = header.layout.n_pages * ROW.itemsize
        if n_table > size:
            raise self._wrong(f"a table of {header.layout.n_pages} pages in a file of {size} bytes")
        table, digest = self._stream.read(n_table), self._stream.read(32)
        if hashlib.sha256(start + text + table).digest() != digest:
            raise self._wrong("a header or table that differs from its SHA-256")
        if n_bytes != size:
            raise self._wrong(f"{size} bytes where its header says {n_bytes}")
        rows = np.frombuffer(table, ROW)
        ends = rows["offset"].astype(np.int64) + rows["length"]
        begins = np.append(rows["offset"].astype(np.int64), size)
        if begins[0] != len(start) + length + n_table + 32 or not np.array_equal(ends, begins[1:]):
            raise self._wrong("a table whose pages do not follow each other")
        return header, rows

    def _parsed(self, text: bytes) -> tuple[PageHeader, int]:
        try:
            data = json.loads(text)
            photos = data["photographs"]
            if data["version"] != VERSION or data["codec"] not in CODECS or not 0 <= len(photos) <= MOST_PHOTOS:
                raise ValueError(f"version {data['version']}, codec {data['codec']}")
            sizes = tuple((int(p["width_px"]), int(p["height_px"])) for p in photos)
            page_px, border_px = int(data["page_px"]), int(data["border_px"])
            if not (16 <= page_px <= MOST_PAGE_PX and 0 <= border_px <= page_px // 2):
                raise ValueError(f"pages of {page_px} px with a border of {border_px}")
            if any(not (1 <= w <= MOST_SIDE and 1 <= h <= MOST_SIDE) for w, h in sizes):
                raise ValueError(f"a photograph that is not 1 to {MOST_SIDE} px wide and high")
            layout = PageLayout(sizes, page_px)
            if layout.n_pages != data["n_pages"]:
                raise ValueError(f"{data['n_pages']} pages where the photographs have {layout.n_pages}")
            names = tuple(str(p["name"]) for p in photos)
            header = PageHeader(
                names, layout, border_px, data["codec"], str(data["scan"]), data.get("one_light") is True
            )
            return header, int(data["bytes"])
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise self._wrong(f"a header that is none ({type(error).__name__}: {error})") from error

    def _wrong(self, found: str) -> InvalidPackedFile:
        return InvalidPackedFile(str(self.path), found, f"a whole page file of version {VERSION}", "cut or altered")
