"""A folder of a bucket as zarr sees it, where what zarr asks for is asked again when the server stumbles."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from zarr.storage import ObjectStore

from storage.place.objects import opened, waits, worth_another


class PatientStore(ObjectStore):
    """zarr's own store of objects; listings are short here, and made in one request."""

    async def get(self, *arguments: Any, **how: Any) -> Any:
        return await _again(lambda: ObjectStore.get(self, *arguments, **how))

    async def exists(self, key: str) -> bool:
        return await _again(lambda: ObjectStore.exists(self, key))

    async def set(self, *arguments: Any, **how: Any) -> None:
        await _again(lambda: ObjectStore.set(self, *arguments, **how))

    async def set_if_not_exists(self, *arguments: Any, **how: Any) -> None:
        await _again(lambda: ObjectStore.set_if_not_exists(self, *arguments, **how))

    async def delete(self, key: str) -> None:
        await _again(lambda: ObjectStore.delete(self, key))

    async def delete_dir(self, prefix: str) -> None:
        await _again(lambda: ObjectStore.delete_dir(self, prefix))

    async def getsize(self, key: str) -> int:
        return await _again(lambda: ObjectStore.getsize(self, key))

    async def list_prefix(self, prefix: str) -> Any:
        for name in await _again(lambda: _all_of(ObjectStore.list_prefix(self, prefix))):
            yield name

    async def list_dir(self, prefix: str) -> Any:
        for name in await _again(lambda: _all_of(ObjectStore.list_dir(self, prefix))):
            yield name


async def _all_of(names: Any) -> list[str]:
    return [name async for name in names]


async def _again(do: Callable[[], Awaitable[Any]]) -> Any:
    for wait_s in waits():
        try:
            return await do()
        except Exception as error:
            if not worth_another(error, wait_s is None, "zarr"):
                raise
        await asyncio.sleep(wait_s)


def zarr_store(folder: Path) -> PatientStore:
    """For `zarr.open_array` and `zarr.open_group`."""
    _, bucket, *key = folder.parts
    return PatientStore(opened(bucket, "/".join(key)))
