"""Byte streams between a driver and its robot or simulator, over TCP or in memory.

``TcpConnector`` opens TCP connections; ``MemoryConnector`` has the same interface, for whole teams in one process in
virtual time.
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
MAX_RETRY_S = 2
RETRY_FACTOR = 1.6
CONNECT_TIMEOUT_S = 2.0
MIN_LOGGED_FAILURES = 5
"""Number of consecutive failed attempts to connect after which the failure is logged."""
CLOSED_AT_ONCE = "the server closes each new connection; does it already serve another client, and is the port correct?"
PROBLEMS: Sequence[tuple[type[Exception], str]] = (
    (error.ConnectionRefusedError, "nothing listens at this port; is the port correct, and is its server running?"),
    (error.TCPTimedOutError, "the device does not answer; is it switched on, and in this network?"),
    (error.TimeoutError, "the device does not answer; is it switched on, and in this network?"),
    (error.NoRouteError, "no route leads to the device; is this machine in its network?"),
    (error.DNSLookupError, "this host name has no address; correct the name, or write a numeric address"),
)
"""The message for each error of a connection: the reason and the remedy."""


class Link(Protocol):
    """One open connection."""

    @property
    def is_busy(self) -> bool:
        """Whether earlier data is still unsent; the sender should then drop data that it can omit."""

    def send(self, data: bytes) -> None:
        """Send bytes; does nothing on a closed link."""

    def close(self) -> None:
        """Close now and discard unsent data."""


class Receiver(Protocol):
    """Receives the data and the close of a link."""

    def data_received(self, data: bytes) -> None:
        """Process bytes of the stream, in chunks of any size."""

    def link_down(self) -> None:
        """Handle the close of the link, by either side."""


class LinkClient(Receiver, Protocol):
    """A receiver on the connecting side, which gets each new link."""

    def link_up(self, link: Link) -> None:
        """Use the link that has just opened."""


class Reconnector(Protocol):
    """A connection that is reopened whenever it is lost."""

    def disconnect(self) -> Deferred[None]:
        """Close the link and stop reconnecting; fires when it is closed."""


class Connector(Protocol):
    """Opens links."""

    def connect(self, host: str, port: int, client: LinkClient) -> Reconnector:
        """Keep ``client`` connected to this address, with back-off, until ``disconnect`` is called."""


Accept = Callable[[Link], Receiver]
"""Handles a new link on the serving side; returns the receiver of its data."""


class StreamLink(protocol.Protocol):
    """A link over one open Twisted transport."""

    def fileno(self) -> int:
        """Return the open descriptor, to share it with another process; -1 on a closed link."""
        transport: Any = self.transport
        return int(transport.fileno()) if self.connected and transport is not None else -1

    def send(self, data: bytes) -> None:
        """Send bytes; does nothing on a closed link."""
        if self.connected and self.transport is not None:
            self.transport.write(data)


@implementer(IPushProducer)
class TcpLink(StreamLink):
    """A link over one TCP connection, for both sides."""

    def __init__(self, accept: Accept) -> None:
        self._accept = accept
        self.has_received = False
        self._receiver: Receiver | None = None
        self._is_busy = False

    @property
    def is_busy(self) -> bool:
        """Whether the transport asked to pause."""
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
        """Close now and discard unsent data."""
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
        self.has_received = True
        if self._receiver is not None:
            self._receiver.data_received(data)

    def connectionLost(self, reason: Failure = protocol.connectionDone) -> None:  # noqa: D102 (Twisted's)
        self.connected = 0
        receiver, self._receiver = self._receiver, None
        if receiver is not None:
            receiver.link_down()

    def pauseProducing(self) -> None:
        """Mark the link busy: the transport's buffer is full."""
        self._is_busy = True

    def resumeProducing(self) -> None:
        """Mark the link free: the transport's buffer is empty again."""
        self._is_busy = False

    def stopProducing(self) -> None:
        """Mark the link busy: the transport stops sending."""
        self._is_busy = True


def reactor_or_running(reactor: Any) -> Any:
    """Return ``reactor``, or the running one if it is None."""
    if reactor is None:
        # Importing ``reactor`` installs it, so this must not happen when this module is imported.
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
    """Opens links over TCP on ``reactor`` (None: the running one).

    ``waits`` are the delays in seconds before each retry, of which the last one is repeated; without ``waits`` the
    delays grow exponentially. With ``says`` the reason why a link cannot be opened is logged, and not repeated until a
    link has opened.
    """

    def __init__(self, reactor: Any = None, waits: Sequence[float] = (), says: bool = False) -> None:
        self._reactor = reactor
        self._retry_delays_s = waits
        self._logs_problems = says

    def connect(self, host: str, port: int, client: LinkClient) -> Reconnector:
        """Keep ``client`` connected to this address, with back-off, until ``disconnect`` is called."""
        reactor = reactor_or_running(self._reactor)

        def accept(link: Link) -> Receiver:
            client.link_up(link)
            return client

        reconnector = _TcpReconnector(
            accept, reactor, self._retry_delays_s, f"{host}:{port}" if self._logs_problems else ""
        )
        reconnector.connector = reactor.connectTCP(host, port, reconnector, timeout=CONNECT_TIMEOUT_S)
        return reconnector


class _TcpReconnector(protocol.ReconnectingClientFactory):
    """Reconnect with Twisted's older factory; ``ClientService`` has no advantage here and takes 0.6 MiB more per node.

    ``problem`` is the reason in one line why no link is open; it is empty while a link is open and before the first
    attempt ends. Only a link that received data or lasted ``MAX_RETRY_S`` resets the delay. So a server that accepts
    and immediately closes connections is not retried more often than a server that refuses connections.
    """

    noisy = False
    initialDelay = FIRST_RETRY_S  # noqa: N815 (Twisted's)
    maxDelay = MAX_RETRY_S  # noqa: N815 (Twisted's)
    factor = RETRY_FACTOR
    jitter = 0.0

    log = Logger()

    def __init__(self, accept: Accept, clock: Any, waits: Sequence[float] = (), address: str = "") -> None:
        self.clock: Any = clock
        self.problem = ""
        self._address = address
        self._failures = 0
        self._logged_problem = ""
        self.delay = self.initialDelay
        self._retry_delays_s = waits
        self._tries = 0
        self.connector: Any = None
        self._accept = accept
        self._closed: Deferred[None] | None = None
        self._link: TcpLink | None = None
        self._opened_at = 0.0

    def buildProtocol(self, addr: IAddress | None) -> TcpLink:
        self._opened_at = self.clock.seconds()
        self.problem = ""
        self._link = TcpLink(self._accept)
        return self._link

    def retry(self, connector: Any = None) -> None:
        if self._retry_delays_s:
            self.delay = self._retry_delays_s[min(self._tries, len(self._retry_delays_s) - 1)]
            self._tries += 1
        super().retry(connector)

    def clientConnectionFailed(self, connector: Any, reason: Failure) -> None:  # noqa: N802 (Twisted's)
        known = (remedy for kind, remedy in PROBLEMS if reason.check(kind))
        self._on_problem(next(known, " ".join(reason.getErrorMessage().split())))
        super().clientConnectionFailed(connector, reason)

    def clientConnectionLost(self, connector: Any, unused_reason: Failure) -> None:  # noqa: N802 (Twisted's)
        link, self._link = self._link, None
        if (link is not None and link.has_received) or self.clock.seconds() - self._opened_at >= MAX_RETRY_S:
            self.delay, self._tries = self.initialDelay, 0
            self._failures, self._logged_problem = 0, ""
        elif self._closed is None:
            self._on_problem(CLOSED_AT_ONCE)
        super().clientConnectionLost(connector, unused_reason)
        closed, self._closed = self._closed, None
        if closed is not None:
            closed.callback(None)

    def _on_problem(self, problem: str) -> None:
        self.problem = problem
        self._failures += 1
        # A few failures are normal while the robot starts or restarts.
        if self._address and self._failures >= MIN_LOGGED_FAILURES and problem != self._logged_problem:
            self._logged_problem = problem
            self.log.warn("{address}: {problem}", address=self._address, problem=problem)

    def disconnect(self) -> Deferred[None]:
        self.stopTrying()
        if self.connector.state == "disconnected":
            return succeed(None)
        is_open = self.connector.state == "connected"
        self._closed = Deferred() if is_open else None
        self.connector.disconnect()
        return self._closed or succeed(None)


class MemoryLink:
    """One end of a pair in memory: data sent at one end arrives at the other ``delay`` seconds later, in order."""

    def __init__(self, clock: IReactorTime, delay: float) -> None:
        self.is_busy = self.is_blocked = False
        self.other: MemoryLink | None = None
        self.receiver: Receiver | None = None
        self._clock = clock
        self._delay = delay

    def send(self, data: bytes) -> None:
        """Send bytes; does nothing on a closed link."""
        if self.other is not None and not self.is_blocked:
            self._clock.callLater(self._delay, self.other._deliver, data)

    def close(self) -> None:
        """Close both ends; the other end is notified after the delay, and still receives data that was sent earlier."""
        other, self.other = self.other, None
        if other is not None:
            self._clock.callLater(self._delay, other._drop)
            self._drop()

    def _deliver(self, data: bytes) -> None:
        if self.receiver is not None:
            self.receiver.data_received(data)

    def _drop(self) -> None:
        self.other = None
        receiver, self.receiver = self.receiver, None
        if receiver is not None:
            receiver.link_down()


class MemoryConnector:
    """Opens links to ``accept`` through ``clock``; host and port are ignored.

    If ``is_open`` is False, new links are refused. ``cut`` breaks the open links, ``block_data`` drops their data.
    """

    def __init__(self, clock: IReactorTime, accept: Accept, delay: float = 0.0005) -> None:
        self.is_open = True
        self.links: list[MemoryLink] = []
        self._clock = clock
        self._accept = accept
        self._delay = delay

    def connect(self, host: str, port: int, client: LinkClient) -> Reconnector:
        """Keep ``client`` connected, with back-off, until ``disconnect`` is called."""
        return _MemoryReconnector(self, self._clock, client)

    def cut(self) -> None:
        """Break every open link."""
        links, self.links = self.links, []
        for link in links:
            link.close()

    def block_data(self) -> None:
        """Drop all data on open links and refuse new ones, as a lost radio connection does."""
        self.is_open = False
        for link in self.links:
            for end in (link, link.other):
                if end is not None:
                    end.is_blocked = True

    def open_pair(self, client: Receiver) -> MemoryLink | None:
        """Open a new pair of links and return the client's end; None if the connector refuses links."""
        if not self.is_open:
            return None
        near, far = MemoryLink(self._clock, self._delay), MemoryLink(self._clock, self._delay)
        near.other, far.other = far, near
        near.receiver = client
        far.receiver = self._accept(far)
        self.links = [link for link in self.links if link.other is not None] + [near]
        return near


class _MemoryReconnector:
    """The counterpart of ``_TcpReconnector`` in memory; it receives from the link to notice when the link closes."""

    def __init__(self, connector: MemoryConnector, clock: IReactorTime, client: LinkClient) -> None:
        self._connector = connector
        self._client = client
        self._retry_s = FIRST_RETRY_S
        self._link: MemoryLink | None = None
        self._is_wanted = True
        self._pending = Timer(clock)
        self._pending.set(0.0, self._try_open)

    def disconnect(self) -> Deferred[None]:
        self._is_wanted = False
        self._pending.cancel()
        if self._link is not None:
            self._link.close()
        return succeed(None)

    def data_received(self, data: bytes) -> None:
        self._client.data_received(data)

    def link_down(self) -> None:
        self._link = None
        if self._is_wanted:
            self._pending.set(FIRST_RETRY_S, self._try_open)
        self._client.link_down()

    def _try_open(self) -> None:
        self._link = self._connector.open_pair(self)
        if self._link is None:
            self._pending.set(self._retry_s, self._try_open)
            self._retry_s = min(self._retry_s * RETRY_FACTOR, MAX_RETRY_S)
            return
        self._retry_s = FIRST_RETRY_S
        self._client.link_up(self._link)
