"""Tests of ``swarm driver`` with an emulated Aibo in memory: list, info, probe, drive, monitor."""

from __future__ import annotations

import contextlib
import io
import json
import random
import sys
from pathlib import Path

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from drivers.driver import Permit
from drivers.registry import create_driver, list_kinds
from sim.robots.emulator.aibo_dog import AiboEmulator
from sim.robots.emulator.simulated_robot import MemoryRobot
from swarmnode.driver.command import main
from swarmnode.driver.keyboard import KeyboardController
from tests.swarmnode.driver.environment import MemoryEnvironment
from tests.webnode.picture import jpeg

JPEG = jpeg()
ROBOT = "--kind aibo --option host=dog1"
BLIND = f"{ROBOT} --option camera=false"


class DriverCommandTests(SynchronousTestCase):
    def setUp(self) -> None:
        """Start an emulated Aibo in virtual time."""
        self.clock = Clock()
        self.body = MemoryRobot(jpeg=JPEG, values={"power.level": 0.8, "range.near": 0.25})
        self.dog = AiboEmulator(self.clock, self.body, random.Random(1))
        self.dog.start()
        self.connector = self.dog.connector()
        self.speeds: list[tuple[float, float, float]] = []
        self.ground = MemoryEnvironment(self.clock, self.connector, self.pass_time)

    def tearDown(self) -> None:
        """After each command the robot stands still with disabled motors, and no timer remains."""
        for _ in range(100):
            self.clock.advance(0.01)
        self.assertEqual((self.body.motion, self.dog.is_engaged), ((0.0, 0.0, 0.0), True))
        self.dog.stop()
        self.clock.advance(0.1)
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def pass_time(self, seconds: float) -> None:
        self.body.advance(seconds)
        self.speeds.append((round(self.clock.seconds(), 3), *self.body.motion[::2]))

    def moving(self, began: float, ended: float) -> list[float]:
        """Return the forward speeds of the robot between two times."""
        return [vx for at, vx, _ in self.speeds if began <= at <= ended]

    def test_list_names_every_kind(self) -> None:
        """Every kind is listed, in text and in JSON."""
        code, output, _ = self.ground.swarm_driver("list")
        self.assertEqual(code, 0)
        told = {line.split()[0] for line in output.splitlines() if not line.startswith(" ")}
        self.assertLessEqual(set(list_kinds()), told)
        entries = json.loads(self.ground.swarm_driver("list --json")[1])
        self.assertEqual([entry["kind"] for entry in entries], list_kinds())

    def test_info_describes_before_connecting(self) -> None:
        """Without a connection, limits with units, skills and rates are printed for a kind or a node's settings."""
        code, output, _ = self.ground.swarm_driver("info aibo")
        self.assertEqual(code, 0)
        self.assertRegex(output, r"base\.vx +-0\.156 to \+0\.16 m/s")
        self.assertIn("look play howl", output)
        told = json.loads(self.ground.swarm_driver("info camera --option source=./pictures --json")[1])
        self.assertEqual((told["limits"], told["capabilities"]["camera"]["width"]), ({}, 320))
        file = Path(self.mktemp())
        file.write_text('[node]\nname = "dog1"\n[driver]\nkind = "aibo"\noptions = {host = "dog1", camera = false}\n')
        told = json.loads(self.ground.swarm_driver(f"info {file} --json")[1])
        self.assertNotIn("camera", told["capabilities"])
        with file.open("a") as more:
            more.write('[[driver.parts]]\nkind = "compass"\noptions = {host = "compass1"}\n')
        told = json.loads(self.ground.swarm_driver(f"info {file} --json")[1])
        self.assertIn("compass", told["capabilities"])

    def test_probe_says_what_came(self) -> None:
        """A probe reports the time to the first observation, the rate, dialect, battery and invalid frames."""
        code, output, complaint = self.ground.swarm_driver(f"probe {ROBOT}")
        self.assertEqual((code, complaint), (0, ""))
        self.assertRegex(output, r"first observation after 0\.\d\d s")
        self.assertRegex(output, r"rate +31\.\d of 31\.25 per second")
        for told in ("mode          T4", "power.level   80 %", "104 x 80 jpeg", "bad frames    0 of ", "range.near"):
            self.assertIn(told, output)
        self.assertNotIn("!", output)
        self.assertEqual({speed[1:] for speed in self.speeds}, {(0.0, 0.0)})
        finding = json.loads(self.ground.swarm_driver(f"probe {BLIND} --seconds 1 --json")[1])
        self.assertEqual((finding["is_there"], finding["readings"]["mode"]), (True, "T4"))

    def test_probe_names_what_is_wrong(self) -> None:
        """A probe of a robot that is off exits with code 1, and prints the problem of the link or the driver."""
        self.connector.is_open = False
        self.ground.problems = ["dog1:10020: it does not answer; is it switched on?"]
        code, output, _ = self.ground.swarm_driver(f"probe {BLIND}")
        self.assertEqual((code, self.clock.seconds() < 4.0), (1, True))
        self.assertIn("not reached\n  ! dog1:10020: it does not answer; is it switched on?\n", output)
        self.ground.problems = []
        code, output, _ = self.ground.swarm_driver(f"probe {BLIND}")
        self.assertEqual(code, 1)
        self.assertIn("its main server at dog1:10020 does not answer; is it on, and does no other client", output)

    def test_probe_sees_a_slow_and_spoilt_robot(self) -> None:
        """A probe reports that world states are lost."""
        self.dog.faults.drop = 0.5
        _, output, _ = self.ground.swarm_driver(f"probe {BLIND}")
        self.assertIn("! the robot is slow", output)

    def test_probe_is_interrupted_in_order(self) -> None:
        """Ctrl-C ends a probe with the results so far."""
        self.ground.interrupted_at = 1.0
        code, output, _ = self.ground.swarm_driver(f"probe {BLIND} --seconds 30")
        self.assertEqual((code, self.clock.seconds() < 1.5), (0, True))
        self.assertIn("first observation", output)

    def test_drive_by_keys(self) -> None:
        """A held key moves the robot at 30 % speed; 0.4 s after its release the robot stands still.

        The key x ends the drive.
        """
        held = [(1.0 + 0.1 * n, "w") for n in range(10)]
        self.ground.keys = [*held, (3.0, "a"), (3.1, "w"), (4.0, "+"), (4.1, "s"), (4.2, " "), (5.0, "x")]
        code, _, complaint = self.ground.swarm_driver(f"drive {BLIND}")
        self.assertEqual((code, complaint), (0, ""))
        self.assertTrue(all(abs(vx - 0.3 * 0.16) < 0.002 for vx in self.moving(1.05, 2.25)))
        self.assertEqual(set(self.moving(2.36, 3.05)), {0.0})
        turning = [(vx > 0.0, wz > 0.0) for at, vx, wz in self.speeds if 3.15 <= at <= 3.35]
        self.assertEqual(set(turning), {(True, True)})
        last = [(vx > 0.0, wz > 0.0) for at, vx, wz in self.speeds if 3.45 <= at <= 3.48]
        self.assertEqual(set(last), {(True, False)})
        self.assertTrue(all(abs(vx + 0.4 * 0.156) < 0.002 for vx in self.moving(4.13, 4.19)))
        self.assertEqual(set(self.moving(4.25, 5.5)), {0.0})
        terminal = self.ground.terminals[0]
        self.assertGreater(terminal.closed, 0)
        lines = [line for at, line in terminal.lines if 1.2 < at < 1.9]
        self.assertTrue(all("ready" in line and "vx +0.05" in line and "battery 80 %" in line for line in lines), lines)
        self.assertTrue(any("near 0.25 m" in line for line in lines))

    def test_drive_ends_at_rest_however_it_ends(self) -> None:
        """The end of the input, Ctrl-C and the key x all end the drive: the robot stands still with disabled motors."""
        for ending in ([(1.2, "")], [(1.2, "\x04")], []):
            began = self.clock.seconds()
            self.ground.keys = [(1.0, "w"), *ending]
            self.ground.interrupted_at = None if ending else began + 1.2
            self.assertEqual(self.ground.swarm_driver(f"drive {BLIND}")[0], 0)
            self.assertTrue(any(self.moving(began + 1.05, began + 1.19)))
            self.assertEqual((self.body.motion, self.dog.is_engaged), ((0.0, 0.0, 0.0), True))

    def test_drive_says_why_it_does_not_move(self) -> None:
        """The status line shows that the motors were switched off at the robot; the key m enables them again."""
        self.ground.keys = [(1.5, "w"), (2.0, "m"), (3.0, "w"), (4.0, "x")]
        self.clock.callLater(1.0, self.dog.press_back_button)
        self.ground.swarm_driver(f"drive {BLIND}")
        lines = self.ground.terminals[0].lines
        self.assertTrue(any("motors are off; call enable() first" in line for at, line in lines if 1.5 < at < 1.7))
        self.assertTrue(any("motors off (m)" in line for at, line in lines if 1.2 < at < 1.5))
        self.assertTrue(any(self.moving(3.05, 3.3)))

    def test_drive_is_refused_by_name(self) -> None:
        """A missing terminal, an immobile robot, no robot and two robots each give one error line and exit code 2."""
        for words, told in (
            (["drive", *BLIND.split()], "is not a terminal"),
            (["drive", "--kind", "camera"], "a robot of kind camera does not move"),
            (["drive"], "no robot is selected"),
            (["probe", "--kind", "aibo", "--config", "x.toml"], "only one of them"),
            (["probe", "--kind", "warp"], "known are aibo"),
            (["probe", "--kind", "aibo"], "option host is missing"),
            (["probe", "--kind", "aibo", "--option", "host"], "KEY=VALUE"),
            (["probe", "--option", "host=x"], "--option needs --kind"),
            (["monitor", "--config", "/no/such/file.toml"], "cannot be read"),
        ):
            with self.subTest(words=words):
                self.patch(sys, "stdin", io.StringIO())
                complaint = self.complaint(words)
                self.assertIn(told, complaint)
                self.assertEqual(complaint.count("\n"), 1)

    def complaint(self, words: list[str]) -> str:
        """Run an invalid command; return its error message."""
        said = io.StringIO()
        with contextlib.redirect_stderr(said):
            self.assertEqual(main(words, io.StringIO()), 2)
        return said.getvalue()

    def test_monitor_shows_and_saves(self) -> None:
        """Sensor values with units are printed every second, and the newest picture is saved as a complete file."""
        picture = Path(self.mktemp())
        code, output, _ = self.ground.swarm_driver(f"monitor {ROBOT} --seconds 2 --picture {picture}")
        self.assertEqual((code, picture.read_bytes()), (0, JPEG))
        self.assertEqual(output.count("ready, "), 3)
        self.assertRegex(output, r"range\.near +0\.250 m\n")
        self.assertRegex(output, r"range\.far +nothing in range\n")
        lines = self.ground.swarm_driver(f"monitor {ROBOT} --seconds 2 --json")[1].splitlines()
        self.assertEqual({json.loads(line)["values"]["range.near"] for line in lines}, {0.25})
        self.assertIsNone(json.loads(lines[0])["values"]["range.far"])

    def test_monitor_says_what_it_lacks(self) -> None:
        """A missing picture, an unwritable file and an unreachable robot are reported, and the exit code is 1."""
        code, output, _ = self.ground.swarm_driver(f"monitor {BLIND} --seconds 1 --picture {self.mktemp()}")
        self.assertEqual((code, "! no picture received" in output), (1, True))
        code, output, _ = self.ground.swarm_driver(f"monitor {ROBOT} --seconds 5 --picture /no/such/folder/x.jpg")
        self.assertEqual((code, "! cannot write /no/such/folder/x.jpg" in output), (1, True))
        self.connector.is_open = False
        code, output, _ = self.ground.swarm_driver(f"monitor {BLIND}")
        self.assertEqual((code, "! no data within 8 s" in output), (1, True))

    def test_pilot_speaks_with_the_robots_own_token(self) -> None:
        """A robot that accepted token 7 is driven with token 7, because a higher token would lock out the team."""
        driver = create_driver("aibo", {"host": "dog1", "camera": False}, "dog1", self.clock, self.connector)
        driver.connect()
        self.turn(1.0)
        driver.enable()
        self.turn(0.3)
        driver.act({}, Permit(7, self.clock.seconds() + 0.5))
        controller = KeyboardController(driver)
        self.assertTrue(controller.press("w", self.clock.seconds()))
        self.assertEqual((controller.message, driver.token, controller.is_moving), ("", 7, True))
        self.assertFalse(controller.press("x", self.clock.seconds()))
        self.assertEqual(controller.last_motion["base.vx"], 0.0)
        driver.disconnect()

    def turn(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.005)):
            self.clock.advance(0.005)
