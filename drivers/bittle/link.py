"""Links over the robot's web server, which behave towards the driver like a serial link."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from drivers.bittle import codec
from drivers.errors import BadFrame
from drivers.link import Connector, Link, LinkClient, Reconnector
from drivers.timer import Timer

REQUEST_TIMEOUT_S = 3.0
"""Seconds after which an unanswered request has failed."""
STATUS_POLL_S = 0.05
"""Interval in seconds at which a BiBoard's task is polled, for at most ``TASK_TIMEOUT_S``."""
TASK_TIMEOUT_S = 16.0
MAX_FAILURES = 3
"""Consecutive failures after which the link counts as lost."""
RETRY_S = 1.0
MAX_QUEUED = 8


class HttpConnector:
    """Opens links to robots with a ``biboard`` or ``nyboard``; ``connector`` opens a connection for each request."""

    def __init__(self, connector: Connector, clock: IReactorTime, board: str) -> None:
        self._connector = connector
        self._clock = clock
        self._board = board

    def connect(self, host: str, port: int, client: LinkClient) -> Reconnector:
        """Keep ``client`` connected to the robot at this address until ``disconnect``."""
        return HttpLink(self._connector, self._clock, self._board, host, port, client)


class HttpLink:
    """A link over many HTTP connections; ``problem`` is the reason why the robot cannot be reached.

    ``should_send`` is called when a queued command can be sent; if it returns False, the command is dropped.
    """

    log = Logger()

    def __init__(
        self, connector: Connector, clock: IReactorTime, board: str, host: str, port: int, client: LinkClient
    ) -> None:
        self.problem = ""
        self.should_send: Callable[[bytes], bool] = lambda _: True
        self._connector = connector
        self.clock = clock
        self._board = board
        self._host = host
        self._port = port
        self._peer: tuple[str, int] | None = None
        self._client = client
        self._queue: deque[bytes] = deque()
        self._request: _Request | None = None
        self._is_up = False
        self._is_wanted = True
        self._failure_count = 0
        self._closed: Deferred[None] | None = None
        self._timer = Timer(clock)
        self._timer.set(0.0, self._open)

    # -- Line -------------------------------------------------------------------------------------------------------

    def disconnect(self) -> Deferred[None]:
        """Send only the last queued command, which makes the robot lie down; fires when that request has ended."""
        self._is_wanted = False
        if self._is_up:
            self._is_up = False
            self._client.link_down()
        last = self._queue.pop() if self._queue else None
        self._queue.clear()
        self._timer.cancel()
        if last is not None:
            self._drop_request()
            self._request = _Request(self, codec.format_command_path(self._board, last), lambda _: None)
        if self._request is None:
            return succeed(None)
        self._closed = self._closed or Deferred()
        return self._closed

    @property
    def address(self) -> tuple[str, int]:
        """The address of the robot; numeric after its first connection over a real network."""
        return self._peer or (self._host, self._port)

    # -- Link -------------------------------------------------------------------------------------------------------

    @property
    def is_busy(self) -> bool:
        """Whether commands are queued."""
        return bool(self._queue)

    def send(self, data: bytes) -> None:
        """Send one command; does nothing on a closed link."""
        if not self._is_up:
            return
        if len(self._queue) >= MAX_QUEUED:
            self._queue.popleft()
        self._queue.append(data)
        if self._request is None and not self._timer.is_set:
            self._send_next()

    def close(self) -> None:
        """Close now."""
        self._lose("closed")

    def _open(self) -> None:
        self._is_up = True
        self._failure_count = 0
        link: Link = self
        self._client.link_up(link)

    def _lose(self, problem: str) -> None:
        if not self._is_up:
            return
        if problem != self.problem:
            self.log.warn("{host}: {problem}", host=self._host, problem=problem)
        self.problem = problem
        self._is_up = False
        self._queue.clear()
        self._drop_request()
        self._timer.cancel()
        self._client.link_down()
        if self._is_wanted:
            self._timer.set(RETRY_S, self._open)

    def _send_next(self) -> None:
        while self._queue and not self.should_send(self._queue[0]):
            self._queue.popleft()
        if not self._queue or not self._is_up:
            return
        command = self._queue.popleft()
        path = codec.format_command_path(self._board, command)
        if self._board == "nyboard":
            end = self.clock.seconds() + TASK_TIMEOUT_S
            self._request = _Request(self, path, lambda body: self._on_text(body, command, end), command)
        else:
            self._request = _Request(self, path, lambda body: self._on_task(body, command), command)

    def _on_text(self, body: bytes, command: bytes, end: float) -> None:
        if not self._is_wanted:
            return
        # Output after the dongle's response stays in the dongle until the next request, which may be empty.
        is_done = _has_end(body, command)
        if not is_done and self.clock.seconds() < end and not self._queue:
            self._timer.set(STATUS_POLL_S, self._request_more, command, end)
        self._deliver(body + b"\n")

    def _request_more(self, command: bytes, end: float) -> None:
        if self._queue:
            self._send_next()
        else:
            path = codec.format_command_path(self._board, b"")
            self._request = _Request(self, path, lambda body: self._on_text(body, command, end))

    def _on_task(self, body: bytes, command: bytes) -> None:
        task = codec.parse_task_id(body)
        if not self._is_wanted:
            return
        self._request_status(task, command, self.clock.seconds() + TASK_TIMEOUT_S)

    def _request_status(self, task: str, command: bytes, end: float) -> None:
        self._request = _Request(
            self, codec.format_status_path(task), lambda body: self._on_status(body, task, command, end)
        )

    def _on_status(self, body: bytes, task: str, command: bytes, end: float) -> None:
        result = codec.parse_task_result(body)
        if result is None and self.clock.seconds() < end:
            self._timer.set(STATUS_POLL_S, self._request_status, task, command, end)
            return
        lines = (result or b"") + b"\n"
        # On a cable the token ends the answer; over HTTP the status of the task shows the end.
        if result is not None and not _has_end(lines, command):
            lines += command[:1] + b"\n"
        self._deliver(lines)

    def _deliver(self, lines: bytes) -> None:
        self._failure_count = 0
        self.problem = ""
        self._client.data_received(lines)
        if self._request is None and not self._timer.is_set:
            self._send_next()

    def on_request_failed(self, problem: str) -> None:
        """Handle a failed request."""
        self._end_request()
        self._failure_count += 1
        if self._failure_count >= MAX_FAILURES:
            self._lose(problem)
        else:
            self._send_next()

    def on_command_dropped(self) -> None:
        """Handle a request whose command was dropped because of ``should_send``."""
        self._end_request()
        self._send_next()

    def on_response(self, body: bytes, take: Callable[[bytes], None]) -> None:
        """Handle the body of a request's response."""
        self._end_request()
        try:
            take(body)
        except BadFrame as error:
            self.on_request_failed(str(error))

    def open_connection(self, request: _Request) -> Reconnector:
        """Open a connection for a request."""
        return self._connector.connect(self._host, self._port, request)

    def store_peer(self, link: Link) -> None:
        """Store the address of the other end of a request's connection."""
        self._peer = getattr(link, "peer", None) or self._peer

    def encode_command_request(self, command: bytes) -> bytes:
        """Return the bytes of the request that makes the robot perform ``command``."""
        return self.encode_request(codec.format_command_path(self._board, command))

    def encode_request(self, path: str) -> bytes:
        """Return the bytes of a request for ``path``."""
        return codec.encode_request(self._host, path)

    def _end_request(self) -> None:
        self._request = None
        closed, self._closed = self._closed, None
        if closed is not None:
            closed.callback(None)

    def _drop_request(self) -> None:
        request, self._request = self._request, None
        if request is not None:
            request.drop()


def _has_end(lines: bytes, command: bytes) -> bool:
    return any(codec.is_end(line, chr(command[0])) for line in lines.decode("latin-1").split())


class _Request:
    """One request over its own connection; ``command`` is the command in the request, if any."""

    def __init__(self, http_link: HttpLink, path: str, take: Callable[[bytes], None], command: bytes = b"") -> None:
        self._http_link = http_link
        self._path = path
        self._on_body = take
        self._command = command
        self._reader = codec.ResponseReader()
        self._is_over = self._is_sent = False
        self._timer = Timer(http_link.clock)
        self._timer.set(REQUEST_TIMEOUT_S, self._on_timeout)
        self._reconnector = http_link.open_connection(self)

    def link_up(self, link: Link) -> None:
        if self._is_sent:
            # The first connection was lost, and the robot may already have performed the command.
            self._fail("the robot closed the connection without an answer; does its firmware have a web server?")
            return
        if self._command and not self._http_link.should_send(self._command):
            self.drop()
            self._http_link.on_command_dropped()
            return
        self._is_sent = True
        self._http_link.store_peer(link)
        link.send(self._http_link.encode_request(self._path))

    def data_received(self, data: bytes) -> None:
        if self._is_over:
            return
        try:
            body = self._reader.read(data)
        except BadFrame as error:
            self._fail(str(error))
            return
        if body is not None:
            self._finish(body)

    def link_down(self) -> None:
        if self._is_over:
            return
        try:
            body = self._reader.finish()
        except BadFrame as error:
            self._fail(str(error))
            return
        self._finish(body)

    def drop(self) -> None:
        self._is_over = True
        self._timer.cancel()
        self._reconnector.disconnect()

    def _on_timeout(self) -> None:
        self._fail("the robot does not answer; is it switched on and in this network, and is the option host correct?")

    def _finish(self, body: bytes) -> None:
        self.drop()
        self._http_link.on_response(body, self._on_body)

    def _fail(self, problem: str) -> None:
        if not self._is_over:
            self.drop()
            self._http_link.on_request_failed(problem)
