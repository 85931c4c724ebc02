"""Pipes: the byte streams of many nodes in one process; the twin of ``tcp``, without a socket.

A stream delivers in order, ``delay_s`` later, at most ``rate`` bytes a second; what waits for that is its buffer, and a
producer is paused while it is full.  A cut is not noticed by either end: bytes wait, as those of TCP do; so they do on
a single stream that stands still (``Pipe.is_still``), where they are repeated in vain, too.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twisted.internet.error import ConnectionAborted, ConnectionDone
from twisted.internet.interfaces import IAddress, IDelayedCall, IProtocol, IReactorTime
from twisted.python.failure import Failure
from zope.interface import implementer

from middleware.entangled.background import cancel
from middleware.entangled.errors import PortInUse
from middleware.entangled.network.carrier import Accept, Strain
from middleware.entangled.network.network import Address

PIECE = 4096
REPEAT_S = 0.2
"""Seconds between two repetitions of what does not arrive."""


class Pipes:
    """Joins the carriers of one process."""

    def __init__(self, clock: IReactorTime, delay_s: float = 0.0, rate: float = float("inf")) -> None:
        self.delay_s = delay_s
        self.rate = rate
        self.dialled: list[tuple[str, Address]] = []
        """Who dialled whom, so far."""
        self.streams: list[Pipe] = []
        """The ends that dialled, of those that are open."""
        self.clock = clock
        self._doors: dict[Address, Accept] = {}
        self._cut: set[str] = set()

    def carrier(self, host: str, port: int = 0) -> PipeCarrier:
        """A carrier of the machine at ``host``, which listens at ``port``."""
        return PipeCarrier(self, Address(host, port))

    def cut(self, host: str) -> None:
        """Let nothing pass from or to ``host``; streams stay, and say nothing."""
        self._cut.add(host)

    def heal(self) -> None:
        """Take back every cut; what was written meanwhile arrives."""
        self._cut.clear()
        for pipe in self.streams:
            for end in (pipe, pipe.other):
                end.pump()

    def _passes(self, *hosts: str) -> bool:
        return self._cut.isdisjoint(hosts)

    def _open(self, host: str, to: Address, protocol: IProtocol, failed: Callable[[str], None]) -> None:
        accept = self._doors.get(to)
        if not self._passes(host, to.host):
            self.clock.callLater(5.0, failed, "timed out")
            return
        theirs = None if accept is None else accept(host)
        if accept is None:
            failed("refused")
            return
        near, far = Pipe(self, host), Pipe(self, to.host)
        ends: tuple[Any, Any] = near, far
        near.other, far.other = far, near
        self.streams.append(near)
        near.protocol, far.protocol = protocol, theirs
        if theirs is not None:
            theirs.makeConnection(ends[1])
        protocol.makeConnection(ends[0])
        if theirs is None:
            far.abortConnection()


class PipeCarrier:
    """One machine's carrier; a ``Carrier``."""

    def __init__(self, pipes: Pipes, address: Address) -> None:
        self._pipes = pipes
        self._address = address

    def listen(self, accept: Accept) -> None:
        """Be there for those that dial; raises ``PortInUse``."""
        if self._address in self._pipes._doors:
            raise PortInUse(f"{self._address}: another listens there; take another port")
        self._pipes._doors[self._address] = accept

    def dial(self, to: Address, protocol: IProtocol, failed: Callable[[str], None]) -> None:
        """Connect ``protocol`` with who listens at ``to``."""
        self._pipes.dialled.append((self._address.host, to))
        # The three-way handshake.
        self._pipes.clock.callLater(
            2 * self._pipes.delay_s, self._pipes._open, self._address.host, to, protocol, failed
        )

    def strain(self, transport: Any) -> Strain | None:
        """How the stream of a transport does."""
        return Strain(transport.held, transport.moved, transport.repeated) if isinstance(transport, Pipe) else None

    def close(self) -> None:
        """Be there no more."""
        self._pipes._doors.pop(self._address, None)


@implementer(IAddress)
class _Host:
    def __init__(self, host: str) -> None:
        self.host = host


class Pipe:
    """One end of a stream, as Twisted's transports are.

    ``is_read`` False lets nothing more be taken from it, ``is_still`` loses all that this end sends, and ``moved``
    counts the bytes that the other end has confirmed.
    """

    bufferSize = 65536  # noqa: N815

    def __init__(self, pipes: Pipes, host: str) -> None:
        self.other: Pipe
        self.protocol: IProtocol | None = None
        self.host = host
        self.is_read = True
        self.is_lost = False
        self.buffer = bytearray()
        self.moved = 0
        self._written = 0
        self._is_still = False
        self._still_since = 0.0
        self._pipes = pipes
        self._producer: Any = None
        self._is_paused = False
        self._is_losing = False
        self._timer: IDelayedCall | None = None

    @property
    def is_still(self) -> bool:
        """Whether all is lost that this end sends."""
        return self._is_still

    @is_still.setter
    def is_still(self, is_so: bool) -> None:
        self._is_still, self._still_since = is_so, self._pipes.clock.seconds()
        self.pump()

    @property
    def held(self) -> int:
        """Bytes that are not confirmed yet."""
        return self._written - self.moved

    @property
    def repeated(self) -> int:
        """How often something was repeated since the stream stands still."""
        is_vain = self._is_still and self.held
        return int((self._pipes.clock.seconds() - self._still_since) / REPEAT_S) if is_vain else 0

    def write(self, data: bytes) -> None:
        """Send bytes."""
        if self.is_lost or self._is_losing:
            return
        self.buffer += data
        self._written += len(data)
        if self._producer is not None and not self._is_paused and len(self.buffer) > self.bufferSize:
            self._is_paused = True
            self._producer.pauseProducing()
        self.pump()

    def registerProducer(self, producer: Any, streaming: bool) -> None:  # noqa: N802
        """Tell ``producer`` when the buffer is full."""
        self._producer = producer

    def unregisterProducer(self) -> None:  # noqa: N802
        """Tell nobody any more."""
        self._producer = None

    def loseConnection(self) -> None:  # noqa: N802
        """Close when all is sent."""
        self._is_losing = True
        self.pump()

    def abortConnection(self) -> None:  # noqa: N802
        """Close at once; the other end hears of it where anything gets through."""
        if not self.is_lost:
            if self._pipes._passes(self.host, self.other.host):
                self._pipes.clock.callLater(self._pipes.delay_s, self.other._lost, ConnectionAborted())
            self._lost(ConnectionAborted())

    def getPeer(self) -> IAddress:  # noqa: N802
        """Whoever is at the other end."""
        return _Host(self.other.host)

    def pump(self) -> None:
        """Move what can be moved."""
        if self._timer is not None or self.is_lost:
            return
        if self._is_still or not self._pipes._passes(self.host, self.other.host) or not self.other.is_read:
            return
        if self.buffer:
            piece = bytes(self.buffer[:PIECE])
            del self.buffer[:PIECE]
            self._timer = self._pipes.clock.callLater(len(piece) / self._pipes.rate, self._moved, piece)
        elif self._is_losing:
            self._pipes.clock.callLater(self._pipes.delay_s, self.other._lost, ConnectionDone())
            self._lost(ConnectionDone())

    def _moved(self, piece: bytes) -> None:
        self._timer = None
        self._pipes.clock.callLater(self._pipes.delay_s, self.other._came, piece)
        self._pipes.clock.callLater(2 * self._pipes.delay_s, self._confirmed, len(piece))
        if not self.buffer and self._is_paused and self._producer is not None:
            self._is_paused = False
            self._producer.resumeProducing()
        self.pump()

    def _confirmed(self, size: int) -> None:
        self.moved += size

    def _came(self, piece: bytes) -> None:
        if not self.is_lost and self.protocol is not None:
            self.protocol.dataReceived(piece)

    def _lost(self, error: Exception) -> None:
        if self.is_lost:
            return
        self.is_lost = True
        self.buffer.clear()
        cancel(self._timer)
        if self in self._pipes.streams:
            self._pipes.streams.remove(self)
        if self.protocol is not None:
            self.protocol.connectionLost(Failure(error))
