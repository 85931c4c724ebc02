"""Carrier: where the byte streams of tunnels come from.

``tcp`` has the real one, ``pipes`` the one in memory.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from twisted.internet.interfaces import IProtocol

from middleware.entangled.network.network import Address

Accept = Callable[[str], IProtocol | None]
"""Called with the numeric address of whoever has dialled; None hangs up."""


@dataclass(frozen=True, slots=True)
class Strain:
    """How the stream of one end does.

    ``held`` are bytes that the other end has not confirmed yet (each piece may count as a full one), ``acked`` those
    that it has so far; ``repeated`` says how often something was sent again.
    """

    held: int
    acked: int
    repeated: int


class Carrier(Protocol):
    """Opens byte streams; each is spoken on by a protocol of Twisted."""

    def listen(self, accept: Accept) -> None:
        """Be there for those that dial; raises ``PortInUse``."""

    def dial(self, to: Address, protocol: IProtocol, failed: Callable[[str], None]) -> None:
        """Connect ``protocol`` with who listens at ``to``; ``failed`` is called with the reason where nobody does."""

    def strain(self, transport: Any) -> Strain | None:
        """How the stream of a transport does; None where nobody can tell."""

    def close(self) -> None:
        """Be there no more, and dial no more; streams that are open stay so.  May be called twice."""
