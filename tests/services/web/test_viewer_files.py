"""What the viewer reads: ranges of a file over connections that break, its decoder of zstd, and what is damaged; and
its one page."""

from __future__ import annotations

import gzip
import hashlib
import json
from base64 import b64encode

import httpx
import numpy as np
import pytest
from numcodecs import Zstd

from services.processes.export import export
from services.web.viewer_page import FOLDER, POLICY, viewer_file
from storage.packed.dictionaries.shipped import NEWEST, file_of
from tests.packed_files import Case, write_packed_file
from tests.services.chromium import Page, chromium_path
from tests.services.web.served import READY, open_viewer, serving, small

needs_chromium = pytest.mark.skipif(chromium_path() is None, reason="needs Chromium (apt-get install chromium)")


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    return write_packed_file(Case(cliplines=True, ellipsoids=True), tmp_path_factory.mktemp("packed") / "a.splatpress")


@pytest.fixture(scope="module")
def url(packed):
    with serving(packed) as address:
        yield address


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    opened = Page(tmp_path_factory.mktemp("profile"))
    small(opened)
    yield opened
    opened.close()


@pytest.fixture(autouse=True)
def _without_complaints_of_others(request):
    if "page" in request.fixturenames:
        request.getfixturevalue("page").complaints.clear()


def frames() -> list[tuple[bytes, int]]:
    """Contents of many kinds, and levels of compression."""
    rng = np.random.default_rng(0)
    words = [b"splat", b"press ", b"abc", b"the quick brown fox ", b"0123"]
    kinds = [
        b"",
        b"a",
        b"a" * 100_000,
        rng.bytes(300),
        rng.bytes(70_000),
        b"".join(words[i] for i in rng.integers(0, 5, 20_000)),
    ]
    kinds += [
        rng.integers(0, 4, 60_000).astype(np.uint8).tobytes(),
        rng.normal(0, 10, 60_000).astype(np.int8).tobytes(),
    ]
    kinds += [np.cumsum(rng.integers(-2, 3, 30_000)).astype("<i4").tobytes()]
    kinds += [rng.integers(0, 30, n).astype(np.uint8).tobytes() for n in (255, 256, 257, 65_535, 65_791, 65_792)]
    return [(contents, level) for contents in kinds for level in (1, 9, 22)]


def filled(script: str, frame: bytes, size: int) -> str:
    return script.replace("BASE64", b64encode(frame).decode()).replace("SIZE", str(size))


@needs_chromium
def test_zstd__decodes_what_the_library_encodes_and_refuses_what_is_damaged(page, url):
    page.open(url)
    page.until("document.readyState === 'complete'")
    script = """(async () => {
      const { decompress } = await import('/web/viewer/zstd.js');
      const bytes = Uint8Array.from(atob('BASE64'), (c) => c.charCodeAt(0));
      const whole = decompress(bytes, SIZE);
      const digest = await crypto.subtle.digest('SHA-256', whole);
      let refused = 0;
      for (const size of [SIZE - 1, SIZE + 1]) try { decompress(bytes, size); } catch (error) { refused += error.message.includes('contents of'); }
      for (let i = 1; i < 40; ++i) try { decompress(bytes.subarray(0, Math.floor(bytes.length * i / 40)), SIZE); } catch (error) { refused += error instanceof Error; }
      return JSON.stringify([[...new Uint8Array(digest)].map((b) => b.toString(16).padStart(2, '0')).join(''), refused]);
    })()"""
    for contents, level in frames():
        n = len(contents)
        found = page.look(filled(script, Zstd(level).encode(contents), n))
        digest, refused = json.loads(found)
        assert digest == hashlib.sha256(contents).hexdigest(), (n, level)
        assert refused == 41, (n, level)


@needs_chromium
def test_zstd__never_ends_in_anything_but_an_error_of_words(page, url):
    """Every byte of a frame changed in turn: contents, or an Error; no endless loop, no other exception."""
    page.open(url)
    page.until("document.readyState === 'complete'")
    contents = np.random.default_rng(1).normal(0, 9, 2000).astype(np.int8).tobytes()
    script = """(async () => {
      const { decompress } = await import('/web/viewer/zstd.js');
      const bytes = Uint8Array.from(atob('BASE64'), (c) => c.charCodeAt(0)), kinds = {};
      for (let i = 0; i < bytes.length; ++i) for (const flip of [1, 0x80, 0xff]) {
        const other = bytes.slice();
        other[i] ^= flip;
        let kind = 'contents';
        try { decompress(other, SIZE); } catch (error) { kind = error.constructor.name + (error.message.startsWith('damaged zstd frame: ') ? '' : ': ' + error.message); }
        kinds[kind] = (kinds[kind] || 0) + 1;
      }
      return JSON.stringify(kinds);
    })()"""
    found = page.look(filled(script, Zstd(9).encode(contents), len(contents)))
    assert set(json.loads(found)) <= {"contents", "Error"}, found


def cutting(after: int, most: int):
    """An app whose answers about the file break off after so many bytes, the first `most` times."""

    def wrapped(app):
        cut = [0]

        async def broken(scope, receive, send):
            left = [after]

            async def sent(message):
                if message["type"] == "http.response.body" and scope["path"] == "/content" and cut[0] < most:
                    body = message.get("body", b"")
                    if len(body) > left[0]:
                        cut[0] += 1
                        await send({"type": "http.response.body", "body": body[: left[0]], "more_body": True})
                        raise ConnectionError("cut on purpose")
                    left[0] -= len(body)
                await send(message)

            await app(scope, receive, sent)

        return broken

    return wrapped


@needs_chromium
def test_viewer__goes_on_where_a_connection_broke(page, packed):
    whole = packed.stat().st_size
    with serving(packed, cutting(after=20_000, most=3)) as address:
        open_viewer(page, address)
        found = json.loads(page.look("JSON.stringify(viewer.statistics())"))
    assert found["complete"] and found["requests"] > 3 and found["received"] < 2 * whole + 65_536


@needs_chromium
@pytest.mark.parametrize(("damage", "words"), [
    (lambda data: data[:-1], "does not end in a seal"),
    (lambda data: b"no packed file at all", "does not end in a seal"),
    (lambda data: data.replace(b'"version": 1', b'"version": 9'), "version 9"),
])  # fmt: skip
def test_viewer__says_what_is_wrong_with_a_file(page, packed, damage, words, tmp_path):
    (tmp_path / "bad.splatpress").write_bytes(damage(packed.read_bytes()))
    with serving(tmp_path / "bad.splatpress") as address:
        page.open(address)
        page.until(READY)
        assert words in page.look("document.getElementById('problem').textContent")


@needs_chromium
def test_viewer__asks_no_other_host_for_its_content(page, url):
    page.open(url + "?content=https://example.com/a.splatpress")
    page.until(READY)
    assert "allowed: addresses of this host" in page.look("document.getElementById('problem').textContent")
    assert page.complaints == []


@needs_chromium
def test_one_page__opens_from_a_disk_and_asks_for_nothing(tmp_path):
    """Also of a file that holds no atoms, whose dictionary then is in the page."""
    case = Case(dictionary_bits=12, n_dictionary=512, atom_size=16, n_turns=8, shipped=True)
    packed = write_packed_file(case, tmp_path / "a.splatpress")
    made = export(packed, "html", tmp_path / "a.html")
    assert made.n_bytes <= 1.24 * (packed.stat().st_size + file_of(NEWEST).stat().st_size) + 60_000
    opened = Page(tmp_path / "profile")
    small(opened)
    try:
        open_viewer(opened, (tmp_path / "a.html").as_uri())
        assert opened.look("viewer.splats") == 300 and opened.look("document.title").startswith("tiny")
        assert opened.complaints == [f"asked {(tmp_path / 'a.html').as_uri()}"]
    finally:
        opened.close()


def test_viewer__is_small():
    """All of its script, which is one file."""
    script = viewer_file("page.js")[0]
    assert b"import " not in script and all(
        path.name.encode() in script for path in FOLDER.glob("*.js") if path.name != "page.js"
    )
    assert len(gzip.compress(script, 9)) <= 40_000


def test_viewing__answers_this_machine_alone_and_in_ranges(url, packed):
    content, data = url + "content", packed.read_bytes()
    whole = httpx.get(content)
    assert whole.content == data and whole.headers["content-security-policy"] == POLICY
    part = httpx.get(content, headers={"Range": "bytes=-100"})
    assert part.status_code == 206 and part.content == data[-100:]
    assert part.headers["etag"] == whole.headers["etag"] and data[-64:].decode() in part.headers["etag"]
    assert httpx.get(content, headers={"Host": "evil.example"}).status_code == 403
    for name in ("../viewer_page.py", "..%2fviewer_page.py", "viewer_page.py", "none.js"):
        assert httpx.get(f"{url}web/viewer/{name}").status_code in (404, 405), name
    assert viewer_file("../viewer_page.py") is None


def test_viewer__names_only_addresses_of_its_own_host():
    for path in FOLDER.iterdir():
        text = path.read_text()
        assert not [word for word in ("https://", "//cdn", "eval(", "innerHTML") if word in text], path.name
