"""Tests of ``swarmnode.faults`` and ``middleware.faults.scenario``: injected faults and the reports on them."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.errors import BadSetting
from middleware.faults.kinds import Fault
from middleware.faults.scenario import load_scenario, parse_scenario
from swarmnode.faults import main
from swarmnode.simulated_team import SimulatedTeam
from tests.swarmnode.shell import Shell, runtime_folder

SCENARIOS = Path(__file__).parents[2] / "examples" / "scenarios"


class ChaosTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.folder = runtime_folder(self)

    def team(self, faults: bool = True) -> None:
        """Start a team, and a shell on its laptop."""
        self.virtual = SimulatedTeam(4, faults=faults)
        self.addCleanup(self.virtual.stop)
        self.virtual.clock.advance(2.0)
        self.shell = Shell(self.virtual, self.virtual.services["vaio"].assembly.node)

    def chaos(self, line: str) -> tuple[int, str]:
        """Run ``swarm faults LINE`` in virtual time; return exit code and output."""
        clock = self.virtual.clock

        def command(words: list[str], out: Any, ask: Any) -> int:
            return main(words, out, ask, clock.seconds, clock.advance)

        return self.shell.run(command, line.split())

    def test_one_fault(self) -> None:
        """After a fault in the acting device, its successor and the takeover time are printed; the exit code is 0."""
        self.team()
        self.virtual.control.assign("turn-around")
        code, output = self.chaos("executing radio --seconds 4")
        first, second = output.splitlines()
        self.assertRegex(first, r"^dog\d: radio for 4 s$")
        self.assertRegex(second, r"^dog\d: radio, dog\d took over [0-9a-f]{12} after [12]\.\d\d s$")
        self.assertEqual((code, self.shell.said), (0, ""))
        self.assertIn("dog1        kill, freeze, radio, one-way, delay, loss, skew, battery", self.chaos("list")[1])

    def test_not_allowed(self) -> None:
        """For a device that does not allow faults, the error contains the setting that allows them."""
        self.team(faults=False)
        code, output = self.chaos("dog1 loss")
        self.assertEqual((code, output), (1, ""))
        self.assertIn('dog1: fault injection is off; set "allow = true" in [faults]', self.shell.said)

    def test_wrong_words(self) -> None:
        """An unknown kind, an invalid amount and an unknown device each give one error line with a remedy."""
        self.team()
        for line, code, said in (
            ("dog1 fly", 2, "there is no fault 'fly'; choose one of kill, freeze"),
            ("dog1 loss --amount 2", 2, "amount: 2.0 is out of range; it must be from 0 to 1"),
            ("cat1 loss", 1, "no device has the name cat1 within 60 s; present devices: vaio, dog1, dog2, dog3"),
            ("run nowhere.toml", 2, "nowhere.toml: cannot be read"),
        ):
            self.assertEqual(self.chaos(line)[0], code, line)
            self.assertIn(said, self.shell.said)

    def rehearsed(self, name: str, *words: str) -> list[str]:
        """Run a scenario in a simulated team, which must succeed; return its output lines."""
        output = io.StringIO()
        code = main(["run", str(SCENARIOS / name), "--rehearse", *words], output)
        self.assertEqual(code, 0, output.getvalue())
        return output.getvalue().splitlines()

    def test_same_seed_same_run(self) -> None:
        """A simulated scenario gives the same lines and digest twice; a different seed gives a different run."""
        first = self.rehearsed("takeover.toml")
        self.assertEqual(sum("took over" in line for line in first), 2)
        self.assertEqual(self.rehearsed("takeover.toml"), first)
        self.assertNotEqual(self.rehearsed("takeover.toml", "--seed", "8")[-1], first[-1])

    def test_bad_day(self) -> None:
        """Despite packet loss and a wrong clock, two devices are replaced in time."""
        lines = self.rehearsed("bad-day.toml")
        self.assertEqual(sum("took over" in line for line in lines), 2)
        for seed in ("12", "24"):  # with these seeds the first reply is lost
            self.rehearsed("bad-day.toml", "--seed", seed)


class ScenarioTests(SynchronousTestCase):
    def test_examples(self) -> None:
        """Each example scenario is valid, and its steps are in chronological order."""
        files = sorted(SCENARIOS.glob("*.toml"))
        self.assertGreater(len(files), 1)
        for file in files:
            steps = load_scenario(file).steps
            self.assertEqual([step.at for step in steps], sorted(step.at for step in steps))

    def test_short(self) -> None:
        """By default a step starts immediately, affects the acting device, and lasts fifteen seconds."""
        (step,) = parse_scenario({"fault": [{"kind": "radio"}]}, "x").steps
        self.assertEqual((step.at, step.device, step.fault), (0.0, "executing", Fault("radio")))

    def test_wrong(self) -> None:
        """The error for an invalid value contains file and key."""
        wrong: list[tuple[dict[str, Any], str]] = [
            ({}, "[[fault]]"),
            ({"fault": []}, "[[fault]]"),
            ({"fault": [{"kind": "fly"}]}, "[[fault]] 1 kind"),
            ({"fault": [{"kind": "loss"}, {"kind": "loss", "at": -1}]}, "[[fault]] 2 at"),
            ({"fault": [{"kind": "loss", "device": 5}]}, "[[fault]] 1 device"),
            ({"fault": [{"kind": "loss", "amount": 7}]}, "[[fault]] 1 amount"),
            ({"fault": [{"kind": "loss", "who": "dog1"}]}, "[[fault]] 1 who"),
            ({"fault": [{"kind": "loss"}], "seed": -1}, "seed"),
            ({"fault": [{"kind": "loss"}], "task": 5}, "task"),
            ({"faults": []}, "faults"),
        ]
        for content, key in wrong:
            error = self.assertRaises(BadSetting, parse_scenario, content, "day.toml")
            self.assertEqual((error.file, error.key), ("day.toml", key))
