"""Runner: start, ask, watch and end the process of one pushed module.

The node never waits for a behaviour: it asks, and looks later whether there is an answer.  For a strategy it waits at
most ``DEADLINE_S``.  A process that is late, dies, or sends an unexpected answer is ended; the next question
starts it again, until it was lost ``STRIKES`` times.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any

from twisted.logger import Logger

from middleware.consensus.deployed import PREFIX
from middleware.consensus.guard import STRIKES, Lost, NoOpinion
from middleware.consensus.remote import RemoteStrategy
from middleware.consensus.strategy import READABLE
from middleware.deployment import frame
from middleware.deployment.frame import CALL, DROP, FIRST, LOAD, MAKE, Channel, Gone, Spawn
from middleware.deployment.manifest import Manifest
from middleware.errors import UnknownTask

DEADLINE_S = 0.2
"""Seconds that the node waits at most for the answer of a strategy; well below the third of a lease."""
PATIENCE_S = 1.0
"""Seconds after which a behaviour that has not answered is ended."""
START_S = 20.0
"""Seconds within which a process has to be ready."""
MAX_PENDING = 256
"""Questions that wait for an answer; more are not asked."""


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
    take: Callable[[bool, Any], None]


class Runner:
    """The process of the module of ``manifest``, pushed with ``source``.

    ``seconds`` is the node's monotonic clock.  ``objection`` is asked before each start: why the module may not run
    now, empty if it may.  ``why`` says why it is out or was lost, ``limits`` which limits hold in its process.
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
        self.instances: set[Instance] = set()
        self.asked_at = seconds()
        self._source = source
        self._spawn = spawn
        self._seconds = seconds
        self._objection = objection
        self._channel: Channel | None = None
        self._pending: dict[int, _Pending] = {}
        self._number = 0
        self._losses = 0
        self._began = 0.0

    def start(self) -> None:
        """Start the process and have it load the module; ``look`` tells later what came of it."""
        why = self._objection()
        if why:
            return self.stop(why)
        self._go(State.STARTING)
        self._began = self._seconds()
        m = self.manifest
        try:
            self._channel = self._spawn()
            self.ask(LOAD, [m.name, m.kind, m.version, m.digest, m.size, self._source], self._on_loaded)
        except (Gone, OSError) as error:
            self._lose(f"its process cannot be started: {error}")

    def look(self) -> None:
        """Take in the answers, and end a process that is late."""
        self._pump(0.0)
        if self._channel is None:
            return
        now = self._seconds()
        if self.state is State.STARTING and now - self._began > START_S:
            self._lose(f"it was not loaded within {START_S:g} s")
        elif self.state is State.READY and any(now - each.asked_at > PATIENCE_S for each in self._pending.values()):
            self._lose(f"it did not answer within {PATIENCE_S:g} s")

    def stop(self, why: str) -> None:
        """End the process for good."""
        if self.state is not State.OUT:
            self._go(State.OUT)
            self._end(why)

    def wait_for(self, verb: str, arguments: list[Any]) -> Any:
        """The answer to one question, waited for at most ``DEADLINE_S``; raises ``NoOpinion``."""
        self.asked_at = self._seconds()
        if self.state is State.LOST:
            self.start()
        if self.state is State.STARTING:
            self.look()
        if self.state is State.STARTING:
            raise NoOpinion("it is still being loaded")
        if self.state is not State.READY:
            raise NoOpinion(self.why)
        answers: list[tuple[bool, Any]] = []
        try:
            self.ask(verb, arguments, lambda is_well, content: answers.append((is_well, content)))
        except Gone as error:
            self._lose(str(error))
        if not answers:
            self._pump(DEADLINE_S, lambda: bool(answers))
        if not answers:
            if self.state is State.READY:
                self._lose(f"it did not answer within {DEADLINE_S:g} s")
            raise Lost(self.why)
        is_well, content = answers[0]
        if not is_well:
            raise NoOpinion(str(content))
        return content

    def ask(self, verb: str, arguments: list[Any], take: Callable[[bool, Any], None]) -> None:
        """Ask without waiting; ``take`` is called with the answer, or with False and why there is none.

        Raises ``Gone``.
        """
        if self._channel is None:
            raise Gone(self.why or "its process has ended")
        if len(self._pending) >= MAX_PENDING:
            raise Gone(f"{MAX_PENDING} questions wait for an answer")
        self.asked_at = self._seconds()
        number = self.take_number()
        self._pending[number] = _Pending(self.asked_at, take)
        self._channel.send(frame.pack([number, verb, arguments]))

    def take_number(self) -> int:
        """A number that no question and no instance has had."""
        self._number += 1
        return self._number

    @property
    def is_behind(self) -> bool:
        """Whether the process has not taken all that was sent."""
        return self._channel is not None and self._channel.is_behind

    def create(self, parameters: Mapping[str, Any], rng: random.Random) -> Instance:
        """One instance of a behaviour; raises ``UnknownTask`` if it may not run."""
        if self.state is State.LOST:
            self.start()
        if self.state not in (State.STARTING, State.READY):
            raise UnknownTask(f"the behaviour {PREFIX}{self.manifest.name} does not run: {self.why}")
        return Instance(self, dict(parameters), rng.getrandbits(48))

    # -- inside -----------------------------------------------------------------------------------------------------

    def _pump(self, within_s: float, is_done: Callable[[], bool] = lambda: True) -> None:
        """Take in answers; wait at most ``within_s`` seconds until ``is_done``."""
        end = self._seconds() + within_s
        try:
            while self._channel is not None:
                messages = self._channel.receive(max(0.0, end - self._seconds()))
                for message in messages:
                    if self._channel is not None:
                        self._take(*frame.unpack_answer(message))
                if not messages or is_done():
                    return
        except (Gone, frame.BadFrame) as error:
            self._lose(str(error))

    def _take(self, number: int, is_well: bool, content: Any) -> None:
        pending = self._pending.pop(number, None)
        if pending is None:
            raise Gone("it answered what was not asked")
        pending.take(is_well, content)

    def _on_loaded(self, is_well: bool, content: Any) -> None:
        if self.state is not State.STARTING:
            return
        if not is_well or not isinstance(content, dict):
            return self.stop(str(content))
        limits, reads = content.get("limits"), content.get("reads")
        self.limits = tuple(str(each)[:40] for each in limits[:16]) if isinstance(limits, list) else ()
        self.reads = tuple(name for name in READABLE if name in reads) if isinstance(reads, list) else READABLE
        self._go(State.READY)

    def _lose(self, why: str) -> None:
        if self.state in (State.LOST, State.OUT):
            return
        self._log.warn("{name}: its process was ended: {why}", name=self.manifest.name, why=why)
        self._losses += 1
        self._go(State.OUT if self._losses >= STRIKES else State.LOST)
        self._end(why)

    def _end(self, why: str) -> None:
        self.why = why
        channel, self._channel = self._channel, None
        if channel is not None:
            channel.end()
        pending, self._pending = self._pending, {}
        self.instances.clear()
        for each in pending.values():
            each.take(False, why)

    def _go(self, state: State) -> None:
        assert state in TRANSITIONS[self.state], (self.state, state)
        self.state = state


class PushedStrategy(RemoteStrategy):
    """The strategy of a runner."""

    def __init__(self, runner: Runner) -> None:
        manifest = runner.manifest
        self.name, self.version, self.reads = f"{PREFIX}{manifest.name}", manifest.label, runner.reads
        self._runner = runner

    def ask(self, method: str, arguments: list[Any]) -> Any:
        """The answer of its process; raises ``NoOpinion``."""
        return self._runner.wait_for(CALL, [FIRST, method, arguments])


class Instance:
    """One instance of a behaviour; it ends with the process in which it is made.

    ``fault`` says why it cannot be asked, empty while it can.
    """

    def __init__(self, runner: Runner, parameters: dict[str, Any], seed: int) -> None:
        self.fault = ""
        self.facts: dict[str, Any] = {}
        self._runner = runner
        self._is_made = False
        self._place = runner.take_number()
        self._wish: list[Any] | None = [self._place, [parameters, seed]]
        runner.instances.add(self)
        self._settle()

    @property
    def is_behind(self) -> bool:
        """Whether its process has not taken all that was sent."""
        return self._runner.is_behind

    def ask(self, method: str, arguments: list[Any], take: Callable[[bool, Any], None]) -> bool:
        """Ask without waiting; whether it could be asked.  ``take`` is called as by ``Runner.ask``."""
        self.look()
        if self.fault or not self._is_made:
            return False
        self._send(CALL, [self._place, method, arguments], take)
        return not self.fault

    def look(self) -> None:
        """Take in the answers."""
        if not self.fault:
            self._runner.look()
            self._settle()

    def close(self) -> None:
        """Have it forgotten."""
        if self in self._runner.instances:
            self._runner.instances.discard(self)
            if not self.fault and self._is_made:
                self._send(DROP, [self._place], lambda is_well, content: None)
        self.fault = self.fault or "it was closed"

    def _settle(self) -> None:
        """Have it made once the process is ready."""
        if self not in self._runner.instances:
            self.fault = self.fault or self._runner.why or "its process has ended"
        elif self._wish is not None and self._runner.state is State.READY:
            wish, self._wish = self._wish, None
            self._send(MAKE, wish, self._on_made)
            self._runner.look()

    def _on_made(self, is_well: bool, content: Any) -> None:
        if is_well and isinstance(content, dict):
            self._is_made, self.facts = True, content
        else:
            self.fault = str(content)

    def _send(self, verb: str, arguments: list[Any], take: Callable[[bool, Any], None]) -> None:
        try:
            self._runner.ask(verb, arguments, take)
        except Gone as error:
            self.fault = str(error)
