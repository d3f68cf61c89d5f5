"""Files, in a bucket too, and folders of this machine that are there under their name whole, or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from storage import place


@contextmanager
def whole(path: Path, suffix: str = ".partial") -> Iterator[Path]:
    """A path beside `path` to write to, of its own, which gets that name at the end; where writing fails nothing is
    left. `suffix` is what its name ends in, for libraries that go by it."""
    if place.is_remote(path):
        with place.written(path, suffix) as partial:
            yield partial
        return
    partial = path.with_name(f"{path.name}.{uuid.uuid4().hex}{suffix}")
    try:
        yield partial
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


@contextmanager
def aside(out: Path) -> Iterator[Path]:
    """A folder beside `out`, on its disk, for what is made on the way; it goes at the end."""
    out.parent.mkdir(parents=True, exist_ok=True)
    made = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    try:
        yield made
    finally:
        shutil.rmtree(made, ignore_errors=True)


@contextmanager
def placed_whole(out: Path) -> Iterator[Path]:
    """A folder beside `out` to make things in, which becomes `out` at the end; where making fails nothing is left, and
    an older `out` stays."""
    with aside(out) as made:
        yield made
        put_in_place(made, out)


def put_in_place(made: Path, out: Path) -> None:
    """Let `out` be what was made; an older `out` goes only when the new one is whole."""
    made.chmod(0o777 & ~_umask())  # mkdtemp makes folders for their owner alone
    old = made.with_name(made.name + ".old")
    if out.exists():
        os.replace(out, old)
    os.replace(made, out)
    shutil.rmtree(old, ignore_errors=True)


def _umask() -> int:
    """What the process takes from the rights of new files. Reading it sets it for a moment: not beside threads that
    make files."""
    mask = os.umask(0o077)
    os.umask(mask)
    return mask
