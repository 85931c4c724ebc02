"""Yard: the world, its sensors and cameras tied to connections, paced by the clock it is given."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from random import Random
from typing import Any

from twisted.internet.interfaces import IReactorTime

from drivers.link import Link, MemoryConnector
from drivers.sim.codec import VERSION, Done, Message, Order, Overlook, Truth
from sim.camera import Camera
from sim.emulator.dog import DogBody
from sim.reception import Reception
from sim.scene import Scene
from sim.sensor import Sensors as Senses
from sim.session import Beat, Session
from sim.world import SUBSTEP, NotPossible, World

SUBSTEPS = 4
TICK_S = SUBSTEP * SUBSTEPS
MAX_LATE_S = 1.0
MAX_SESSIONS = 64
MAX_RATE = 1.0 / TICK_S


class Yard:
    """One yard; ``start`` lets its time run on ``clock``, ``attach`` takes a connection.

    The truth is in ``world``; whoever referees may look there, or ask as an operator over a link.
    """

    def __init__(self, clock: IReactorTime, rng: Random, scene: Scene) -> None:
        self._clock = clock
        self.world = World(Random(rng.getrandbits(64)), scene)
        self._camera = Camera(Random(rng.getrandbits(64)), self.world)
        self._senses = {
            name: Senses(Random(rng.getrandbits(64)), self.world, dog) for name, dog in self.world.dogs.items()
        }
        self._reception = Reception(self.world.dogs, self.world, self._now, MAX_SESSIONS, self._on_operator)
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
        return [name for name in self.world.dogs if name in self._reception.holders]

    def truth(self) -> dict[str, object]:
        """The whole yard as seen from above, and of each dog what its gate has let through and refused."""
        snapshot = self.world.snapshot()
        gates = self._reception.gates.values()
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
        self._reception.close()

    def attach(self, link: Link) -> Session:
        """Take a new connection; what arrives on it goes to the session that is returned."""
        return self._reception.attach(link)

    def lend(self, name: str, limits: Mapping[str, tuple[float, float]]) -> DogBody:
        """Hand a dog over to an emulator, which moves it within ``limits`` from now on; no driver may hold it here.

        Raises ``UsageError`` where there is no such dog.
        """
        self._reception.lend(name)
        dog = self.world.dogs[name]
        dog.limits = limits
        return DogBody(self.world, dog, self._senses[name], self._camera)

    def learn(self, verb: str, work: Callable[..., None], kinds: tuple[type, ...]) -> None:
        """Have operators order ``verb`` as well, with arguments of ``kinds``."""
        self._orders[verb] = (work, kinds)

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
            self._reception.halt()
        due = 1 + max(0, math.floor(late / TICK_S + 1e-6))
        for left in range(due - 1, -1, -1):
            # A late yard drops pictures, never physics.
            self._tick(with_pictures=left == 0)
        self._schedule()

    def _tick(self, with_pictures: bool) -> None:
        for _ in range(SUBSTEPS):
            self._reception.expire(self.world.t)
            self.world.step()
            for senses in self._senses.values():
                senses.sample()
        self._ticks += 1
        self._report(with_pictures)
        self._reception.drop_silent()

    def _report(self, with_pictures: bool) -> None:
        t = self.world.t
        for name, senses in self._senses.items():
            values, samples = senses.values(), senses.taken_samples()
            picture = partial(self._camera.jpeg, self.world.dogs[name]) if with_pictures else None
            self._reception.tell(name, t, values, samples, picture)
        sessions = self._reception.sessions
        watchers = [one for one in sessions if one.is_operator and one.truths.is_due(t) and not one.link.is_busy]
        if watchers:
            truth = Truth(self.truth())
            for session in watchers:
                session.send(truth)

    def _on_operator(self, session: Session, message: Message) -> None:
        match message:
            case Overlook():
                session.is_operator = message.version == VERSION
                session.truths = Beat(min(max(message.rate, 0.1), MAX_RATE))
            case Order() if session.is_operator:
                session.send(Done(message.number, self._carried_out(message)))
            case _:
                pass

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
