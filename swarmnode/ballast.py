"""Ballast: memory that a process does not need: TLS where it speaks none, and what only its start needed."""

from __future__ import annotations

import gc
import sys
from contextlib import suppress

STARTED_S = 3.0
"""Seconds after which a node has loaded what it needs."""


def drop_tls() -> None:
    """Have Twisted find no pyOpenSSL: it would load that into every process with a reactor, and it weighs 13 MiB.

    Call this before the reactor is imported; where pyOpenSSL is loaded already, nothing is changed.
    """
    sys.modules.setdefault("OpenSSL", None)  # type: ignore[arg-type]


def warmed_up() -> None:
    """Give memory back, and look for garbage no more among what is there for good.

    glibc keeps freed memory for later, and a small device has other uses for it.  A full collection goes through every
    module of the process: in a web node that holds up its timers for 50 ms, again and again.
    """
    import ctypes  # not before: commands that end at once load this module, too

    gc.collect()
    gc.freeze()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
