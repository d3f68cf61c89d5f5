"""Pages read and decoded by threads, so that a slow disk holds up no frame (2020, section 4.4.2).

Requests go through one thread-safe queue, results through another; texels lie in buffers that are made once and used
again.
"""

from __future__ import annotations

import queue
import threading
import time

import numpy as np

from pipeline.stages.pages.codecs import decoded
from storage.pages.file import PageFile

THREADS = 2
CLOSE_S = 0.5  # that closing waits for each of them


class PageLoader:
    """Reads pages of `file`; at most `n_buffers` are requested and not given back.

    Guarantees: `ready` never waits longer than it is told to; a page that cannot be read raises the error of its file
    there.
    """

    def __init__(self, file: PageFile, n_buffers: int, n_threads: int = THREADS) -> None:
        side = file.header.side_px
        self._file, self._texels = file, np.empty((n_buffers, side, side, 3), np.uint8)
        self._free = list(range(n_buffers))
        self._asked: queue.SimpleQueue = queue.SimpleQueue()
        self._done: queue.SimpleQueue = queue.SimpleQueue()
        self._closed = False
        self._held: dict[int, int] = {}  # buffer of each page that has been read
        self._threads = [threading.Thread(target=self._work, daemon=True) for _ in range(n_threads)]
        for thread in self._threads:
            thread.start()

    @property
    def n_free(self) -> int:
        return len(self._free)

    def request(self, page: int) -> None:
        self._asked.put((page, self._free.pop()))

    def ready(self, pages: list[int], wait_s: float) -> list[int]:
        """Which of `pages` have been read, waiting for them at most so long."""
        end = time.monotonic() + wait_s
        while any(page not in self._held for page in pages):
            try:
                page, buffer, error = self._done.get(timeout=max(0.0, end - time.monotonic()))
            except queue.Empty:
                break
            if error is not None:
                raise error
            self._held[page] = buffer
        return [page for page in pages if page in self._held]

    def texels(self, page: int) -> np.ndarray:
        """(side, side, 3) uint8 of a page that has been read; until it is given back."""
        return self._texels[self._held[page]]

    def give_back(self, page: int) -> None:
        self._free.append(self._held.pop(page))

    def close(self) -> None:
        """Read no more. A thread that the disk holds up ends when the disk lets it."""
        self._closed = True
        for _ in self._threads:
            self._asked.put(None)
        for thread in self._threads:
            thread.join(CLOSE_S)

    def _work(self) -> None:
        while (asked := self._asked.get()) is not None and not self._closed:
            page, buffer = asked
            try:
                header = self._file.header
                self._texels[buffer] = decoded(
                    header.codec, self._file.read(page), header.side_px, f"{self._file.path}, page {page}"
                )
                self._done.put((page, buffer, None))
            except Exception as error:
                if self._closed:  # and the file with it
                    return
                self._done.put((page, buffer, error))
