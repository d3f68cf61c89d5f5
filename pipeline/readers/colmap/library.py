"""pycolmap, imported here alone: its import takes the signals of its process, and answers each by a stack trace; they are
given back to whoever had them."""

from __future__ import annotations

import signal
import threading

import pycolmap  # noqa: F401 (for those who import it from here)

if threading.current_thread() is threading.main_thread():
    for number in (signal.SIGTERM, signal.SIGINT):
        if (handler := signal.getsignal(number)) is not None:
            signal.signal(number, handler)
