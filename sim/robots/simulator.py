"""The robot simulator: the world with its sensors and cameras, connected to drivers and operators."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from random import Random
from typing import Any

from twisted.internet.interfaces import IReactorTime

from drivers.sim.codec import VERSION, CommandResult, Message, SubscribeWorld, WorldCommand, WorldSnapshot
from sim.robots.camera import Camera
from sim.robots.emulator.dog import SimulatedDog
from sim.robots.paced_simulator import PacedSimulator, PeriodicTimer, Session
from sim.robots.scene import Scene
from sim.robots.sensor import Sensors as Senses
from sim.robots.world import SUBSTEPS, TICK_S, NotPossible, World

MAX_SESSIONS = 64
MAX_RATE_HZ = 1.0 / TICK_S


class RobotSimulator(PacedSimulator):
    """The simulator of a ``scene``.

    ``world`` is the true state: tests may read it directly, and operators receive it over a link.
    """

    def __init__(self, clock: IReactorTime, rng: Random, scene: Scene) -> None:
        self.world = World(Random(rng.getrandbits(64)), scene)
        self._camera = Camera(Random(rng.getrandbits(64)), self.world)
        self._sensors = {
            name: Senses(Random(rng.getrandbits(64)), self.world, dog) for name, dog in self.world.dogs.items()
        }
        super().__init__(clock, self.world.dogs, self.world, MAX_SESSIONS)
        self._orders: dict[str, tuple[Callable[..., None], tuple[type, ...]]] = {
            "place_target": (self.world.place_target, (float, float)),
            "place_target_at_random": (self.world.place_target_at_random, ()),
            "place_target_later": (self.world.place_target_later, (float,)),
            "clear_target": (self.world.clear_target, ()),
            "move_dog": (self.world.move_dog, (str, float, float, float)),
            "scatter": (self.world.scatter, (int,)),
        }

    def get_true_state(self) -> dict[str, object]:
        """Return the true state, including the numbers of commands that each dog's gate accepted and refused."""
        snapshot = self.world.snapshot()
        counts = [
            {"token": gate.token or 0, "accepted": gate.accepted, "refused": sum(gate.refused.values())}
            for gate in self._gates.values()
        ]
        dogs: Any = snapshot["dogs"]
        return {**snapshot, "dogs": [{**dog, **count} for dog, count in zip(dogs, counts, strict=True)]}

    def reserve_for_emulator(self, name: str, limits: Mapping[str, tuple[float, float]]) -> SimulatedDog:
        """Reserve a dog for an emulator, which moves the dog within ``limits``; drivers can no longer use the dog.

        Raises ``UsageError`` if the dog does not exist.
        """
        self._reserve_robot(name)
        dog = self.world.dogs[name]
        dog.limits = limits
        return SimulatedDog(self.world, dog, self._sensors[name], self._camera)

    def add_order(self, verb: str, work: Callable[..., None], kinds: tuple[type, ...]) -> None:
        """Add the operator's command ``verb``, with arguments of the types ``kinds``."""
        self._orders[verb] = (work, kinds)

    def _simulate(self, late: float) -> int:
        due = 1 + max(0, math.floor(late / TICK_S + 1e-6))
        for left in range(due - 1, -1, -1):
            # A late simulator skips pictures, but never a step of the physics.
            self._tick(with_pictures=left == 0)
        return due

    def _tick(self, with_pictures: bool) -> None:
        for _ in range(SUBSTEPS):
            self._stop_expired(self.world.t)
            self.world.step()
            for senses in self._sensors.values():
                senses.sample()
        self._report(with_pictures)
        self._drop_silent()

    def _report(self, with_pictures: bool) -> None:
        t = self.world.t
        for name, senses in self._sensors.items():
            values, samples = senses.values(), senses.pop_samples()
            picture = partial(self._camera.render_jpeg, self.world.dogs[name]) if with_pictures else None
            self._report_sensors(name, t, values, samples, picture)
        operators = [
            one for one in self._sessions if one.is_operator and one.state_timer.is_due(t) and not one.link.is_busy
        ]
        if operators:
            truth = WorldSnapshot(self.get_true_state())
            for session in operators:
                session.send(truth)

    def _on_other(self, session: Session, message: Message) -> None:
        match message:
            case SubscribeWorld():
                session.is_operator = message.version == VERSION
                session.state_timer = PeriodicTimer(min(max(message.rate, 0.1), MAX_RATE_HZ))
            case WorldCommand() if session.is_operator:
                session.send(CommandResult(message.number, self._execute(message)))

    def _execute(self, order: WorldCommand) -> str:
        """Execute the operator's command; return the problem, or an empty string."""
        if order.verb not in self._orders:
            return f"unknown command {order.verb!r}; known are {', '.join(self._orders)}"[:200]
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
