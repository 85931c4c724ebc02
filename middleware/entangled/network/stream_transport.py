"""Define the interface that opens the byte streams of tunnels.

``tcp`` implements it with TCP, ``pipes`` in memory.
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

    ``unacked`` are the bytes that the other end has not acknowledged (each segment may count as a full one), ``acked``
    the bytes that it has acknowledged; ``retransmissions`` counts the retransmissions.
    """

    unacked: int
    acked: int
    retransmissions: int


class StreamTransport(Protocol):
    """Opens byte streams, each handled by a Twisted protocol."""

    def listen(self, accept: Accept) -> None:
        """Accept connections; raises ``PortInUse``."""

    def dial(self, to: Address, protocol: IProtocol, failed: Callable[[str], None]) -> None:
        """Connect ``protocol`` to the listener at ``to``; ``failed`` is called with the reason if that fails."""

    def read_state(self, transport: Any) -> StreamState | None:
        """Return the state of the stream of a transport; None if it is unknown."""

    def close(self) -> None:
        """Stop listening and dialling; open streams continue.  May be called twice."""
