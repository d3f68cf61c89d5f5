"""Files that are there under their name whole, or not at all; in a bucket too."""

from __future__ import annotations

import os
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
