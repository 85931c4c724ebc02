"""Inject faults into one node: accept orders, apply each fault for its duration, and remove it.

The states of an ordered fault are connected by ``TRANSITIONS``.  Faults of different kinds can be active at the same
time; a new fault replaces an active fault of the same kind.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any, Protocol

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from middleware.entangled.contact import Contact
from middleware.entangled.errors import Refused
from middleware.entangled.network.network import Network
from middleware.entangled.network.switchboard import PERFECT, LinkConditions
from middleware.errors import BadFault, UnknownTask
from middleware.faults.kinds import ASSIGN_METHOD, CAUSE_METHOD, KINDS, LIST_METHOD, Fault, parse_fault
from middleware.faults.network import FaultyNetwork
from middleware.node import SwarmNode
from middleware.tasks.task import Task

MakeTask = Callable[[str, str, float], Task]
"""Creates a predefined task from its name, a new task id, and the wall-clock time."""
BATTERY_LEVEL = "power.level"
START_DELAY_S = 0.5
"""Seconds between the reply and the fault, because an isolated or dead node cannot confirm the order.  With packet
loss, the node may have to send the reply several times before the fault begins."""


class State(Enum):
    """The state of an ordered fault."""

    ORDERED = "ordered"
    ACTIVE = "active"
    OVER = "over"


class Event(Enum):
    """An event of an ordered fault."""

    BEGIN = "begin"
    END = "end"
    REPLACE = "replace"


TRANSITIONS: Mapping[tuple[State, Event], State] = {
    (State.ORDERED, Event.BEGIN): State.ACTIVE,
    (State.ACTIVE, Event.REPLACE): State.OVER,
    (State.ACTIVE, Event.END): State.OVER,
    (State.OVER, Event.END): State.OVER,
}
"""The END event of a replaced fault also occurs, but has no effect.  Every pair of state and event that is not in this
table is a programming error."""


class Process(Protocol):
    """The process of a node."""

    def kill(self) -> None:
        """End the node as a power failure does."""

    def freeze(self, seconds: float) -> None:
        """Stop the node for ``seconds``, then let it continue."""


@dataclass(eq=False)
class _OrderedFault:
    fault: Fault
    until: float = 0.0
    state: State = State.ORDERED

    def advance(self, event: Event) -> bool:
        """Go to the next state; return whether the state has changed."""
        before, self.state = self.state, TRANSITIONS[self.state, event]
        return self.state is not before


class SkewedClock:
    """A wall clock that is ``ahead`` seconds fast."""

    def __init__(self, wall: Callable[[], float]) -> None:
        self.ahead = 0.0
        self._wall = wall

    def __call__(self) -> float:
        """Return the time of this clock."""
        return self._wall() + self.ahead


class LowBattery:
    """Forwards everything to ``driver``, but reports a charge of at most ``level`` (0 to 1); None: the real charge.

    The robot still obeys commands; it is the agent that has to give up the task.
    """

    def __init__(self, driver: Any) -> None:
        self.level: float | None = None
        self._driver = driver

    def __getattr__(self, name: str) -> Any:
        return getattr(self._driver, name)

    def observe(self) -> Any:
        """Return the newest observation with the limited charge; None before the first observation."""
        return self._limit(self._driver.observe())

    def subscribe(self, seen: Callable[[Any], None]) -> Callable[[], None]:
        """Call ``seen`` with each observation, with the limited charge; the returned function ends the subscription."""
        end: Callable[[], None] = self._driver.subscribe(lambda observation: seen(self._limit(observation)))
        return end

    def _limit(self, seen: Any) -> Any:
        level = None if seen is None else seen.values.get(BATTERY_LEVEL)
        if self.level is None or not isinstance(level, float | int) or level <= self.level:
            return seen
        return replace(seen, values={**seen.values, BATTERY_LEVEL: self.level})


class FaultInjector:
    """Faults of one node.

    The node must use ``wall`` as its wall clock, and open its port through ``open_network``; its agent must use the
    driver from ``wrap_driver``.  If ``process`` is None, the node cannot be killed or frozen.  If no driver is wrapped,
    the fault ``battery`` is not available.
    """

    _log = Logger()

    def __init__(
        self,
        clock: IReactorTime,
        wall: Callable[[], float],
        rng: random.Random,
        make_network: Callable[[], Network],
        process: Process | None,
    ) -> None:
        self.wall = SkewedClock(wall)
        self._clock = clock
        self._rng = rng
        self._make_network = make_network
        self._process = process
        self._network: FaultyNetwork | None = None
        self._battery: LowBattery | None = None
        self._active: dict[str, _OrderedFault] = {}

    def open_network(self) -> Network:
        """Create the node's network with fault injection."""
        rng = random.Random(self._rng.getrandbits(64))
        self._network = FaultyNetwork(self._make_network(), self._clock, rng)
        return self._network

    def wrap_driver(self, driver: Any) -> Any:
        """Return ``driver`` with a charge that the fault ``battery`` can lower."""
        self._battery = LowBattery(driver)
        return self._battery

    def expose(self, node: SwarmNode, make_task: MakeTask) -> None:
        """Let other nodes order and list the faults of ``node``, and let them publish a predefined task for a scenario.

        ``make_task`` must raise ``UnknownTask`` for an unknown name.
        """

        def cause(peer: Contact, kind: object, seconds: object, amount: object) -> float:
            try:
                fault = parse_fault(kind, seconds, amount)
            except BadFault as error:
                raise Refused(str(error)) from error
            if fault.kind not in self.list_kinds():
                raise Refused(
                    f"kind: this device does not support {fault.kind}; choose one of {', '.join(self.list_kinds())}"
                )
            node.later(START_DELAY_S, self._begin, node, _OrderedFault(fault))
            return START_DELAY_S

        def list_faults(peer: Contact) -> dict[str, Any]:
            now = self._clock.seconds()
            active = [[each.fault.kind, each.until - now, each.fault.amount] for each in self._active.values()]
            return {"kinds": self.list_kinds(), "active": active}

        def assign(peer: Contact, name: str) -> Deferred[str]:
            try:
                task = make_task(name, node.rng.randbytes(6).hex(), node.wall())
            except UnknownTask as error:
                raise Refused(str(error)) from error
            return Deferred.fromCoroutine(node.submit(task)).addCallback(lambda task: task.task_id)

        expose = node.entangled.endpoint.expose
        expose(CAUSE_METHOD, cause, changes=True)
        expose(LIST_METHOD, list_faults)
        expose(ASSIGN_METHOD, assign, changes=True)

    def list_kinds(self) -> list[str]:
        """Return the kinds of faults that this node supports."""
        lacks = {*(() if self._process else ("kill", "freeze")), *(() if self._battery else ("battery",))}
        return [kind for kind in KINDS if kind not in lacks]

    # -- implementation ---------------------------------------------------------------------------------------------

    def _begin(self, node: SwarmNode, order: _OrderedFault) -> None:
        fault, name = order.fault, node.presence.device.name
        self._log.warn("fault injected: {name}, {kind} for {s:g} s", name=name, kind=fault.kind, s=fault.seconds)
        if fault.kind == "kill" and self._process is not None:
            return self._process.kill()
        order.advance(Event.BEGIN)
        order.until = self._clock.seconds() + fault.seconds
        former = self._active.get(fault.kind)
        if former is not None:
            former.advance(Event.REPLACE)
        self._active[fault.kind] = order
        self._apply()
        node.later(fault.seconds, self._end, order)
        if fault.kind == "freeze" and self._process is not None:
            self._process.freeze(fault.seconds)

    def _end(self, order: _OrderedFault) -> None:
        if order.advance(Event.END):
            del self._active[order.fault.kind]
            self._apply()

    def _apply(self) -> None:
        """Apply exactly the active faults."""

        def amount(kind: str, otherwise: float = 0.0) -> float:
            return self._active[kind].fault.amount if kind in self._active else otherwise

        self.wall.ahead = amount("skew")
        if self._network is not None:
            conditions = LinkConditions(delay_s=amount("delay"), loss=amount("loss"))
            self._network.conditions = PERFECT if conditions == PERFECT else conditions
            self._network.is_receive_blocked = "radio" in self._active
            self._network.is_send_blocked = "radio" in self._active or "one-way" in self._active
        if self._battery is not None:
            level = amount("battery", math.inf)
            self._battery.level = None if level == math.inf else level
