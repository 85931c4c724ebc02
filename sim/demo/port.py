"""Port: finds out which ports of this machine are free."""

from __future__ import annotations

import socket
from contextlib import ExitStack
from typing import Literal

Kind = Literal["tcp", "udp"]


class PortBusy(Exception):
    """A port that was asked for is held by another program; the message names it and says what to do."""


def chosen(kind: Kind, host: str, wanted: int, what: str) -> int:
    """``wanted`` where it is free, else ``PortBusy``."""
    if not _is_free(kind, host, wanted):
        raise PortBusy(f"port {wanted} ({what}) is busy; end the program that holds it, or choose another one")
    return wanted


def preferred(kind: Kind, host: str, wanted: int) -> int:
    """``wanted`` where it is free, else any free port; 0 wants any."""
    return wanted if wanted and _is_free(kind, host, wanted) else free(kind, host, 1)[0]


def free(kind: Kind, host: str, count: int) -> list[int]:
    """``count`` different free ports, free at this moment; held all at once, so none is given twice."""
    with ExitStack() as stack:
        held = [stack.enter_context(_bound(kind, host, 0)) for _ in range(count)]
        return [int(one.getsockname()[1]) for one in held]


def _is_free(kind: Kind, host: str, port: int) -> bool:
    try:
        _bound(kind, host, port).close()
    except OSError:
        return False
    return True


def _bound(kind: Kind, host: str, port: int) -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_STREAM if kind == "tcp" else socket.SOCK_DGRAM)
    try:
        if kind == "tcp":
            # As Twisted's own listening ports do: a port in TIME_WAIT is free.
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.bind((host, port))
        if kind == "tcp":
            opened.listen(1)
    except OSError:
        opened.close()
        raise
    return opened
