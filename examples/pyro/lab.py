"""The lab of the two brains: a robot to drive, or a yard of its own with an emulated AIBO in it."""

from __future__ import annotations

import argparse
import random
from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.internet.task import LoopingCall

from drivers.driver import Driver
from drivers.errors import UsageError
from drivers.pyro.brain import Brain, Engine
from drivers.pyro.robot import PyroRobot
from drivers.registry import driver_for, kinds
from sim.robots.camera import Camera
from sim.robots.emulator.aibo_dog import AiboEmulator
from sim.robots.emulator.dog import DogBody
from sim.robots.scene import loaded
from sim.robots.sensor import Sensors
from sim.robots.world import SUBSTEP, World

STEPS = 2


class Pen:
    """A yard with a red target and an emulated AIBO, which is its first dog; ``seed`` says where they stand."""

    def __init__(self, clock: IReactorTime, seed: int = 1) -> None:
        self.world = World(random.Random(seed), loaded("three-dogs"))
        self.world.scatter(seed)
        self.world.place_target_at_random()
        self.dog = self.world.dogs["dog1"]
        self._senses = Sensors(random.Random(seed + 1), self.world, self.dog)
        camera = Camera(random.Random(seed + 2), self.world)
        self._clock = clock
        body = DogBody(self.world, self.dog, self._senses, camera)
        self._emulator = AiboEmulator(clock, body, random.Random(seed + 3))
        self._loop = LoopingCall.withCount(self._turn)
        self._loop.clock = clock

    def start(self) -> None:
        """Switch the dog on, and let time run."""
        self._loop.start(STEPS * SUBSTEP)
        self._emulator.start()

    def stop(self) -> None:
        """Switch it off."""
        self._emulator.stop()
        self._loop.stop()

    def driver(self) -> Driver:
        """A driver of the dog, joined through memory."""
        return driver_for("aibo", {"host": "pen"}, "pen", self._clock, self._emulator.connector())

    def _turn(self, count: int) -> None:
        for _ in range(min(count, 100) * STEPS):
            self.world.step()
            self._senses.sample()


def main(init: Callable[[Engine], Brain], about: str) -> None:
    """Run a brain from the command line until it quits, its seconds are over, or Ctrl-C; the robot stands then."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--kind", default="aibo", choices=kinds(), help="the kind of robot (default %(default)s)")
    parser.add_argument("--host", help="where it is; without it, and no options: an emulated AIBO in this process")
    parser.add_argument("--option", action="append", default=[], metavar="KEY=VALUE", help="another of its options")
    parser.add_argument("--seconds", type=float, default=30.0, help="how long to run (default %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of the yard in this process (default %(default)s)")
    chosen = parser.parse_args()

    from twisted.internet import reactor as running

    from middleware.entangled.clock import use_monotonic_time

    use_monotonic_time()
    reactor: Any = running
    options: dict[str, object] = {} if chosen.host is None else {"host": chosen.host}
    for text in chosen.option:
        key, _, value = text.partition("=")
        options[key] = int(value) if value.isdigit() else value
    if options or chosen.kind != "aibo":
        try:
            driver = driver_for(chosen.kind, options, "lab", reactor)
        except UsageError as error:
            parser.error(str(error))
    else:
        pen = Pen(reactor, chosen.seed)
        pen.start()
        driver = pen.driver()
    robot = PyroRobot(driver, reactor)
    engine = Engine(robot, reactor)

    async def play() -> None:
        await robot.connect()
        print(f"{robot.type}: has {', '.join(robot.devices)}; Ctrl-C ends it", flush=True)
        reactor.callLater(chosen.seconds, engine.stop)
        await engine.run(init)

    def over(failure: Any = None) -> None:
        if failure is not None:
            print(failure.getErrorMessage())
        if reactor.running:
            reactor.stop()

    reactor.addSystemEventTrigger("before", "shutdown", driver.disconnect)
    playing: Deferred[None] = Deferred.fromCoroutine(play())
    playing.addCallbacks(lambda _: over(), over)
    reactor.run()
