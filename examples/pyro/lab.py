"""Common code of the two brains: connect to a robot, or simulate a world with an emulated AIBO."""

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
from drivers.registry import create_driver, list_kinds
from sim.robots.camera import Camera
from sim.robots.emulator.aibo_dog import AiboEmulator
from sim.robots.emulator.dog import SimulatedDog
from sim.robots.scene import load_scene
from sim.robots.sensor import Sensors
from sim.robots.world import SUBSTEP_S, World

STEPS = 2


class Pen:
    """A simulated world with a red target, whose first dog is an emulated AIBO; ``seed`` determines the positions."""

    def __init__(self, clock: IReactorTime, seed: int = 1) -> None:
        self.world = World(random.Random(seed), load_scene("three-dogs"))
        self.world.scatter(seed)
        self.world.place_target_at_random()
        self.dog = self.world.dogs["dog1"]
        self._sensors = Sensors(random.Random(seed + 1), self.world, self.dog)
        camera = Camera(random.Random(seed + 2), self.world)
        self._clock = clock
        body = SimulatedDog(self.world, self.dog, self._sensors, camera)
        self._emulator = AiboEmulator(clock, body, random.Random(seed + 3))
        self._loop = LoopingCall.withCount(self._on_tick)
        self._loop.clock = clock

    def start(self) -> None:
        """Start the simulation and the emulated dog."""
        self._loop.start(STEPS * SUBSTEP_S)
        self._emulator.start()

    def stop(self) -> None:
        """Stop the simulation and the emulated dog."""
        self._emulator.stop()
        self._loop.stop()

    def driver(self) -> Driver:
        """Return a driver of the dog, connected in memory."""
        return create_driver("aibo", {"host": "pen"}, "pen", self._clock, self._emulator.connector())

    def _on_tick(self, count: int) -> None:
        for _ in range(min(count, 100) * STEPS):
            self.world.step()
            self._sensors.sample()


def main(init: Callable[[Engine], Brain], about: str) -> None:
    """Run a brain until it quits, ``--seconds`` pass or Ctrl-C is pressed; then stop the robot."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--kind", default="aibo", choices=list_kinds(), help="the kind of robot (default %(default)s)")
    parser.add_argument("--host", help="address of the robot; without options an emulated AIBO runs in this process")
    parser.add_argument(
        "--option", action="append", default=[], metavar="KEY=VALUE", help="an option of the driver; repeatable"
    )
    parser.add_argument("--seconds", type=float, default=30.0, help="duration of the run (default %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="random seed of the simulated world (default %(default)s)")
    args = parser.parse_args()

    from twisted.internet import reactor as running

    from middleware.entangled.clock import use_monotonic_time

    use_monotonic_time()
    reactor: Any = running
    options: dict[str, object] = {} if args.host is None else {"host": args.host}
    for text in args.option:
        key, _, value = text.partition("=")
        options[key] = int(value) if value.isdigit() else value
    if options or args.kind != "aibo":
        try:
            driver = create_driver(args.kind, options, "lab", reactor)
        except UsageError as error:
            parser.error(str(error))
    else:
        pen = Pen(reactor, args.seed)
        pen.start()
        driver = pen.driver()
    robot = PyroRobot(driver, reactor)
    engine = Engine(robot, reactor)

    async def play() -> None:
        await robot.connect()
        print(f"{robot.type}: has {', '.join(robot.devices)}; press Ctrl-C to stop", flush=True)
        reactor.callLater(args.seconds, engine.stop)
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
