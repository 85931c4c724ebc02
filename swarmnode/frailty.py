"""Frailty: the ways in which a node can be made to fail on purpose."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred
from twisted.logger import Logger

from agents.catalogue import task_named
from drivers.drained import DrainedDriver
from drivers.driver import Driver
from middleware.entangled.errors import Refused
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.network.foul import FoulNetwork
from middleware.entangled.network.network import Network
from middleware.entangled.network.switchboard import CALM, Weather
from middleware.errors import BadFault, UnknownTask
from middleware.fault import ASKED, CAUSE, KINDS, Fault, fault_of
from middleware.node import SwarmNode
from swarmnode.seams import Seams

ASSIGN = "device.assign"
"""Method of a node that allows faults: publish a predefined task, so that a scenario can begin by itself."""
AFTER_ANSWERS = 0.5
"""Seconds from the answer to the fault: who is cut off, or dead, could not say that it took the order.  Where datagrams
get lost, here or at the other end, it may have to say so several times."""


class SkewedWall:
    """A wall clock that is ``ahead`` by so many seconds."""

    def __init__(self, wall: Callable[[], float]) -> None:
        self.ahead = 0.0
        self._wall = wall

    def __call__(self) -> float:
        """The seconds that it shows."""
        return self._wall() + self.ahead


class Frailty:
    """What is between one node and the world, that it can fail; ``seams`` are the world as the node sees it."""

    _log = Logger()

    def __init__(self, seams: Seams) -> None:
        self._wall = SkewedWall(seams.wall)
        self._raw = seams
        self._foul: FoulNetwork | None = None
        self._drained: DrainedDriver | None = None
        self._active: dict[str, tuple[Fault, float]] = {}
        self.seams = replace(seams, network=self._network, wall=self._wall)

    def drained(self, driver: Driver) -> Driver:
        """``driver``, whose battery can be made to read low."""
        self._drained = DrainedDriver(driver)
        return self._drained

    def answer(self, node: SwarmNode) -> None:
        """Let the node be asked for faults."""

        def cause(peer: Contact, kind: object, seconds: object, amount: object) -> float:
            try:
                fault = fault_of(kind, seconds, amount)
            except BadFault as error:
                raise Refused(str(error)) from error
            if fault.kind not in self.kinds():
                raise Refused(f"kind: this device cannot suffer {fault.kind}; choose one of {', '.join(self.kinds())}")
            node.later(AFTER_ANSWERS, self._suffer, node, fault)
            return AFTER_ANSWERS

        def asked(peer: Contact) -> dict[str, Any]:
            now = self._raw.clock.seconds()
            active = [[fault.kind, until - now, fault.amount] for fault, until in self._active.values()]
            return {"kinds": self.kinds(), "active": active}

        def assign(peer: Contact, name: str) -> Deferred[str]:
            try:
                task = task_named(name, node.rng.randbytes(6).hex(), node.wall())
            except UnknownTask as error:
                raise Refused(str(error)) from error
            return Deferred.fromCoroutine(node.submit(task)).addCallback(lambda task: task.task_id)

        expose = node.entangled.endpoint.expose
        expose(CAUSE, cause, changes=True)
        expose(ASKED, asked)
        expose(ASSIGN, assign, changes=True)

    def kinds(self) -> list[str]:
        """What this node can suffer."""
        lacks = {*(() if self._raw.plug else ("kill", "freeze")), *(() if self._drained else ("battery",))}
        return [kind for kind in KINDS if kind not in lacks]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _network(self) -> Network:
        dice = random.Random(self._raw.rng.getrandbits(64))
        self._foul = FoulNetwork(self._raw.network(), self._raw.clock, dice)
        return self._foul

    def _suffer(self, node: SwarmNode, fault: Fault) -> None:
        name = node.presence.device.name
        self._log.warn("{name} suffers {kind} for {s:g} s, on purpose", name=name, kind=fault.kind, s=fault.seconds)
        if fault.kind == "kill":
            assert self._raw.plug is not None
            return self._raw.plug.kill()
        mark = fault, self._raw.clock.seconds() + fault.seconds
        self._active[fault.kind] = mark
        self._apply()
        node.later(fault.seconds, self._heal, mark)
        if fault.kind == "freeze":
            assert self._raw.plug is not None
            self._raw.plug.freeze(fault.seconds)

    def _heal(self, mark: tuple[Fault, float]) -> None:
        # One that was caused anew meanwhile goes on for its own time.
        if self._active.get(mark[0].kind) is mark:
            del self._active[mark[0].kind]
            self._apply()

    def _apply(self) -> None:
        def amount(kind: str, otherwise: float = 0.0) -> float:
            return self._active[kind][0].amount if kind in self._active else otherwise

        self._wall.ahead = amount("skew")
        if self._foul is not None:
            weather = Weather(delay_s=amount("delay"), loss=amount("loss"))
            self._foul.weather = CALM if weather == CALM else weather
            self._foul.is_deaf = "radio" in self._active
            self._foul.is_mute = "radio" in self._active or "one-way" in self._active
        if self._drained is not None:
            level = amount("battery", math.inf)
            self._drained.level = None if level == math.inf else level
