"""What a benchmark needs beside the program, said in a line where it is missing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def packages_of_tests() -> Iterator[None]:
    """Around imports of `tests`: where a package of theirs is missing, the program ends and says how to have it."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise SystemExit(
            f"this benchmark needs what tests need, and {error.name} is missing: deploy/setup.sh .venv with-tests"
        ) from None
