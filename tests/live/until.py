"""Wait for a condition that depends on another process or thread."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
STEP_S = 0.02
PATIENCE_S = 120.0
"""The timeout for a loaded machine; a wait ends as soon as its condition is true."""


def until(is_so: Callable[[], T], within: float = PATIENCE_S, told: Callable[[], object] = str) -> T:
    """Wait until ``is_so`` returns a true value, and return this value.

    After ``within`` seconds fail with the text that ``told`` returns.
    """
    end = time.monotonic() + within
    while not (found := is_so()):
        if time.monotonic() > end:
            raise AssertionError(f"not so within {within} s: {told()}")
        time.sleep(STEP_S)
    return found


def takes(port: int) -> bool:
    """Return whether a TCP port of this machine accepts connections."""
    try:
        socket.create_connection(("127.0.0.1", port), 1.0).close()
    except OSError:
        return False
    return True
