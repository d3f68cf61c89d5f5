"""Objects of an S3 bucket: put whole or not at all, fetched, listed, removed; tried again where the server stumbles.

Where the server is and who asks stand in the environment as for every S3 program: AWS_ENDPOINT_URL, AWS_REGION,
AWS_ALLOW_HTTP, AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY; the last two may end in _FILE and name a file. A server must
know `If-None-Match` and `If-Match` of PUT.
"""

from __future__ import annotations

import errno
import functools
import os
import random
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any, TypeVar

SCHEME = "s3:"
OF_THIS_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # not of the server: trying again helps nothing
OBJECT_STORE = "the object store"  # how errors of one begin
TRIES, FIRST_WAIT_S, LONGEST_WAIT_S = 10, 0.05, 5.0  # 503 and cut connections: 20 s in all
T = TypeVar("T")


class Taken(Exception):
    """The object is there already, or is no longer the one that was to be replaced."""


@dataclass(frozen=True)
class Found:
    """What there is to know of an object without its bytes."""

    size: int
    tag: str
    changed: float  # seconds since 1970, by the server's clock


def is_remote(path: str | os.PathLike) -> bool:
    """Whether a path is a place in a bucket."""
    return os.fspath(path).startswith(SCHEME)


def put(path: Path, content: bytes | Path, over: str | None = "") -> str:
    """Store bytes, or a file's; returns the object's tag. `over` "" replaces what is there, None makes a new object,
    another tag replaces that one alone.

    Raises: Taken where None or a tag does not hold, OSError where the server does not answer.
    """
    from obstore.exceptions import AlreadyExistsError, PreconditionError

    mode: Any = "overwrite" if over == "" else "create" if over is None else {"e_tag": over}
    store, key = _place(path)
    try:
        return _again(path, lambda: store.put(key, content, mode=mode, use_multipart=_is_large(content, over))["e_tag"])
    except (AlreadyExistsError, PreconditionError) as error:
        raise Taken(str(path)) from error


def _is_large(content: bytes | Path, over: str | None) -> bool | None:
    """Conditions hold for puts of one piece alone; otherwise obstore sends large files in pieces."""
    return False if over != "" or isinstance(content, bytes) else None


def get(path: Path) -> tuple[bytes, str]:
    """All bytes and the tag. Raises FileNotFoundError."""
    store, key = _place(path)

    def fetched() -> tuple[bytes, str]:
        found = store.get(key)
        return bytes(found.bytes()), found.meta["e_tag"]

    return _again(path, fetched)


def download(path: Path, target: Path, make_room: Callable[[int], None]) -> int:
    """The object into a file; `make_room` hears its size first. Returns the size. Raises FileNotFoundError."""
    store, key = _place(path)

    def fetched() -> int:
        found = store.get(key)
        size = found.meta["size"]
        make_room(size)
        with open(target, "wb") as file:
            for block in found:
                file.write(block)
            if file.tell() != size:
                raise OSError(errno.EIO, f"{file.tell()} of {size} bytes", str(path))
        return size

    return _again(path, fetched)


def blocks(path: Path) -> Iterator[bytes]:
    """An object's bytes as they arrive. Raises OSError where they break off: what came before is lost to the caller."""
    store, key = _place(path)
    found = _again(path, lambda: store.get(key))
    try:
        yield from map(bytes, found)
    except Exception as error:
        raise OSError(errno.EIO, f"{OBJECT_STORE}: {str(error).splitlines()[0][:300]}", str(path)) from error


def head(path: Path) -> Found | None:
    """None where there is no such object."""
    store, key = _place(path)
    try:
        found = _again(path, lambda: store.head(key))
    except FileNotFoundError:
        return None
    return Found(found["size"], found["e_tag"], found["last_modified"].timestamp())


def listed(folder: Path) -> dict[str, int]:
    """Sizes of all objects below a folder, by name within it, in the order of their names."""
    store, key = _place(folder)
    found = _again(folder, lambda: [entry for batch in store.list(f"{key}/") for entry in batch])
    return dict(sorted((entry["path"][len(key) + 1 :], entry["size"]) for entry in found))


def remove(paths: list[Path]) -> None:
    """Objects of one bucket that are there or not."""
    if paths:
        store, keys = _place(paths[0])[0], [_place(path)[1] for path in paths]
        _again(paths[0], lambda: store.delete(keys))


def _place(path: Path) -> tuple[Any, str]:
    scheme, bucket, *key = path.parts
    assert scheme == SCHEME, path
    return _bucket(bucket, os.getpid()), "/".join(key)


@functools.lru_cache(maxsize=8)
def _bucket(name: str, _pid: int):
    return opened(name, None)


def opened(bucket: str, prefix: str | None):
    """A bucket, or what is below a prefix of it."""
    from obstore.store import S3Store

    retries: Any = {"max_retries": 3, "retry_timeout": timedelta(seconds=30)}
    plain = os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true")
    client: Any = {"timeout": "60s", "connect_timeout": "5s", "allow_http": plain}
    keys: Any = {name.removeprefix("AWS_").lower(): Path(file).read_text().strip() for name, file in _key_files()}
    return S3Store(bucket, prefix=prefix, retry_config=retries, client_options=client, **keys)


def _key_files() -> Iterator[tuple[str, str]]:
    """The keys that a file holds, as an orchestrator hands secrets over."""
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        if file := os.environ.get(name + "_FILE"):
            yield name, file


def _again(path: Path, do: Callable[[], T]) -> T:
    """The server may be busy or a connection may break: what is done here may be done twice."""
    for wait_s in waits():
        try:
            return do()
        except Exception as error:
            if not worth_another(error, wait_s is None, str(path)):
                raise
        time.sleep(wait_s or 0.0)
    raise AssertionError


def waits() -> Iterator[float | None]:
    """Seconds to wait after each try; None after the last."""
    for i in range(TRIES - 1):
        yield min(LONGEST_WAIT_S, FIRST_WAIT_S * 2**i) * random.uniform(0.5, 1.0)
    yield None


def worth_another(error: Exception, was_last: bool, what: str) -> bool:
    """Whether a request is to be made again after this. Raises OSError for the last, or where the server refuses."""
    from obstore.exceptions import (
        AlreadyExistsError,
        BaseError,
        NotSupportedError,
        PermissionDeniedError,
        PreconditionError,
        UnauthenticatedError,
    )

    if isinstance(error, FileNotFoundError) and "NoSuchBucket" in str(error):
        raise OSError(errno.EIO, f"{OBJECT_STORE}: the bucket is not there", what) from error
    if isinstance(error, (AlreadyExistsError, PreconditionError, FileNotFoundError)):
        return False
    if not isinstance(error, (BaseError, OSError)) or getattr(error, "errno", None) in OF_THIS_DISK:
        return False
    if was_last or isinstance(error, (NotSupportedError, PermissionDeniedError, UnauthenticatedError)):
        raise OSError(errno.EIO, f"{OBJECT_STORE}: {str(error).splitlines()[0][:300]}", what) from error
    return True
