"""Link: the way between a client and the yard, over TCP or through memory; it carries bytes and knows no message.

``TcpConnector`` is the edge to the world; ``MemoryConnector`` its twin for whole teams in one process on one turned
clock.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

from twisted.internet import error, protocol
from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IAddress, IPushProducer, IReactorTime
from twisted.logger import Logger
from twisted.python.failure import Failure
from zope.interface import implementer

from drivers.timer import Timer

FIRST_RETRY_S = 0.1
LAST_RETRY_S = 2
RETRY_FACTOR = 1.6
CALL_S = 2.0
NEWS = 5
"""So many calls have to fail, one after another, before the log tells of it."""
HUNG_UP = "it hangs up as soon as it is called; does it serve another client already, and is the port right?"
PROBLEMS: Sequence[tuple[type[Exception], str]] = (
    (error.ConnectionRefusedError, "it is there, but nothing listens at this port; is the port right, and free?"),
    (error.TCPTimedOutError, "it does not answer; is it switched on, and in this network?"),
    (error.TimeoutError, "it does not answer; is it switched on, and in this network?"),
    (error.NoRouteError, "there is no way to it; is this machine in its network?"),
    (error.DNSLookupError, "no address is known for this name; mend it, or write the address in figures"),
)
"""Why a call fails, and the remedy."""


class Link(Protocol):
    """One open connection, as its user sees it."""

    @property
    def is_busy(self) -> bool:
        """Whether what was sent before has not left yet; what can be dropped, should be."""

    def send(self, data: bytes) -> None:
        """Send bytes; does nothing on a closed link."""

    def close(self) -> None:
        """Close now, and throw away what has not left yet."""


class Receiver(Protocol):
    """Who is told what happens on a link."""

    def received(self, data: bytes) -> None:
        """Take bytes as they come, cut anyhow."""

    def link_down(self) -> None:
        """Learn that the link is gone, whoever closed it."""


class Caller(Receiver, Protocol):
    """A receiver that calls: it is given a new link each time that one opens."""

    def link_up(self, link: Link) -> None:
        """Take the link that has just opened."""


class Line(Protocol):
    """A standing wish to be connected."""

    def hang_up(self) -> Deferred[None]:
        """Close the link and stop trying; fires when it is closed."""


class Connector(Protocol):
    """What opens links."""

    def call(self, host: str, port: int, caller: Caller) -> Line:
        """Keep ``caller`` connected to the yard at this address, with back-off, until the line hangs up."""


Accept = Callable[[Link], Receiver]
"""What the yard does with a new link: it returns who shall hear what arrives."""


class StreamLink(protocol.Protocol):
    """A link over one open transport of Twisted."""

    def fileno(self) -> int:
        """The open descriptor, for another process to share; -1 on a closed link."""
        transport: Any = self.transport
        return int(transport.fileno()) if self.connected and transport is not None else -1

    def send(self, data: bytes) -> None:
        """Send bytes; does nothing on a closed link."""
        if self.connected and self.transport is not None:
            self.transport.write(data)


@implementer(IPushProducer)
class TcpLink(StreamLink):
    """A link over one TCP connection; both sides use it."""

    def __init__(self, accept: Accept) -> None:
        self._accept = accept
        self.has_heard = False
        self._receiver: Receiver | None = None
        self._is_busy = False

    @property
    def is_busy(self) -> bool:
        """Whether the transport asked to wait."""
        return self._is_busy

    @property
    def peer(self) -> tuple[str, int] | None:
        """The numeric address of the other end; None on a closed link."""
        transport: Any = self.transport
        if not self.connected or transport is None:
            return None
        there = transport.getPeer()
        return there.host, there.port

    def close(self) -> None:
        """Close now, and throw away what has not left yet."""
        transport: Any = self.transport
        if self.connected and transport is not None:
            transport.abortConnection()

    def connectionMade(self) -> None:  # noqa: D102 (Twisted's)
        transport: Any = self.transport
        transport.setTcpNoDelay(True)
        transport.setTcpKeepAlive(True)
        transport.registerProducer(self, True)
        self._receiver = self._accept(self)

    def dataReceived(self, data: bytes) -> None:  # noqa: D102 (Twisted's)
        self.has_heard = True
        if self._receiver is not None:
            self._receiver.received(data)

    def connectionLost(self, reason: Failure = protocol.connectionDone) -> None:  # noqa: D102 (Twisted's)
        self.connected = 0
        receiver, self._receiver = self._receiver, None
        if receiver is not None:
            receiver.link_down()

    def pauseProducing(self) -> None:
        """Learn from the transport that its buffer is full."""
        self._is_busy = True

    def resumeProducing(self) -> None:
        """Learn from the transport that its buffer has emptied."""
        self._is_busy = False

    def stopProducing(self) -> None:
        """Learn from the transport that it will never send again."""
        self._is_busy = True


def reactor_or_running(reactor: Any) -> Any:
    """``reactor``, or the running one where it is None."""
    if reactor is None:
        # Importing it installs it: that is the business of whoever runs a process, not of this module.
        from twisted.internet import reactor as running

        return running
    return reactor


class TcpLinkFactory(protocol.Factory):
    """Makes a ``TcpLink`` for each connection."""

    noisy = False

    def __init__(self, accept: Accept) -> None:
        self._accept = accept

    def buildProtocol(self, addr: IAddress | None) -> TcpLink:  # noqa: D102 (Twisted's)
        return TcpLink(self._accept)


class TcpConnector:
    """Opens links over TCP on ``reactor`` (the running one where none is given).

    ``waits`` are the seconds before each new try, the last of them for all that follow; growing ones where not given.
    With ``says``, what keeps a link from being opened is said in the log, once until there is one.
    """

    def __init__(self, reactor: Any = None, waits: Sequence[float] = (), says: bool = False) -> None:
        self._reactor = reactor
        self._waits = waits
        self._says = says

    def call(self, host: str, port: int, caller: Caller) -> Line:
        """Keep ``caller`` connected to the yard at this address, with back-off, until the line hangs up."""
        reactor = reactor_or_running(self._reactor)

        def accept(link: Link) -> Receiver:
            caller.link_up(link)
            return caller

        line = _TcpLine(accept, reactor, self._waits, f"{host}:{port}" if self._says else "")
        line.connector = reactor.connectTCP(host, port, line, timeout=CALL_S)
        return line


class _TcpLine(protocol.ReconnectingClientFactory):
    """Twisted's older way to stay connected: ``ClientService`` would cost a node 0.6 MiB, and does no more here.

    ``problem`` says in one line why there is no link; it is empty while there is one, and before the first try ends.
    Only a link that has brought something, or lasted, ends the growth of the waits: whoever takes each call and hangs
    up at once is not called more often than one who takes none.
    """

    noisy = False
    initialDelay = FIRST_RETRY_S  # noqa: N815 (Twisted's)
    maxDelay = LAST_RETRY_S  # noqa: N815 (Twisted's)
    factor = RETRY_FACTOR
    jitter = 0.0

    log = Logger()

    def __init__(self, accept: Accept, clock: Any, waits: Sequence[float] = (), where: str = "") -> None:
        self.clock: Any = clock
        self.problem = ""
        self._where = where
        self._failures = 0
        self._said = ""
        self.delay = self.initialDelay
        self._waits = waits
        self._tries = 0
        self.connector: Any = None
        self._accept = accept
        self._gone: Deferred[None] | None = None
        self._link: TcpLink | None = None
        self._taken_at = 0.0

    def buildProtocol(self, addr: IAddress | None) -> TcpLink:
        self._taken_at = self.clock.seconds()
        self.problem = ""
        self._link = TcpLink(self._accept)
        return self._link

    def retry(self, connector: Any = None) -> None:
        if self._waits:
            self.delay = self._waits[min(self._tries, len(self._waits) - 1)]
            self._tries += 1
        super().retry(connector)

    def clientConnectionFailed(self, connector: Any, reason: Failure) -> None:  # noqa: N802 (Twisted's)
        known = (remedy for kind, remedy in PROBLEMS if reason.check(kind))
        self._on_problem(next(known, " ".join(reason.getErrorMessage().split())))
        super().clientConnectionFailed(connector, reason)

    def clientConnectionLost(self, connector: Any, unused_reason: Failure) -> None:  # noqa: N802 (Twisted's)
        link, self._link = self._link, None
        if (link is not None and link.has_heard) or self.clock.seconds() - self._taken_at >= LAST_RETRY_S:
            self.delay, self._tries = self.initialDelay, 0
            self._failures, self._said = 0, ""
        elif self._gone is None:
            self._on_problem(HUNG_UP)
        super().clientConnectionLost(connector, unused_reason)
        gone, self._gone = self._gone, None
        if gone is not None:
            gone.callback(None)

    def _on_problem(self, problem: str) -> None:
        self.problem = problem
        self._failures += 1
        # Who is just being started, or started again, is no news.
        if self._where and self._failures >= NEWS and problem != self._said:
            self._said = problem
            self.log.warn("{where}: {problem}", where=self._where, problem=problem)

    def hang_up(self) -> Deferred[None]:
        self.stopTrying()
        if self.connector.state == "disconnected":
            return succeed(None)
        is_open = self.connector.state == "connected"
        self._gone = Deferred() if is_open else None
        self.connector.disconnect()
        return self._gone or succeed(None)


class MemoryLink:
    """One end of a pair in memory: what one end sends, the other receives ``delay`` seconds later, in order."""

    def __init__(self, clock: IReactorTime, delay: float) -> None:
        self.is_busy = self.is_silent = False
        self.other: MemoryLink | None = None
        self.receiver: Receiver | None = None
        self._clock = clock
        self._delay = delay

    def send(self, data: bytes) -> None:
        """Send bytes; does nothing on a closed link."""
        if self.other is not None and not self.is_silent:
            self._clock.callLater(self._delay, self.other._deliver, data)

    def close(self) -> None:
        """Close both ends; the other learns it after the delay; what is on its way there still arrives."""
        other, self.other = self.other, None
        if other is not None:
            self._clock.callLater(self._delay, other._drop)
            self._drop()

    def _deliver(self, data: bytes) -> None:
        if self.receiver is not None:
            self.receiver.received(data)

    def _drop(self) -> None:
        self.other = None
        receiver, self.receiver = self.receiver, None
        if receiver is not None:
            receiver.link_down()


class MemoryConnector:
    """Opens links to ``accept`` through ``clock``; host and port mean nothing.

    ``is_open`` False turns new calls away, as a dead yard would, ``cut`` breaks what is open, and ``silence`` leaves it
    open for nothing.
    """

    def __init__(self, clock: IReactorTime, accept: Accept, delay: float = 0.0005) -> None:
        self.is_open = True
        self.links: list[MemoryLink] = []
        self._clock = clock
        self._accept = accept
        self._delay = delay

    def call(self, host: str, port: int, caller: Caller) -> Line:
        """Keep ``caller`` connected, with back-off, until the line hangs up."""
        return _MemoryLine(self, self._clock, caller)

    def cut(self) -> None:
        """Break every open link, as a lost network does."""
        links, self.links = self.links, []
        for link in links:
            link.close()

    def silence(self) -> None:
        """Let nothing pass any more over the links that are open now, and open no other, as a lost radio does."""
        self.is_open = False
        for link in self.links:
            for end in (link, link.other):
                if end is not None:
                    end.is_silent = True

    def opened(self, caller: Receiver) -> MemoryLink | None:
        """The caller's end of a new pair, or None while turned away."""
        if not self.is_open:
            return None
        near, far = MemoryLink(self._clock, self._delay), MemoryLink(self._clock, self._delay)
        near.other, far.other = far, near
        near.receiver = caller
        far.receiver = self._accept(far)
        self.links = [link for link in self.links if link.other is not None] + [near]
        return near


class _MemoryLine:
    """The memory twin of ``_TcpLine``; it stands between link and caller to see the link go down."""

    def __init__(self, connector: MemoryConnector, clock: IReactorTime, caller: Caller) -> None:
        self._connector = connector
        self._caller = caller
        self._retry_s = FIRST_RETRY_S
        self._link: MemoryLink | None = None
        self._is_wanted = True
        self._pending = Timer(clock)
        self._pending.set(0.0, self._try)

    def hang_up(self) -> Deferred[None]:
        self._is_wanted = False
        self._pending.cancel()
        if self._link is not None:
            self._link.close()
        return succeed(None)

    def received(self, data: bytes) -> None:
        self._caller.received(data)

    def link_down(self) -> None:
        self._link = None
        if self._is_wanted:
            self._pending.set(FIRST_RETRY_S, self._try)
        self._caller.link_down()

    def _try(self) -> None:
        self._link = self._connector.opened(self)
        if self._link is None:
            self._pending.set(self._retry_s, self._try)
            self._retry_s = min(self._retry_s * RETRY_FACTOR, LAST_RETRY_S)
            return
        self._retry_s = FIRST_RETRY_S
        self._caller.link_up(self._link)
