"""Memory savings: keep an unused TLS library unloaded, and release memory after startup."""

from __future__ import annotations

import gc
import sys
from contextlib import suppress

STARTUP_S = 3.0
"""Seconds after which a node has imported everything that it needs."""


def block_tls_import() -> None:
    """Hide pyOpenSSL from Twisted, which would load 13 MiB into every process with a reactor.

    Call this before the reactor is imported; if pyOpenSSL is loaded already, nothing changes.
    """
    sys.modules.setdefault("OpenSSL", None)  # type: ignore[arg-type]


def release_memory() -> None:
    """Return freed memory to the system, and exclude all current objects from garbage collection.

    glibc otherwise keeps freed memory.  A full collection visits every module of the process; in a web node it delays
    timers by 50 ms each time.
    """
    import ctypes  # imported here, because short commands also import this module

    gc.collect()
    gc.freeze()
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
