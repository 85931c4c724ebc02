"""Start, call, supervise and end the process of one pushed module.

The node never waits for a behaviour: it sends a request and polls for the reply.  It waits for a strategy for at most
``DEADLINE_S``.  A process that is late or sends an unexpected reply is killed.  After a process was killed or has
ended, the next request starts a new one, unless this has happened ``MAX_LOSSES`` times.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

from twisted.logger import Logger

from middleware.consensus.deployed_modules import PREFIX
from middleware.consensus.guarded_strategy import MAX_LOSSES, StrategyError, StrategyLost
from middleware.consensus.remote_strategy import RemoteStrategy
from middleware.consensus.strategy import READABLE
from middleware.deployment import module_channel
from middleware.deployment.manifest import Manifest
from middleware.deployment.module_channel import CALL, DROP, LOAD, MAKE, STRATEGY_INSTANCE, Channel, ProcessEnded, Spawn
from middleware.errors import UnknownTask

DEADLINE_S = 0.2
"""Maximum seconds that the node waits for the reply of a strategy; well below a third of a lease."""
REPLY_TIMEOUT_S = 1.0
"""Seconds after which a behaviour that has not replied is killed."""
START_TIMEOUT_S = 20.0
"""Seconds within which a process has to be ready."""
MAX_PENDING = 256
"""Maximum number of pending requests."""


class State(Enum):
    """States of a runner."""

    IDLE = "idle"
    STARTING = "starting"
    READY = "ready"
    LOST = "lost"
    OUT = "out"


TRANSITIONS: Mapping[State, frozenset[State]] = {
    State.IDLE: frozenset({State.STARTING, State.OUT}),
    State.STARTING: frozenset({State.READY, State.LOST, State.OUT}),
    State.READY: frozenset({State.LOST, State.OUT}),
    State.LOST: frozenset({State.STARTING, State.OUT}),
    State.OUT: frozenset(),
}


@dataclass
class _Pending:
    asked_at: float
    on_reply: Callable[[bool, Any], None]


class Runner:
    """The process of the module of ``manifest`` with its ``source``.

    ``seconds`` is the node's monotonic clock.  ``objection`` is called before each start and returns the reason why the
    module may not run now, or an empty string.  ``why`` is the reason why the process last ended; ``limits`` are the
    limits in effect in the process.
    """

    _log = Logger()

    def __init__(
        self,
        manifest: Manifest,
        source: bytes,
        spawn: Spawn,
        seconds: Callable[[], float],
        objection: Callable[[], str] = lambda: "",
    ) -> None:
        self.manifest = manifest
        self.state = State.IDLE
        self.why = ""
        self.limits: tuple[str, ...] = ()
        self.reads: tuple[str, ...] = READABLE
        self.instances: set[BehaviourInstance] = set()
        self.last_request_at = seconds()
        self._source = source
        self._spawn = spawn
        self._seconds = seconds
        self._find_objection = objection
        self._channel: Channel | None = None
        self._pending: dict[int, _Pending] = {}
        self._number = 0
        self._losses = 0
        self._started_at = 0.0

    def start(self) -> None:
        """Start the process, which then loads the module; ``poll`` processes the result."""
        why = self._find_objection()
        if why:
            return self.stop(why)
        self._set_state(State.STARTING)
        self._started_at = self._seconds()
        m = self.manifest
        try:
            self._channel = self._spawn()
            self.send_request(LOAD, [m.name, m.kind, m.version, m.digest, m.size, self._source], self._on_loaded)
        except (ProcessEnded, OSError) as error:
            self._kill(f"its process cannot be started: {error}")

    def poll(self) -> None:
        """Process replies, and kill a process that is late."""
        self._process_replies(0.0)
        if self._channel is None:
            return
        now = self._seconds()
        if self.state is State.STARTING and now - self._started_at > START_TIMEOUT_S:
            self._kill(f"it was not loaded within {START_TIMEOUT_S:g} s")
        elif self.state is State.READY and any(
            now - each.asked_at > REPLY_TIMEOUT_S for each in self._pending.values()
        ):
            self._kill(f"it did not answer within {REPLY_TIMEOUT_S:g} s")

    def stop(self, why: str) -> None:
        """End the process permanently."""
        if self.state is not State.OUT:
            self._set_state(State.OUT)
            self._end_process(why)

    def call(self, verb: str, arguments: list[Any]) -> Any:
        """Return the reply to one request, waiting at most ``DEADLINE_S``; raises ``StrategyError``."""
        self.last_request_at = self._seconds()
        if self.state is State.LOST:
            self.start()
        if self.state is State.STARTING:
            self.poll()
        if self.state is State.STARTING:
            raise StrategyError("it is still being loaded")
        if self.state is not State.READY:
            raise StrategyError(self.why)
        answers: list[tuple[bool, Any]] = []
        try:
            self.send_request(verb, arguments, lambda is_well, content: answers.append((is_well, content)))
        except ProcessEnded as error:
            self._kill(str(error))
        if not answers:
            self._process_replies(DEADLINE_S, lambda: bool(answers))
        if not answers:
            if self.state is State.READY:
                self._kill(f"it did not answer within {DEADLINE_S:g} s")
            raise StrategyLost(self.why)
        is_well, content = answers[0]
        if not is_well:
            raise StrategyError(str(content))
        return content

    def send_request(self, verb: str, arguments: list[Any], take: Callable[[bool, Any], None]) -> None:
        """Send a request without waiting; ``take`` is called with the reply, or with False and an error text.

        Raises ``ProcessEnded``.
        """
        if self._channel is None:
            raise ProcessEnded(self.why or "its process has ended")
        if len(self._pending) >= MAX_PENDING:
            raise ProcessEnded(f"{MAX_PENDING} requests are pending")
        self.last_request_at = self._seconds()
        number = self.next_number()
        self._pending[number] = _Pending(self.last_request_at, take)
        self._channel.send(module_channel.pack([number, verb, arguments]))

    def next_number(self) -> int:
        """Return a new number for a request or an instance."""
        self._number += 1
        return self._number

    @property
    def has_unsent(self) -> bool:
        """Whether a part of a message is not sent yet."""
        return self._channel is not None and self._channel.has_unsent

    def create(self, parameters: Mapping[str, Any], rng: random.Random) -> BehaviourInstance:
        """Create an instance of a behaviour; raises ``UnknownTask`` if it may not run."""
        if self.state is State.LOST:
            self.start()
        if self.state not in (State.STARTING, State.READY):
            raise UnknownTask(f"the behaviour {PREFIX}{self.manifest.name} does not run: {self.why}")
        return BehaviourInstance(self, dict(parameters), rng.getrandbits(48))

    # -- implementation ---------------------------------------------------------------------------------------------

    def _process_replies(self, within_s: float, is_done: Callable[[], bool] = lambda: True) -> None:
        """Process replies until ``is_done``, for at most ``within_s`` seconds."""
        end = self._seconds() + within_s
        try:
            while self._channel is not None:
                messages = self._channel.receive(max(0.0, end - self._seconds()))
                for message in messages:
                    if self._channel is not None:
                        self._handle_reply(*module_channel.parse_reply(message))
                if not messages or is_done():
                    return
        except (ProcessEnded, module_channel.BadFrame) as error:
            self._kill(str(error))

    def _handle_reply(self, number: int, is_well: bool, content: Any) -> None:
        pending = self._pending.pop(number, None)
        if pending is None:
            raise ProcessEnded("it sent a reply without a request")
        pending.on_reply(is_well, content)

    def _on_loaded(self, is_well: bool, content: Any) -> None:
        if self.state is not State.STARTING:
            return
        if not is_well or not isinstance(content, dict):
            return self.stop(str(content))
        limits, reads = content.get("limits"), content.get("reads")
        self.limits = tuple(str(each)[:40] for each in limits[:16]) if isinstance(limits, list) else ()
        self.reads = tuple(name for name in READABLE if name in reads) if isinstance(reads, list) else READABLE
        self._set_state(State.READY)

    def _kill(self, why: str) -> None:
        if self.state in (State.LOST, State.OUT):
            return
        self._log.warn("{name}: process killed: {why}", name=self.manifest.name, why=why)
        self._losses += 1
        self._set_state(State.OUT if self._losses >= MAX_LOSSES else State.LOST)
        self._end_process(why)

    def _end_process(self, why: str) -> None:
        self.why = why
        channel, self._channel = self._channel, None
        if channel is not None:
            channel.kill()
        pending, self._pending = self._pending, {}
        self.instances.clear()
        for each in pending.values():
            each.on_reply(False, why)

    def _set_state(self, state: State) -> None:
        assert state in TRANSITIONS[self.state], (self.state, state)
        self.state = state


class PushedStrategy(RemoteStrategy):
    """The strategy in a runner's process."""

    def __init__(self, runner: Runner) -> None:
        manifest = runner.manifest
        self.name, self.version, self.reads = f"{PREFIX}{manifest.name}", manifest.label, runner.reads
        self._runner = runner

    def call(self, method: str, arguments: list[Any]) -> Any:
        """Return the reply of the process; raises ``StrategyError``."""
        return self._runner.call(CALL, [STRATEGY_INSTANCE, method, arguments])


class BehaviourInstance:
    """One instance of a behaviour; it ends with the process that created it.

    ``fault`` is the reason why the instance cannot be called; empty if it can be called.
    """

    def __init__(self, runner: Runner, parameters: dict[str, Any], seed: int) -> None:
        self.fault = ""
        self.facts: dict[str, Any] = {}
        self._runner = runner
        self._is_created = False
        self._place = runner.next_number()
        self._creation: list[Any] | None = [self._place, [parameters, seed]]
        runner.instances.add(self)
        self._request_creation()

    @property
    def has_unsent(self) -> bool:
        """Whether a part of a message is not sent yet."""
        return self._runner.has_unsent

    def send_request(self, method: str, arguments: list[Any], take: Callable[[bool, Any], None]) -> bool:
        """Send a request without waiting (``take`` as in ``Runner.send_request``); return whether that was possible."""
        self.poll()
        if self.fault or not self._is_created:
            return False
        self._send(CALL, [self._place, method, arguments], take)
        return not self.fault

    def poll(self) -> None:
        """Process replies."""
        if not self.fault:
            self._runner.poll()
            self._request_creation()

    def close(self) -> None:
        """Delete the instance."""
        if self in self._runner.instances:
            self._runner.instances.discard(self)
            if not self.fault and self._is_created:
                self._send(DROP, [self._place], lambda is_well, content: None)
        self.fault = self.fault or "it was closed"

    def _request_creation(self) -> None:
        """Request the creation once the process is ready."""
        if self not in self._runner.instances:
            self.fault = self.fault or self._runner.why or "its process has ended"
        elif self._creation is not None and self._runner.state is State.READY:
            creation, self._creation = self._creation, None
            self._send(MAKE, creation, self._on_created)
            self._runner.poll()

    def _on_created(self, is_well: bool, content: Any) -> None:
        if is_well and isinstance(content, dict):
            self._is_created, self.facts = True, content
        else:
            self.fault = str(content)

    def _send(self, verb: str, arguments: list[Any], take: Callable[[bool, Any], None]) -> None:
        try:
            self._runner.send_request(verb, arguments, take)
        except ProcessEnded as error:
            self.fault = str(error)
