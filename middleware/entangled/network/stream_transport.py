"""Define the interface that opens the byte streams of tunnels.

``tcp`` implements the interface with TCP, ``memory_streams`` in memory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from twisted.internet.interfaces import IProtocol

from middleware.entangled.network.network import Address

Accept = Callable[[str], IProtocol | None]
"""Called with the numeric address of a dialling host; returns None to close the connection."""


@dataclass(frozen=True, slots=True)
class StreamState:
    """The state of the stream at one end.

    ``unacked`` is the number of bytes that the other end has not acknowledged; each segment may be counted as a full
    segment.  ``acked`` is the number of acknowledged bytes, and ``retransmissions`` the number of retransmissions.
    """

    unacked: int
    acked: int
    retransmissions: int


class StreamTransport(Protocol):
    """Opens byte streams, each handled by a Twisted protocol."""

    def listen(self, accept: Accept) -> None:
        """Accept connections; raises ``PortInUse``."""

    def dial(self, to: Address, protocol: IProtocol, failed: Callable[[str], None]) -> None:
        """Connect ``protocol`` to the listener at ``to``; on failure call ``failed`` with the reason."""

    def read_state(self, transport: Any) -> StreamState | None:
        """Return the state of the stream of a transport; None if it is unknown."""

    def close(self) -> None:
        """Stop listening and dialling; open streams continue.  May be called twice."""
