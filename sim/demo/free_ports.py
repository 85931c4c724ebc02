"""Find free ports of this machine."""

from __future__ import annotations

import errno
import random
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Literal

Transport = Literal["tcp", "udp"]
TCP_AND_UDP: tuple[Transport, ...] = ("tcp", "udp")

PORT_RANGE = range(20_000, 32_000)
"""Systems assign none of these automatically (Linux starts at 32,768, others at 49,152): a port that is free now is
still free when its process starts, however many connections are opened in between."""


class PortBusy(Exception):
    """A requested port is used by another program; the message names the port and the remedy."""


def require_port(kind: Transport, host: str, wanted: int, what: str) -> int:
    """Return ``wanted`` if it is free; raises ``PortBusy`` otherwise."""
    if not _is_free(kind, host, wanted):
        raise PortBusy(f"port {wanted} ({what}) is busy; end the program that uses it, or choose another port")
    return wanted


def choose_port(kind: Transport, host: str, wanted: int, spare: Iterator[int]) -> int:
    """Return ``wanted`` if it is free, else the next of ``spare``; 0 always takes the next of ``spare``."""
    return wanted if wanted and _is_free(kind, host, wanted) else next(spare)


def find_free_ports(kind: Transport | tuple[Transport, ...], host: str, count: int) -> list[int]:
    """Return ``count`` different ``PORT_RANGE`` ports that are free now for every ``kind``.

    All are bound at the same time, so none is returned twice, and drawn at random, so that concurrent callers get
    different ones.  Raises ``OSError`` if ``host`` is not an address of this machine, or too few ports are free.
    """
    kinds = (kind,) if isinstance(kind, str) else kind
    check_host(kinds[0], host)
    draw = random.SystemRandom()
    found: list[int] = []
    with ExitStack() as stack:
        for port in draw.sample(PORT_RANGE, len(PORT_RANGE)):
            if len(found) == count:
                break
            try:
                for each in kinds:
                    stack.enter_context(_bind(each, host, port))
            except OSError:
                continue
            found.append(port)
    if len(found) < count:
        raise OSError(errno.EADDRINUSE, f"fewer than {count} ports are free")
    return found


def check_host(kind: Transport, host: str) -> None:
    """Raise ``OSError`` if ``host`` is not an address of this machine."""
    _bind(kind, host, 0).close()


def _is_free(kind: Transport, host: str, port: int) -> bool:
    try:
        _bind(kind, host, port).close()
    except OSError:
        return False
    return True


def _bind(kind: Transport, host: str, port: int) -> socket.socket:
    opened = socket.socket(socket.AF_INET, socket.SOCK_STREAM if kind == "tcp" else socket.SOCK_DGRAM)
    try:
        if kind == "tcp":
            # As on the listening ports of Twisted, a port in TIME_WAIT counts as free.
            opened.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        opened.bind((host, port))
        if kind == "tcp":
            opened.listen(1)
    except OSError:
        opened.close()
        raise
    return opened
