"""Tests of ``drivers.pyro`` with a brain on another thread, and of the examples as commands."""

from __future__ import annotations

import subprocess
import sys
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

from twisted.internet import reactor as running
from twisted.internet.defer import Deferred
from twisted.internet.task import deferLater
from twisted.internet.threads import blockingCallFromThread, deferToThread
from twisted.trial.unittest import SynchronousTestCase, TestCase

from drivers.pyro.robot import PyroRobot
from drivers.registry import create_driver
from sim.robots.emulator.aibo_dog import AiboEmulator
from sim.robots.emulator.simulated_robot import MemoryRobot
from tests.live.until import until

ROOT = Path(__file__).parents[2]
reactor: Any = running


class ThreadTests(TestCase):
    timeout = 20

    def test_brain_on_a_thread_of_its_own(self) -> Deferred[None]:
        """A plain script on another thread connects, drives, reads and disconnects with blocking calls."""
        body = MemoryRobot()
        dog = AiboEmulator(reactor, body, Random(1))
        dog.start()
        driver = create_driver("aibo", {"host": "dog", "camera": False}, "dog", reactor, dog.connector())
        robot = PyroRobot(driver, reactor, partial(blockingCallFromThread, reactor))

        def moves() -> bool:
            robot.update()
            return body.motion[0] != 0.0

        def script() -> tuple[Any, Any, Any]:
            robot.connect()
            robot.move(0.5, 0.0)
            until(moves)
            moving = body.motion
            level = robot.battery[0].level
            robot.stop()
            robot.disconnect()
            return moving, level, driver.state

        def told(result: tuple[Any, Any, Any]) -> None:
            self.assertEqual(result, ((0.08, 0.0, 0.0), 1.0, "closed"))

        def end(result: Any) -> Any:
            dog.stop()
            # The links in memory end a moment later.
            return deferLater(reactor, 0.05, lambda: result)

        done: Deferred[None] = deferToThread(script).addCallback(told).addBoth(end)
        return done


class CommandTests(SynchronousTestCase):
    def test_examples_run_as_commands(self) -> None:
        """Each of the two brains runs as a command for a second, prints the robot's devices, and ends without error."""
        for name in ("avoid", "track_ball"):
            done = subprocess.run(
                [sys.executable, f"examples/pyro/{name}.py", "--seconds", "1"],
                cwd=ROOT,
                env={"PYTHONPATH": str(ROOT)},
                capture_output=True,
                text=True,
                timeout=60,
            )
            self.assertEqual((done.returncode, done.stderr), (0, ""), name)
            self.assertIn("aibo-ers7: has battery, camera, ir", done.stdout)
