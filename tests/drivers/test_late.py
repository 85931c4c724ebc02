"""Tests that no driver repeats a motion after its deadline, even if its timers are late.

After a pause of the process all timers are overdue, and run in the order of their times: the timer that repeats a
motion runs before the timer that ends it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from random import Random
from typing import Any

from drivers.driver import Driver
from drivers.link import MemoryConnector
from sim.robots.emulator.aibo_dog import AiboEmulator
from sim.robots.emulator.bittle import Bittle
from sim.robots.emulator.create2 import Create2
from sim.robots.emulator.rosbridge import RosbridgeRobot
from sim.robots.emulator.simulated_robot import MemoryRobot
from swarmnode.driver.environment import WarningCollector
from tests.drivers.contract import RobotCase

FROZEN_S = 2.0


@dataclass
class WatchedRobot(MemoryRobot):
    """A base that records its velocities."""

    told: list[tuple[float, float, float]] = field(default_factory=list)

    def drive(self, vx: float, vy: float, wz: float) -> None:
        self.told.append((vx, vy, wz))
        super().drive(vx, vy, wz)


class LateTests(RobotCase):
    """For each robot that does not check deadlines itself, the process pauses after a command."""

    def build(self) -> None:
        """Create the base that records its velocities."""
        self.body = self.watched = WatchedRobot()

    def tearDown(self) -> None:
        """Skip the check of the base class, because the robots are still running."""

    def enabled(self, kind: str, connector: Any, settle: float = 1.0, **options: object) -> Driver:
        self.kind, self.connector = kind, connector
        driver: Driver = self.ready(settle, **options)
        return driver

    def freeze(self, driver: Driver, permitted: float, before: float = 0.0) -> None:
        """Permit a motion, pause the process beyond the deadline, and check that only zero velocities follow."""
        driver.act({"base.vx": 0.1}, self.permit(seconds=permitted))
        self.pass_time(before)
        self.watched.told.clear()
        self.clock.advance(FROZEN_S)
        self.pass_time(2.5)
        self.assertEqual([one for one in self.watched.told if any(one)], [])
        self.assertEqual(self.body.motion, (0.0, 0.0, 0.0))

    def test_aibo(self) -> None:
        """The walk command, which the driver repeats every half second, is not repeated after its deadline."""
        for phase in range(10):
            self.setUp()
            dog = AiboEmulator(self.clock, self.body, Random(1))
            dog.start()
            self.freeze(
                self.enabled("aibo", dog.connector(), host="dog", camera=False), 0.7, 0.4 + 2 * phase * self.STEP_S
            )

    def test_rosbridge(self) -> None:
        """The velocity, which the driver publishes ten times per second, is not published after its deadline."""
        robot = RosbridgeRobot(self.clock, self.body, Random(1))
        robot.start()
        connector = MemoryConnector(self.clock, robot.accept)
        self.freeze(self.enabled("rosbridge", connector, host="robot"), 0.5, before=0.12)

    def test_create2(self) -> None:
        """After the deadline only the halt is sent."""
        robot = Create2(self.body, self.clock, Random(1))
        connector = MemoryConnector(self.clock, robot.accept)
        self.freeze(self.enabled("create2", connector, port="memory"), 0.5, before=0.1)

    def test_silence_of_a_frozen_node_is_not_the_robots(self) -> None:
        """After a pause of the node, the driver does not take an active robot for a silent one."""
        collector = WarningCollector()
        self.addCleanup(collector.close)
        for phase in range(5):
            self.setUp()
            vacuum, dog = Create2(self.body, self.clock, Random(1)), AiboEmulator(self.clock, self.body, Random(1))
            bridge = RosbridgeRobot(self.clock, self.body, Random(1))
            dog.start()
            bridge.start()
            drivers = [
                self.enabled("create2", MemoryConnector(self.clock, vacuum.accept), port="memory"),
                self.enabled("aibo", dog.connector(), host="dog", camera=False),
                self.enabled("rosbridge", MemoryConnector(self.clock, bridge.accept), host="robot"),
            ]
            for _ in range(2):
                self.pass_time(1.0 + 0.06 * phase)
                self.clock.advance(10.0)
                self.pass_time(0.1)
                self.assertEqual(
                    [(one.state, one.diagnostics()["reconnects"]) for one in drivers], [("ready", 0.0)] * 3
                )
        self.assertEqual(collector.warnings, [])

    def test_bittle_without_an_answer(self) -> None:
        """A gait to which the robot has not replied is not requested again after its deadline."""
        robot = Bittle(self.body, self.clock, Random(1))
        driver = self.enabled("bittle", MemoryConnector(self.clock, robot.accept), port="memory")
        robot.faults.half_open = True
        self.freeze(driver, 1.2, before=0.1)

    def test_bittle_over_wifi(self) -> None:
        """A gait that waits for an earlier request or for a connection is not sent after its deadline."""
        for board in ("biboard", "nyboard"):
            for phase in range(30):
                self.setUp()
                robot = Bittle(self.body, self.clock, Random(1), board=board)
                connector = MemoryConnector(self.clock, robot.accept_http)
                driver = self.enabled("bittle", connector, 1.5, host="10.0.0.5", board=board)
                self.pass_time(phase * self.STEP_S)
                self.freeze(driver, 0.5)
