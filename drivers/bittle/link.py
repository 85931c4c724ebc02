"""Link: commands and lines over the robot's web server, so that its driver sees what it would see on a cable."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from drivers.bittle import codec
from drivers.errors import BadFrame
from drivers.link import Caller, Connector, Line, Link
from drivers.timer import Timer

ANSWER_S = 3.0
"""A request without a response after so long has failed."""
STATUS_S = 0.05
"""A BiBoard is asked so often whether a task is done, for at most ``TASK_S``."""
TASK_S = 16.0
MISSES = 3
"""After so many failures, one after another, the link counts as lost."""
RETRY_S = 1.0
MAX_WAITING = 8


class HttpConnector:
    """Opens links to robots with a ``biboard`` or ``nyboard``, a connection for each request by ``connector``."""

    def __init__(self, connector: Connector, clock: IReactorTime, board: str) -> None:
        self._connector = connector
        self._clock = clock
        self._board = board

    def call(self, host: str, port: int, caller: Caller) -> Line:
        """Keep ``caller`` connected to the robot at this address until the line hangs up."""
        return HttpLine(self._connector, self._clock, self._board, host, port, caller)


class HttpLine:
    """A line, and its one link; ``problem`` says why the robot cannot be reached.

    ``may_leave`` is asked when a command that waited can leave: what is no longer wanted then never does.
    """

    log = Logger()

    def __init__(
        self, connector: Connector, clock: IReactorTime, board: str, host: str, port: int, caller: Caller
    ) -> None:
        self.problem = ""
        self.may_leave: Callable[[bytes], bool] = lambda _: True
        self._connector = connector
        self.clock = clock
        self._board = board
        self._host = host
        self._port = port
        self._peer: tuple[str, int] | None = None
        self._caller = caller
        self._waiting: deque[bytes] = deque()
        self._request: _Request | None = None
        self._is_up = False
        self._is_wanted = True
        self._misses = 0
        self._gone: Deferred[None] | None = None
        self._timer = Timer(clock)
        self._timer.set(0.0, self._rise)

    # -- the line ---------------------------------------------------------------------------------------------------

    def hang_up(self) -> Deferred[None]:
        """Ask no more, but for what was sent last: that is what makes the robot lie down; fires when it was asked."""
        self._is_wanted = False
        if self._is_up:
            self._is_up = False
            self._caller.link_down()
        last = self._waiting.pop() if self._waiting else None
        self._waiting.clear()
        self._timer.cancel()
        if last is not None:
            self._drop()
            self._request = _Request(self, codec.command_path(self._board, last), lambda _: None)
        if self._request is None:
            return succeed(None)
        self._gone = self._gone or Deferred()
        return self._gone

    @property
    def address(self) -> tuple[str, int]:
        """Where the robot is; as numbers, once it has taken a connection over a real network."""
        return self._peer or (self._host, self._port)

    # -- the link ---------------------------------------------------------------------------------------------------

    @property
    def is_busy(self) -> bool:
        """Whether commands wait for those before them."""
        return bool(self._waiting)

    def send(self, data: bytes) -> None:
        """Send one command; does nothing on a closed link."""
        if not self._is_up:
            return
        if len(self._waiting) >= MAX_WAITING:
            self._waiting.popleft()
        self._waiting.append(data)
        if self._request is None and not self._timer.is_set:
            self._next()

    def close(self) -> None:
        """Close now."""
        self._fall("closed")

    def _rise(self) -> None:
        self._is_up = True
        self._misses = 0
        link: Link = self
        self._caller.link_up(link)

    def _fall(self, problem: str) -> None:
        if not self._is_up:
            return
        if problem != self.problem:
            self.log.warn("{host}: {problem}", host=self._host, problem=problem)
        self.problem = problem
        self._is_up = False
        self._waiting.clear()
        self._drop()
        self._timer.cancel()
        self._caller.link_down()
        if self._is_wanted:
            self._timer.set(RETRY_S, self._rise)

    def _next(self) -> None:
        while self._waiting and not self.may_leave(self._waiting[0]):
            self._waiting.popleft()
        if not self._waiting or not self._is_up:
            return
        command = self._waiting.popleft()
        path = codec.command_path(self._board, command)
        if self._board == "nyboard":
            end = self.clock.seconds() + TASK_S
            self._request = _Request(self, path, lambda body: self._on_text(body, command, end), command)
        else:
            self._request = _Request(self, path, lambda body: self._on_task(body, command), command)

    def _on_text(self, body: bytes, command: bytes, end: float) -> None:
        if not self._is_wanted:
            return
        # What the robot says after the dongle has answered waits there for the next request, if only for nothing.
        is_done = _has_end(body, command)
        if not is_done and self.clock.seconds() < end and not self._waiting:
            self._timer.set(STATUS_S, self._ask_rest, command, end)
        self._answer(body + b"\n")

    def _ask_rest(self, command: bytes, end: float) -> None:
        if self._waiting:
            self._next()
        else:
            path = codec.command_path(self._board, b"")
            self._request = _Request(self, path, lambda body: self._on_text(body, command, end))

    def _on_task(self, body: bytes, command: bytes) -> None:
        task = codec.task_of(body)
        if not self._is_wanted:
            return
        self._ask_status(task, command, self.clock.seconds() + TASK_S)

    def _ask_status(self, task: str, command: bytes, end: float) -> None:
        self._request = _Request(self, codec.status_path(task), lambda body: self._on_status(body, task, command, end))

    def _on_status(self, body: bytes, task: str, command: bytes, end: float) -> None:
        result = codec.result_of(body)
        if result is None and self.clock.seconds() < end:
            self._timer.set(STATUS_S, self._ask_status, task, command, end)
            return
        lines = (result or b"") + b"\n"
        # That the task is done is what the token says on a cable.
        if result is not None and not _has_end(lines, command):
            lines += command[:1] + b"\n"
        self._answer(lines)

    def _answer(self, lines: bytes) -> None:
        self._misses = 0
        self.problem = ""
        self._caller.received(lines)
        if self._request is None and not self._timer.is_set:
            self._next()

    def failed(self, problem: str) -> None:
        """Learn from a request that it came to nothing."""
        self._end_request()
        self._misses += 1
        if self._misses >= MISSES:
            self._fall(problem)
        else:
            self._next()

    def passed_over(self) -> None:
        """Learn from a request that its command was no longer wanted when it could leave."""
        self._end_request()
        self._next()

    def fetched(self, body: bytes, take: Callable[[bytes], None]) -> None:
        """Learn from a request what it brought."""
        self._end_request()
        try:
            take(body)
        except BadFrame as error:
            self.failed(str(error))

    def call(self, request: _Request) -> Line:
        """Open a connection for a request."""
        return self._connector.call(self._host, self._port, request)

    def met(self, link: Link) -> None:
        """Learn from a request who has taken its connection."""
        self._peer = getattr(link, "peer", None) or self._peer

    def asked_of(self, command: bytes) -> bytes:
        """The bytes of a request that has the robot do ``command``."""
        return self.asked(codec.command_path(self._board, command))

    def asked(self, path: str) -> bytes:
        """The bytes of a request for ``path``."""
        return codec.request(self._host, path)

    def _end_request(self) -> None:
        self._request = None
        gone, self._gone = self._gone, None
        if gone is not None:
            gone.callback(None)

    def _drop(self) -> None:
        request, self._request = self._request, None
        if request is not None:
            request.drop()


def _has_end(lines: bytes, command: bytes) -> bool:
    return any(codec.is_end(line, chr(command[0])) for line in lines.decode("latin-1").split())


class _Request:
    """One request over a connection of its own; ``command`` is what it has the robot do, if anything."""

    def __init__(self, line: HttpLine, path: str, take: Callable[[bytes], None], command: bytes = b"") -> None:
        self._line = line
        self._path = path
        self._take = take
        self._command = command
        self._reader = codec.ResponseReader()
        self._is_over = self._is_sent = False
        self._timer = Timer(line.clock)
        self._timer.set(ANSWER_S, self._on_late)
        self._call = line.call(self)

    def link_up(self, link: Link) -> None:
        if self._is_sent:
            # A second connection, where the first was lost: the robot may have done it already.
            self._fail("the robot closes without an answer; is its web server part of the firmware?")
            return
        if self._command and not self._line.may_leave(self._command):
            self.drop()
            self._line.passed_over()
            return
        self._is_sent = True
        self._line.met(link)
        link.send(self._line.asked(self._path))

    def received(self, data: bytes) -> None:
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
            body = self._reader.ended()
        except BadFrame as error:
            self._fail(str(error))
            return
        self._finish(body)

    def drop(self) -> None:
        """Forget it."""
        self._is_over = True
        self._timer.cancel()
        self._call.hang_up()

    def _on_late(self) -> None:
        self._fail("the robot does not answer; is it switched on, in this network, and the option host right?")

    def _finish(self, body: bytes) -> None:
        self.drop()
        self._line.fetched(body, self._take)

    def _fail(self, problem: str) -> None:
        if not self._is_over:
            self.drop()
            self._line.failed(problem)
