"""Archives as hostile bytes: names, links, sizes, and what is opened without unpacking."""

import struct
import warnings
import zipfile

import pytest

from pipeline.readers import open_scan
from pipeline.readers.files import members
from pipeline.readers.files.members import Folder, open_archive
from pipeline.readers.files.spelling import by_name
from pipeline.readers.files.workspaces import find_workspace
from storage.errors import InvalidScan, UnsupportedScan


def archive_of(tmp_path, *names, content=b"abc"):
    path = tmp_path / "a.zip"
    with warnings.catch_warnings(), zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        warnings.simplefilter("ignore")  # zipfile warns of duplicates
        for name in names:
            archive.writestr(name, content)
    return str(path)


@pytest.mark.parametrize("name", ["../evil", "/etc/evil", "a/../../evil", "a\\..\\evil", "c:/evil"])
def test_members__refuses_names_that_leave_the_archive(tmp_path, name):
    with pytest.raises(InvalidScan, match="leaves the archive"):
        open_archive(archive_of(tmp_path, "fused.ply", name))


def test_members__refuses_a_name_that_occurs_twice(tmp_path):
    with pytest.raises(InvalidScan, match="fused.ply: a name that occurs twice"):
        open_archive(archive_of(tmp_path, "fused.ply", "fused.ply"))


def test_members__refuses_symbolic_links(tmp_path):
    link = zipfile.ZipInfo("images/a.png")
    link.external_attr = 0o120777 << 16
    with pytest.raises(InvalidScan, match="images/a.png: a symbolic link"):
        open_archive(archive_of(tmp_path, link, content=b"/etc/passwd"))


def test_members__refuses_a_bomb(tmp_path):
    with pytest.raises(InvalidScan, match="bytes unpacked from"):
        open_archive(archive_of(tmp_path, "fused.ply", content=bytes(1 << 20)))


def test_members__refuses_too_many_members(tmp_path, monkeypatch):
    monkeypatch.setattr(members, "MAX_ENTRIES", 2)
    with pytest.raises(InvalidScan, match="3 members; allowed: at most 2"):
        open_archive(archive_of(tmp_path, "a", "b", "c"))


def test_members__refuses_members_that_overlap(tmp_path):
    path = archive_of(tmp_path, "a", "b", content=bytes(range(256)))
    content = bytearray(open(path, "rb").read())
    for entry in (content.find(b"PK\1\2"), content.rfind(b"PK\1\2")):
        struct.pack_into("<I", content, entry + 20, 600)  # packed size
    open(path, "wb").write(content)
    with pytest.raises(InvalidScan, match="packed bytes"):
        open_archive(path)


def test_members__refuses_encryption(tmp_path):
    path = archive_of(tmp_path, "a")
    content = bytearray(open(path, "rb").read())
    content[content.find(b"PK\1\2") + 8] |= 1
    open(path, "wb").write(content)
    with pytest.raises(UnsupportedScan, match="encrypted"):
        open_archive(path)


def test_members__refuses_truncated_archives(tmp_path):
    path = archive_of(tmp_path, "fused.ply", "images/a.png")
    whole = open(path, "rb").read()
    for n in range(0, len(whole), 7):
        open(path, "wb").write(whole[:n])
        with pytest.raises(InvalidScan, match="a.zip"):
            open_scan(path)


@pytest.mark.parametrize("wrap", ["", "dense/", "project/dense/0/"])
def test_members__a_workspace_is_found_any_number_of_folders_down(tmp_path, wrap):
    names = ("fused.ply", "images/a.png", "sparse/cameras.bin", "sparse/images.bin")
    junk = ("__MACOSX/._a", ".DS_Store", "Thumbs.db", "readme.txt")
    archive = open_archive(archive_of(tmp_path, *(wrap + name for name in names), *junk))
    found = find_workspace(archive)
    assert (found.root, found.points, found.models) == (wrap, "fused.ply", ("sparse",))
    below = archive.below(found.root)
    assert below.size("fused.ply") == 3 and below.size("images/a.png") == 3
    with below.open("images/a.png") as stream:
        assert stream.read() == b"abc"


def test_members__two_workspaces_side_by_side_are_both_named(tmp_path):
    names = [f"{folder}/{name}" for folder in "ab" for name in ("fused.ply", "sparse/cameras.bin", "sparse/images.bin")]
    with pytest.raises(InvalidScan, match="'a/' and 'b/'"):
        find_workspace(open_archive(archive_of(tmp_path, *names)))


def test_members__backslashes_are_folders(tmp_path):
    archive = open_archive(archive_of(tmp_path, "scan\\images\\a.png"))
    assert archive.size("scan/images/a.png") == 3
    with archive.open("scan/images/a.png") as stream:
        assert stream.read() == b"abc"


def test_members__folder_and_archive_answer_alike(tmp_path):
    archive = open_archive(archive_of(tmp_path, "sub/b.txt", "fused.ply", content=b"hello"))
    (tmp_path / "f" / "sub").mkdir(parents=True)
    (tmp_path / "f" / "sub" / "b.txt").write_bytes(b"hello")
    for source in (archive, Folder(str(tmp_path / "f"))):
        assert source.size("sub/b.txt") == 5 and source.size("nothing") is None and source.size("sub") is None
        with source.open("sub/b.txt") as stream:
            assert stream.seek(1) == 1 and stream.read() == b"ello"
        with source.local("sub/b.txt") as path:
            assert open(path, "rb").read() == b"hello" and path.endswith(".txt")
        with source.local("sub/b.txt", 3) as path:
            assert open(path, "rb").read().startswith(b"hel")


def test_by_name__warnings_call_a_scan_and_what_lies_beside_it_by_their_names(tmp_path, monkeypatch):
    scan = tmp_path / "scan.e57"
    said = f"{scan}: no unit; {tmp_path}/scan.json is not read; elsewhere/scan.e57"
    assert by_name(said, str(scan)) == "scan.e57: no unit; scan.json is not read; elsewhere/scan.e57"
    monkeypatch.chdir(tmp_path)
    assert by_name(f"{scan}: no unit", "scan.e57") == "scan.e57: no unit" == by_name("scan.e57: no unit", "scan.e57")
