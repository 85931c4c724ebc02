"""Warmth: a process that has started keeps what it will always need, and gives back what only starting needed."""

from __future__ import annotations

import ctypes
import gc
from contextlib import suppress

STARTED_S = 3.0
"""Seconds after which a node has loaded what it needs."""


def warmed_up() -> None:
    """Give memory back, and look for garbage no more among what is there for good.

    glibc keeps freed memory for later, and a small device has other uses for it.  A full collection goes through every
    module of the process: in a web node that holds up its timers for 50 ms, again and again.
    """
    gc.collect()
    gc.freeze()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
