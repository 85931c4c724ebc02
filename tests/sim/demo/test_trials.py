"""Tests of ``sim.demo.trials``: the table, and the command line with a stub team."""

from __future__ import annotations

import contextlib
import io
import json
from pathlib import Path
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.clock import HeapClock
from sim.demo.trials import Outcome, format_table, main, percentile, run_trial


class PlayedTeam:
    """A stub team of two dogs: the task completes with an even seed, and never with an odd seed."""

    def __init__(self, seed: int) -> None:
        self.clock = HeapClock()
        self.switchboard = self
        self.simulator = None
        self.lost: set[str] = set()
        self._seed = seed
        self._began: float | None = None

    def digest(self) -> str:
        """Return a digest, like the switchboard of a real team."""
        return f"digest {self._seed}"

    def run_demo(self) -> str:
        """Start the task."""
        self._began = self.clock.seconds()
        return "t1"

    def scatter(self, seed: int) -> None:
        """Leave all dogs where they are."""

    def kill(self, name: str) -> None:
        """Kill a dog."""
        self.lost.add(name)

    def stop(self) -> None:
        """Do nothing: the stub has no processes."""

    def _age(self) -> float:
        return 0.0 if self._began is None else self.clock.seconds() - self._began

    def _by(self) -> str:
        return "dog2" if "dog1" in self.lost else "dog1"

    def get_true_state(self) -> dict[str, Any]:
        """Return a snapshot in which the acting dog walks to the target."""
        near = max(0.22, 1.0 - 0.1 * self._age())
        at = {"dog1": 0.9 if "dog1" in self.lost else near, "dog2": near if "dog1" in self.lost else 2.0}
        dogs = [{"name": n, "x": x, "y": 0.0, "heading": 0.0, "moving": True, "stripes": 1} for n, x in at.items()]
        return {"t": self._age(), "walls": [3.0, 2.4], "dogs": dogs, "target": {"x": 0.0, "y": 0.0, "radius": 0.08}}

    def state(self) -> dict[str, Any]:
        """Return the state of the page."""
        is_done = self._age() > 9.0 and self._seed % 2 == 0
        by = self._by()
        names = [name for name in ("dog1", "dog2") if name not in self.lost]
        status = {name: "EXECUTING" if name == by and not is_done else "WAITING" for name in names}
        devices = [{"uuid": n, "name": n, "status": s, "task": "t1", "gone": None} for n, s in status.items()]
        members = [{"name": n, "cost": 1.0} for n in names]
        group = {"task": "t1", "members": members, "assigned": by, "agree": len(names), "of": len(names)}
        task = {"id": "t1", "status": "COMPLETED" if is_done else "EXECUTING", "result": None}
        if is_done:
            task["result"] = {"by": by, "took": 9.0}  # type: ignore[assignment]
        return {"devices": devices, "tasks": [task], "groups": [group]}


class TrialTests(SynchronousTestCase):
    def test_trial_notes_what_came_of_it(self) -> None:
        """A trial records the finishing dog, the results of its checks, and the digest of the trace."""
        outcome = run_trial(PlayedTeam, 1, 2)
        self.assertEqual(outcome.broken, [])
        self.assertTrue(outcome.held and outcome.found and outcome.agreed and outcome.right)
        self.assertEqual((outcome.by, outcome.killed, outcome.digest), ("dog1", "", "digest 2"))

    def test_second_experiment_loses_the_dog_on_its_way(self) -> None:
        """In experiment 2 the acting dog is killed once, the takeover is timed, and each phase is drawn as a PNG."""
        folder = Path(self.mktemp())
        folder.mkdir()
        outcome = run_trial(PlayedTeam, 2, 2, folder)
        self.assertEqual((outcome.killed, outcome.by, outcome.broken), ("dog1", "dog2", []))
        assert outcome.takeover is not None
        self.assertLess(outcome.takeover, 0.1)
        names = sorted(path.name.removeprefix("experiment2-seed2-") for path in folder.iterdir())
        wanted = ("1-without-target", "2-with-target", "3-found", "4-approach", "5-lost", "6-reached")
        self.assertEqual(names, [f"{phase}.png" for phase in wanted])
        self.assertTrue(all(path.read_bytes()[:4] == b"\x89PNG" for path in folder.iterdir()))

    def test_percentile_is_a_value_that_was(self) -> None:
        """A percentile is a measured value: the smallest one that the given share of the values does not exceed."""
        values = [5.0, 1.0, 4.0, 2.0, 3.0]
        self.assertEqual([percentile(values, share) for share in (0.0, 0.2, 0.21, 0.5, 0.95, 1.0)], [1, 1, 2, 3, 5, 5])

    def test_table_counts_and_measures(self) -> None:
        """Each experiment has one line with counts, medians and 95th percentiles; a missing value is a dash."""
        good: dict[str, Any] = {"held": True, "found": True, "agreed": True, "right": True}
        outcomes = [Outcome(n, 1, **good, find=1.0 + n, agree=2.0, reach=10.0) for n in range(3)]
        outcomes.append(Outcome(1, 2, takeover=1.25))
        lines = [line.split() for line in format_table(outcomes).splitlines()]
        self.assertEqual(lines[1][:7], ["experiment", "1", "3", "3", "3", "3", "3"])
        self.assertEqual(lines[1][7:], ["2.00", "(3.00)", "2.00", "(2.00)", "10.00", "(10.00)", "-"])
        self.assertEqual(lines[2], ["experiment", "2", "1", "0", "0", "0", "0", "-", "-", "-", "1.25", "(1.25)"])

    def run_main(self, *words: str) -> tuple[int, str, Path]:
        """Run the command with a new output folder; return exit code, output and folder."""
        folder = Path(self.mktemp())
        output = io.StringIO()
        with contextlib.redirect_stdout(output):
            code = main([*words, "--jobs", "1", "--out", str(folder)], PlayedTeam)
        return code, output.getvalue(), folder

    def test_exit_code(self) -> None:
        """The exit code is 0 if every trial passes.

        Otherwise it is 1, and the line of a trial lists its failed check.
        """
        code, output, folder = self.run_main("--count", "1", "--seed", "2")
        self.assertEqual(code, 0, output)
        self.assertIn("   1/2 ok   experiment 1 seed 2: dog1 reached it", output)
        self.assertIn("experiment 2      1      1", output)
        rows = json.loads((folder / "trials.json").read_text(encoding="utf-8"))
        self.assertEqual([(row["experiment"], row["held"]) for row in rows], [(1, True), (2, True)])
        self.assertTrue(list(folder.glob("*.png")))
        code, output, _ = self.run_main("--count", "1", "--seed", "1", "--pictures", "0")
        self.assertEqual(code, 1)
        self.assertIn("1/2 FAIL experiment 1 seed 1: nobody reached it  (task completed (", output)

    def test_wrong_arguments_are_refused(self) -> None:
        """A negative or non-numeric count, and a folder that cannot be created, give one error line and exit code 2."""
        blocked = Path(self.mktemp())
        blocked.write_text("a file", encoding="utf-8")
        for words in (["--count", "-1"], ["--count", "many"], ["--out", str(blocked / "below")]):
            errors = io.StringIO()
            with contextlib.redirect_stderr(errors), self.assertRaises(SystemExit) as caught:
                main(words, PlayedTeam)
            self.assertEqual(caught.exception.code, 2)
            self.assertNotIn("Traceback", errors.getvalue())
            self.assertIn(
                "must be a whole number of at least 0" if "--count" in words else "cannot create", errors.getvalue()
            )
