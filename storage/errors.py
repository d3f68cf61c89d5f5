"""The whole tree of errors, each with what was found, where, and what is allowed.

SplatpressError              kind        exit code
|- InvalidScan               data        3
|- UnsupportedScan           data        5
|- InvalidPackedFile         data        3
|- ResourceExhausted         resource    2
`- InternalError             internal    4
"""

from __future__ import annotations


class SplatpressError(Exception):
    """Base of every error a user may see. `kind` says whose turn it is: data, resource or internal."""

    kind = "internal"
    exit_code = 4

    def __init__(self, where: str, found: str, allowed: str = "", hint: str = "") -> None:
        self.where, self.found, self.allowed, self.hint = where, found, allowed, hint
        parts = [f"{where}: {found}"]
        if allowed:
            parts.append(f"allowed: {allowed}")
        if hint:
            parts.append(hint)
        super().__init__("; ".join(parts))

    @property
    def title(self) -> str:
        """What a line of a terminal calls it."""
        return f"{self.kind} error"

    def __reduce__(self):
        return type(self), (self.where, self.found, self.allowed, self.hint)


class InvalidScan(SplatpressError):
    """A scan that breaks its own format: name the file, the field and the value."""

    kind = "data"
    exit_code = 3


class UnsupportedScan(SplatpressError):
    """A scan that is well formed but of a sort that is not handled: name the sort and what is handled."""

    kind = "data"
    exit_code = 5


class InvalidPackedFile(SplatpressError):
    """A packed file that is truncated, altered, or of an unknown version."""

    kind = "data"
    exit_code = 3


class ResourceExhausted(SplatpressError):
    """Disk, memory or another resource ran out, or could not be had."""

    kind = "resource"
    exit_code = 2


class InternalError(SplatpressError):
    """A mistake of ours; the message says which invariant broke."""
