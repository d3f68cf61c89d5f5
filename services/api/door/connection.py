"""The server's connections: one that says nothing, or only half of a request's headers, is closed after a while, so
that thousands of them do not stand open for ever (uvicorn itself waits without end for the rest of a header)."""

from __future__ import annotations

import asyncio

from uvicorn.protocols.http.h11_impl import H11Protocol


def protocol(headers_s: float) -> type[H11Protocol]:
    """uvicorn's protocol, with `headers_s` for a request's line and headers, from the connection's first moment or
    from the first byte that follows the request before."""

    class Protocol(H11Protocol):
        _deadline: asyncio.TimerHandle | None = None

        def connection_made(self, transport) -> None:
            super().connection_made(transport)
            self._begin()

        def data_received(self, data: bytes) -> None:
            if self._is_idle() and self._deadline is None:
                self._begin()
            super().data_received(data)
            if not self._is_idle():
                self._end()

        def connection_lost(self, exc: Exception | None) -> None:
            self._end()
            super().connection_lost(exc)

        def _is_idle(self) -> bool:
            return self.cycle is None or self.cycle.response_complete

        def _begin(self) -> None:
            self._deadline = self.loop.call_later(headers_s, self._close)

        def _end(self) -> None:
            if self._deadline is not None:
                self._deadline.cancel()
                self._deadline = None

        def _close(self) -> None:
            self._deadline = None
            if self._is_idle():
                self.transport.close()

    return Protocol
