"""Files take turns; what is no file waits for none of them."""

from __future__ import annotations

import asyncio

import pytest

from services.api.door.turns import AT_ONCE, FilesInTurn

FILE, JOB = "/v1/jobs/1/artifacts/a.splatpress", "/v1/jobs/1"


def scope(path: str) -> dict:
    return {"type": "http", "method": "GET", "path": path}


async def _nothing(*_) -> None:
    pass


def test_turns__files_wait_for_each_other_until_their_answers_begin_and_jobs_for_nothing():
    found, begin, end = [], asyncio.Event(), asyncio.Event()

    async def app(scope, receive, send) -> None:
        found.append(scope["path"])
        if scope["path"] == JOB:
            return
        await begin.wait()
        await send({"type": "http.response.start"})
        await end.wait()  # a client as slow as can be
        await send({"type": "http.response.body"})

    async def scene() -> None:
        asked = FilesInTurn(app)
        files = [asyncio.create_task(asked(scope(FILE), _nothing, _nothing)) for _ in range(AT_ONCE + 3)]
        await asyncio.sleep(0.01)
        assert found == [FILE] * AT_ONCE
        await asked(scope(JOB), _nothing, _nothing)
        assert found[-1] == JOB
        begin.set()
        await asyncio.sleep(0.01)
        assert found.count(FILE) == AT_ONCE + 3  # none has ended
        end.set()
        await asyncio.gather(*files)

    asyncio.run(scene())


def test_turns__are_left_by_what_fails():
    async def app(scope, receive, send) -> None:
        raise ValueError

    async def scene() -> None:
        asked = FilesInTurn(app)
        for _ in range(3 * AT_ONCE):
            with pytest.raises(ValueError):
                await asyncio.wait_for(asked(scope("/view"), _nothing, _nothing), 1)

    asyncio.run(scene())
