"""Yard: the world, its sensors and cameras tied to connections, paced by the clock it is given.

Each dog obeys one driver at a time, through a gate of its own: a command runs out after its time to live, whatever
became of the driver, and the dog stops when the connection closes.  The gate outlives its drivers: what is older than
what the dog has obeyed is refused, also over a new connection, and the dog tells the next driver how far it is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from random import Random
from typing import Any

from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from drivers.driver import Permit
from drivers.errors import StaleCommand
from drivers.gate import Gate
from drivers.sim.codec import (
    VERSION,
    Done,
    Drive,
    Halt,
    Hello,
    Message,
    Motors,
    Order,
    Overlook,
    Picture,
    Refused,
    Sensors,
    Truth,
)
from drivers.sim.link import Link, MemoryConnector
from sim.camera import HEIGHT, WIDTH, Camera
from sim.scene import Scene
from sim.sensor import Sensors as Senses
from sim.session import Beat, Session
from sim.world import SUBSTEP, NotPossible, World

SUBSTEPS = 4
TICK_S = SUBSTEP * SUBSTEPS
SILENT_S = 3.0
"""A client that says nothing for so long is given up, and its robot is free for another."""
MAX_LATE_S = 1.0
MAX_TTL_S = 10.0
MAX_SESSIONS = 64
MAX_FPS = 30.0
MAX_RATE = 1.0 / TICK_S


class Yard:
    """One yard; ``start`` lets its time run on ``clock``, ``attach`` takes a connection.

    The truth is in ``world``; whoever referees may look there, or ask as an operator over a link.
    """

    log = Logger()

    def __init__(self, clock: IReactorTime, rng: Random, scene: Scene) -> None:
        self._clock = clock
        self.world = World(Random(rng.getrandbits(64)), scene)
        self._camera = Camera(Random(rng.getrandbits(64)), self.world)
        self._senses = {
            name: Senses(Random(rng.getrandbits(64)), self.world, dog) for name, dog in self.world.dogs.items()
        }
        self._gates = {name: Gate() for name in self.world.dogs}
        self._sessions: list[Session] = []
        self._holders: dict[str, Session] = {}
        self._orders: dict[str, tuple[Callable[..., None], tuple[type, ...]]] = {
            "place_target": (self.world.place_target, (float, float)),
            "place_target_at_random": (self.world.place_target_at_random, ()),
            "place_target_later": (self.world.place_target_later, (float,)),
            "clear_target": (self.world.clear_target, ()),
            "move_dog": (self.world.move_dog, (str, float, float, float)),
            "scatter": (self.world.scatter, (int,)),
        }
        self._origin = clock.seconds()
        self._ticks = 0
        self._pending: Any = None

    @property
    def holders(self) -> list[str]:
        """The dogs that a driver holds now."""
        return [name for name in self.world.dogs if name in self._holders]

    def truth(self) -> dict[str, object]:
        """The whole yard as seen from above, and of each dog what its gate has let through and refused."""
        snapshot = self.world.snapshot()
        gates = self._gates.values()
        counts = [{"token": g.token or 0, "accepted": g.accepted, "refused": sum(g.refused.values())} for g in gates]
        dogs: Any = snapshot["dogs"]
        return {**snapshot, "dogs": [{**dog, **count} for dog, count in zip(dogs, counts, strict=True)]}

    def start(self) -> None:
        """Let time run from now on."""
        self._origin = self._clock.seconds() - self._ticks * TICK_S
        self._schedule()

    def stop(self) -> None:
        """Let time stand still, and close every connection."""
        if self._pending is not None:
            self._pending.cancel()
            self._pending = None
        for session in list(self._sessions):
            session.link.close()

    def attach(self, link: Link) -> Session:
        """Take a new connection; what arrives on it goes to the session that is returned."""
        session = Session(link, self._on_message, self._on_down, self._now())
        if len(self._sessions) >= MAX_SESSIONS:
            session.send(Refused(f"the yard has {MAX_SESSIONS} connections already", False))
            link.close()
            return session
        self._sessions.append(session)
        return session

    def connector(self, delay: float = 0.0005) -> MemoryConnector:
        """What drivers in this process connect through: ``SimDriver(options, yard.connector(), clock)``."""
        return MemoryConnector(self._clock, self.attach, delay)

    def _now(self) -> float:
        """The yard's time between the ticks too, in seconds since its start."""
        return self._clock.seconds() - self._origin

    def _schedule(self) -> None:
        self._pending = self._clock.callLater(max(0.0, (self._ticks + 1) * TICK_S - self._now()), self._turn)

    def _turn(self) -> None:
        late = self._now() - (self._ticks + 1) * TICK_S
        if late > MAX_LATE_S:
            # After a suspended machine nobody wants the lost minutes back at once, nor what was ordered before them.
            self._origin += late
            late = 0.0
            for name in self._gates:
                self._halt(name)
        due = 1 + max(0, math.floor(late / TICK_S + 1e-6))
        for left in range(due - 1, -1, -1):
            # A late yard drops pictures, never physics.
            self._tick(with_pictures=left == 0)
        self._schedule()

    def _tick(self, with_pictures: bool) -> None:
        for _ in range(SUBSTEPS):
            for name, gate in self._gates.items():
                if gate.is_over(self.world.t):
                    self._halt(name)
            self.world.step()
            for senses in self._senses.values():
                senses.sample()
        self._ticks += 1
        self._report(with_pictures)
        now = self._now()
        for session in list(self._sessions):
            if now - session.heard_at > SILENT_S:
                self.log.warn("{robot}: nothing heard for {seconds} s", robot=session.robot or "?", seconds=SILENT_S)
                session.link.close()

    def _report(self, with_pictures: bool) -> None:
        t = self.world.t
        for name, senses in self._senses.items():
            values, samples = senses.values(), senses.taken_samples()
            session = self._holders.get(name)
            if session is None:
                continue
            if session.link.is_busy:
                session.dropped += 1
                continue
            if with_pictures and session.pictures.is_due(t):
                session.seq += 1
                data = self._camera.jpeg(self.world.dogs[name])
                session.send(Picture(session.seq, t, WIDTH, HEIGHT, data))
            felt = {**values, "estop.engaged": not session.has_motors}
            session.send(Sensors(t, felt, samples, self._gates[name].token or 0))
        watchers = [one for one in self._sessions if one.is_operator and one.truths.is_due(t) and not one.link.is_busy]
        if watchers:
            truth = Truth(self.truth())
            for session in watchers:
                session.send(truth)

    def _on_message(self, session: Session, message: Message) -> None:
        session.heard_at = self._now()
        match message:
            case Hello():
                self._on_hello(session, message)
            case Overlook():
                session.is_operator = message.version == VERSION
                session.truths = Beat(min(max(message.rate, 0.1), MAX_RATE))
            case Order() if session.is_operator:
                session.send(Done(message.number, self._carried_out(message)))
            case _ if session.robot is not None:
                self._on_command(session.robot, session, message)
            case _:
                pass

    def _on_hello(self, session: Session, hello: Hello) -> None:
        problem, is_lasting = "", True
        if hello.version != VERSION:
            problem = f"the yard speaks version {VERSION} and not {hello.version}; update one of them"
        elif hello.robot not in self.world.dogs:
            problem = f"no robot is named {hello.robot!r} in this yard; it has {', '.join(self.world.dogs)}"
        elif self._holders.get(hello.robot, session) is not session:
            problem, is_lasting = f"{hello.robot} is taken by another driver", False
        elif session.robot not in (None, hello.robot):
            problem = f"this connection holds {session.robot} already"
        if problem:
            session.send(Refused(problem, is_lasting))
            session.link.close()
            return
        session.robot = hello.robot
        session.pictures = Beat(min(max(hello.camera_fps, 0.0), MAX_FPS))
        self._holders[hello.robot] = session

    def _on_command(self, name: str, session: Session, message: Message) -> None:
        match message:
            case Motors():
                session.has_motors = message.on
                if not message.on:
                    self._halt(name)
            case Halt():
                self._halt(name)
            case Drive() if session.has_motors:
                now = self._now()
                # A command that was held up has used up its time on the way; a stamp ahead of ours gains nothing.
                deadline = min(message.sent, now) + min(message.ttl, MAX_TTL_S)
                try:
                    self._gates[name].admit(Permit(message.token, deadline), now)
                except StaleCommand as error:
                    self.log.debug("{robot}: {error}", robot=name, error=error)
                    return
                self.world.drive(name, message.vx, message.vy, message.wz)

    def _halt(self, name: str) -> None:
        self._gates[name].close()
        self.world.halt(name)

    def _on_down(self, session: Session) -> None:
        if session in self._sessions:
            self._sessions.remove(session)
        if session.robot is not None and self._holders.get(session.robot) is session:
            del self._holders[session.robot]
            self._halt(session.robot)

    def _carried_out(self, order: Order) -> str:
        """Do what the operator orders; the problem in words, or an empty text."""
        if order.verb not in self._orders:
            return f"the yard knows no order {order.verb!r}; it knows {', '.join(self._orders)}"[:200]
        work, kinds = self._orders[order.verb]
        if len(order.arguments) != len(kinds) or not all(
            type(value) is kind for value, kind in zip(order.arguments, kinds, strict=True)
        ):
            return f"{order.verb} takes {', '.join(kind.__name__ for kind in kinds) or 'nothing'}"
        try:
            work(*order.arguments)
        except NotPossible as error:
            return str(error)[:200]
        return ""
