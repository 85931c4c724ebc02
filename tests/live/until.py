"""Until: wait for what another process or thread does."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
STEP_S = 0.02
PATIENCE_S = 120.0
"""Upper limit on a machine that has more to do; where it is in time nothing waits for that."""


def until(is_so: Callable[[], T], within: float = PATIENCE_S, told: Callable[[], object] = str) -> T:
    """Return what ``is_so`` gives as soon as it is true; after so many seconds fail with what is ``told``."""
    end = time.monotonic() + within
    while not (found := is_so()):
        if time.monotonic() > end:
            raise AssertionError(f"not so within {within} s: {told()}")
        time.sleep(STEP_S)
    return found


def takes(port: int) -> bool:
    """Whether something listens at that TCP port of this machine."""
    try:
        socket.create_connection(("127.0.0.1", port), 1.0).close()
    except OSError:
        return False
    return True
