"""What is wrong with an E57 file, in our own words: libe57's speak of its own states, and name its sources.

References: ASTM E2807-11, section 7.3 (the header); libE57Format's codes of errors.
"""

from __future__ import annotations

import os
import re
import struct

from storage.errors import InvalidScan

HEADER = struct.Struct(
    "<8sIIQQQQ"
)  # signature, version, length of the file, where its XML lies and how long it is, page
SIGNATURE = b"ASTM-E57"
LARGEST_PAGE = 1 << 20
_CODE = re.compile(r"\(Error(\w+)\)|(E57_ERROR_\w+)")
_PAGE = re.compile(r"\bpage=(\d+)")
_WORDS = {
    "BadXMLFormat": "its XML does not follow the standard",
    "XMLParser": "its XML cannot be parsed",
    "XMLParserInit": "its XML cannot be parsed",
    "BadCVHeader": "the header of a section of points is broken",
    "BadCVPacket": "a packet of points is broken",
    "ChildIndexOutOfBounds": "an entry is asked for that is not there",
    "PathUndefined": "an entry that the standard asks for is missing",
    "BadNodeDowncast": "an entry is of another kind than the standard asks for",
    "BadPrototype": "the fields of its points do not follow the standard",
    "ValueNotRepresentable": "a value does not fit the field that holds it",
    "ScaledValueNotRepresentable": "a value does not fit the field that holds it",
    "ValueOutOfBounds": "a value lies outside of its field's bounds",
    "Real64TooLarge": "a value is too large for its field",
    "InternalError": "its parts contradict each other",
    "Internal": "its parts contradict each other",
    "ReadFailed": "its data ends early",
    "LseekFailed": "it names places that lie outside of it",
}


def check_header(path: str) -> None:
    """Whether the header of a file and its length agree.

    Raises: InvalidScan with what was found and what is allowed.
    """
    n_bytes = os.path.getsize(path)
    with open(path, "rb") as stream:
        head = stream.read(HEADER.size)
    if len(head) < HEADER.size:
        allowed = f"an E57 file, whose header alone has {HEADER.size}"
        raise InvalidScan(path, f"{len(head)} bytes", allowed, "the file may be truncated")
    signature, major, minor, told, xml, xml_bytes, page = HEADER.unpack(head)
    if signature != SIGNATURE:
        raise InvalidScan(path, f"it begins with {signature!r}", f"{SIGNATURE!r}, an E57 file")
    if told != n_bytes:
        hint = "the file may be truncated" if n_bytes < told else "something was added to it"
        raise InvalidScan(path, f"{n_bytes} bytes, of which its header says that they are {told}", "the same", hint)
    if not 64 <= page <= LARGEST_PAGE:
        raise InvalidScan(path, f"pages of {page} bytes", f"64 to {LARGEST_PAGE}")
    if xml + xml_bytes > n_bytes:
        raise InvalidScan(path, f"XML of {xml_bytes} bytes at {xml} in {n_bytes} bytes", "inside of the file")
    if major != 1:
        raise InvalidScan(path, f"version {major}.{minor}", "version 1.0")


def reason_of(error: Exception) -> str:
    """Why a file could not be read, from what libe57 or a lookup in its tree raised."""
    text = str(error)
    code = _CODE.search(text)
    name = (code.group(1) or code.group(2).removeprefix("E57_ERROR_")) if code else ""
    if name.replace("_", "").lower() == "badchecksum":
        page = _PAGE.search(text)
        return f"the checksum of page {page.group(1)} is wrong" if page else "the checksum of a page is wrong"
    by_name = {key.lower(): words for key, words in _WORDS.items()}
    return by_name.get(name.replace("_", "").lower(), "its structure is not that of the standard")
