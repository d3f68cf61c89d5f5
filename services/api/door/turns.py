"""Files take turns, so that answers about jobs do not wait behind those of a hundred viewers: finding a file costs as
much as any other answer, and that many at once would all stand in one line with it."""

from __future__ import annotations

import asyncio

AT_ONCE = 2  # files that are being looked for; sending them costs little, takes as long as clients do, and is no turn


class FilesInTurn:
    """ASGI middleware. Guarantees: at most AT_ONCE requests for files of artifacts or pages are between their beginning
    and the beginning of their answer; what is no file never waits."""

    def __init__(self, app) -> None:
        self.app, self._turns = app, asyncio.Semaphore(AT_ONCE)

    async def __call__(self, scope, receive, send) -> None:
        if scope["type"] != "http" or not is_file(scope["path"]):
            return await self.app(scope, receive, send)
        await self._turns.acquire()
        has_turn = True

        def leave() -> None:
            nonlocal has_turn
            if has_turn:
                self._turns.release()
            has_turn = False

        async def answered(message) -> None:
            leave()
            await send(message)

        try:
            await self.app(scope, receive, answered)
        finally:
            leave()


def is_file(path: str) -> bool:
    """Whether a request for it is answered with a file."""
    return path.startswith("/web/") or path == "/view" or "/artifacts/" in path
