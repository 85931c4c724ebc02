"""Tests of the command ``sim run``: its report, progress and errors."""

from __future__ import annotations

import io
import json
from pathlib import Path
from xml.etree import ElementTree

from twisted.trial.unittest import SynchronousTestCase

from middleware.errors import BadSetting
from sim.team.command import EXIT_INTERRUPTED, EXIT_MISSED, KINDS, Environment, run
from sim.team.report import Trace

SCENARIO = """
about = "a small team"
nodes = 4
seconds = 5.0
[join]
pause = 0.2
settle = 1.0
[[fault]]
kind = "crash"
at = 1.0
count = 1
lasts = 1.0
[load.standing]
"""


class CommandTests(SynchronousTestCase):
    """Tests of ``run``."""

    def setUp(self) -> None:
        """Create a folder for the scenario, and a clock that advances on each call."""
        self.folder = Path(self.mktemp())
        self.folder.mkdir()
        self.path = self.folder / "small.toml"
        self.now = 0.0
        self.out, self.err = io.StringIO(), io.StringIO()
        self.asked = 0

    def seconds(self) -> float:
        """Advance the clock and return its time."""
        self.now += 0.15
        return self.now

    def run_it(self, *words: str, text: str = SCENARIO, stop_after: int = 10**9, columns: int = 0) -> int:
        """Run the scenario and return the exit code."""
        self.path.write_text(text)

        def is_stopped() -> bool:
            self.asked += 1
            return self.asked > stop_after

        def read(path: str) -> str:
            if path != "/proc/self/status":
                raise FileNotFoundError(path)
            return "VmRSS: 2048 kB"

        world = Environment(self.out, self.err, self.seconds, self.seconds, read, columns, is_stopped)
        return run(["--scenario", str(self.path), *words], world, KINDS)

    def test_report_is_for_people_and_programs(self) -> None:
        """The table, the hash and the command that repeats the run are printed.

        The JSON file also contains time series; the trace and the figure show the fault.
        """
        files = [str(self.folder / name) for name in ("r.json", "t.jsonl", "p.svg")]
        self.assertEqual(self.run_it("--seed", "3", "--json", files[0], "--trace", files[1], "--picture", files[2]), 0)
        report = json.loads(Path(files[0]).read_text())
        told = self.out.getvalue()
        self.assertIn(f"hash      {report['hash']}", told)
        self.assertIn(f"again     sim run --scenario {self.path} --seed 3\n", told)
        self.assertIn("nodes inside", told)
        self.assertEqual((report["partial"], report["violations"], report["missed"]), (False, [], []))
        self.assertEqual(report["faults"], ["1 s crash 1 for 1 s"])
        self.assertGreater(len(report["series"]["nodes alive"]), 20)
        self.assertIn(3, [value for _, value in report["series"]["nodes alive"]])
        lines = [json.loads(line) for line in Path(files[1]).read_text().splitlines()]
        self.assertEqual(lines[-1]["hash"], report["hash"])
        self.assertEqual([line["event"] for line in lines[1:-1]].count("killed"), 1)
        picture = ElementTree.fromstring(Path(files[2]).read_text())
        self.assertIn("crash", "".join(picture.itertext()))

    def test_missed_target_fails(self) -> None:
        """A missed target is reported and gives exit code 1."""
        text = SCENARIO + '[targets]\n"nodes" = ">= 5"\n'
        self.assertEqual(self.run_it(text=text), EXIT_MISSED)
        self.assertIn("MISSED    nodes: >= 5", self.out.getvalue())

    def test_target_without_figure_is_refused(self) -> None:
        """A target that no workload of the scenario measures is rejected with its line number before the first step."""
        text = SCENARIO + "[load.lookups]\n[load.traffic]\n[targets]\n"
        kept = self.folder / "kept.json"
        kept.write_text("{}")
        for target, remedy in (("hops", "there are .*nodes inside"), ("lookups.sucess", "the nearest is lookups.succ")):
            error = self.assertRaises(BadSetting, self.run_it, "--json", str(kept), text=f'{text}"{target}" = "<= 5"\n')
            self.assertRegex(error.remedy, remedy)
            self.assertEqual(error.file, f"{self.path}:{len(text.splitlines()) + 1}")
        self.assertEqual(kept.read_text(), "{}")

    def test_ending_leaves_a_valid_partial_report(self) -> None:
        """An interrupted run writes its report as text, JSON, trace and figure; each of them is marked as partial."""
        files = [str(self.folder / name) for name in ("r.json", "t.jsonl", "p.svg")]
        code = self.run_it("--json", files[0], "--trace", files[1], "--picture", files[2], stop_after=3)
        self.assertEqual(code, EXIT_INTERRUPTED)
        self.assertIn("PARTIAL   ended while joining, after 0.9 s", self.out.getvalue())
        report = json.loads(Path(files[0]).read_text())
        self.assertEqual((report["partial"], report["phase"]), (True, "joining"))
        self.assertTrue(json.loads(Path(files[1]).read_text().splitlines()[-1])["partial"])
        self.assertIn("partial", ElementTree.fromstring(Path(files[2]).read_text())[0].text or "")

    def test_progress_is_a_bar_or_lines(self) -> None:
        """On a terminal the progress is a bar that is erased at the end.

        Otherwise a line is printed from time to time.
        """
        self.run_it(columns=120)
        drawn = self.err.getvalue()
        self.assertRegex(drawn, r"\r\[#+\.+\]  ?\d+% running, \d+\.\d of 17 s, [34] alive, [\d,]+ datagrams, ")
        self.assertIn("x real time, 2 MiB", drawn)
        self.assertNotIn("\n", drawn)
        self.assertTrue(drawn.endswith("\r"))
        self.assertLessEqual(max(map(len, drawn.split("\r"))), 119)
        self.err = io.StringIO()
        self.run_it(text=SCENARIO + '[targets]\n"nodes inside" = ">= 9"\n')
        lines = self.err.getvalue().splitlines()
        self.assertGreater(len(lines), 1)
        self.assertFalse(any("\r" in line or "[" in line for line in lines))
        self.assertTrue(lines[-1].endswith(", nodes inside 4 (!)"), lines[-1])

    def test_file_that_cannot_be_written_is_said_first(self) -> None:
        """A report path in a missing folder is rejected before the run starts."""
        error = self.assertRaises(BadSetting, self.run_it, "--json", str(self.folder / "no" / "r.json"))
        self.assertEqual((error.key, self.err.getvalue()), ("--json", ""))


class TraceTests(SynchronousTestCase):
    """Tests of ``Trace``."""

    def test_each_event_is_a_line_up_to_a_bound(self) -> None:
        """The trace has one JSON object per line; events beyond the limit are only counted."""
        out = io.StringIO()
        trace = Trace(out, 2)
        trace.begin(seed=3)
        trace.write_event(1.25, "born", 0, "")
        trace.write_event(2.0, "fault", -1, "1: crash")
        trace.write_event(3.0, "killed", 0, "")
        trace.end(partial=False)
        self.assertEqual(
            [json.loads(line) for line in out.getvalue().splitlines()],
            [
                {"trace": 1, "seed": 3},
                {"at": 1.25, "event": "born", "place": 0},
                {"at": 2.0, "event": "fault", "more": "1: crash"},
                {"end": True, "events": 3, "left_out": 1, "partial": False},
            ],
        )
