"""Tests of ``sim scale``: expected values, resumed measurements, figures and pages."""

from __future__ import annotations

import io
import itertools
import json
import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from middleware.errors import BadSetting
from sim.team.command import Environment
from sim.team.metric import Metric
from sim.team.scale import theory
from sim.team.scale.command import run_scale
from sim.team.scale.curve import CURVES
from sim.team.scale.drawing import draw_svg
from sim.team.scale.markdown import extrapolate, format_markdown
from sim.team.scale.measurement import MeasurementStopped, ProgressCallbacks, SizeResult, SurveySettings, measure_size
from sim.team.scale.measurement_file import MeasurementFile


def world() -> Environment:
    """Return an environment that has more memory than any team needs."""
    ticks = itertools.count()
    return Environment(
        io.StringIO(), io.StringIO(), lambda: next(ticks), lambda: 0.0, read=lambda path: "MemAvailable: 99999999 kB"
    )


def sized(nodes: int) -> SizeResult:
    """Return results for a size: the number of hops equals the number of nodes, all other values are 1."""
    figures = [Metric(curve.metric, 1.0, curve.unit) for curve in CURVES if curve.metric != "lookups.hops.mean"]
    return SizeResult(
        nodes, [*figures, Metric("lookups.hops.mean", float(nodes), "hops").with_target(None)], [], "h", 1.0
    )


class TheoryTests(SynchronousTestCase):
    def test_curves(self) -> None:
        """The expected numbers of hops, contacts, tree messages and agreement rounds follow the formulas."""
        self.assertEqual((theory.hops(3), theory.hops(1024)), (2.0, 5.0))
        self.assertEqual(theory.contacts(4), 3.0)
        self.assertTrue(60 < theory.contacts(1024) < 80)
        self.assertEqual(theory.tree(2), 2.0)
        self.assertAlmostEqual(theory.agreement(10_000), 0.975)
        self.assertTrue(theory.agreement(100) < theory.agreement(200) < theory.agreement(300))


class MeasurementFileTests(SynchronousTestCase):
    def test_resumed(self) -> None:
        """A team size that is already in the file is not measured again.

        A file that was measured with different settings is not overwritten.
        """
        out = self.mktemp()
        asked: list[int] = []

        def measured(nodes: int, settings: SurveySettings, watcher: ProgressCallbacks) -> SizeResult:
            asked.append(nodes)
            return sized(nodes)

        run_scale(["--nodes", "3,10", "--out", out], world(), measured)
        run_scale(["--nodes", "3,10,30", "--out", out], world(), measured)
        self.assertEqual(asked, [3, 10, 30])
        before = Path(out, "scale.json").read_text()
        with self.assertRaisesRegex(BadSetting, "other settings.*'seed': 1"):
            run_scale(["--nodes", "3", "--out", out, "--seed", "2"], world(), measured)
        self.assertEqual(asked, [3, 10, 30])
        self.assertEqual(Path(out, "scale.json").read_text(), before)

    def test_ended_run_keeps_what_it_has(self) -> None:
        """Each size is written when it has been measured; an interrupted measurement is discarded."""
        out, here, wishes = self.mktemp(), world(), list[int]()
        here.is_stopped = lambda: bool(wishes)

        def measured(nodes: int, settings: SurveySettings, watcher: ProgressCallbacks) -> SizeResult:
            if nodes == 3:
                return sized(nodes)
            wishes.append(nodes)
            return measure_size(nodes, settings, watcher)

        self.assertEqual(run_scale(["--nodes", "3,10", "--out", out], here, measured), 130)
        self.assertEqual(list(json.loads(Path(out, "scale.json").read_text())["sizes"]), ["3"])

    def test_bad_input(self) -> None:
        """An invalid size, option or file, and a folder that cannot be written, are rejected."""
        for text in ("", "many", "2", "3,1000000"):
            with self.assertRaisesRegex(BadSetting, "--nodes"):
                run_scale(["--nodes", text, "--out", self.mktemp()], world())
        for key, text in (("--takeovers", "-1"), ("--swarm-most", "-1")):
            with self.assertRaisesRegex(BadSetting, key):
                run_scale(["--nodes", "3", key, text, "--out", self.mktemp()], world())
        torn = json.dumps({"digest": SurveySettings().digest(), "sizes": {"x": 1}})
        for text in ("{", "[]", torn):
            path = Path(self.mktemp())
            path.write_text(text)
            with self.assertRaisesRegex(BadSetting, "cannot be used"):
                MeasurementFile(path, SurveySettings()).read()

        file, full = Path(self.mktemp()), Path(self.mktemp())
        file.touch()
        (full / "scale.new").mkdir(parents=True)
        for out in (file, file / "below", full):
            with self.assertRaisesRegex(BadSetting, "--out: cannot write"):
                run_scale(
                    ["--nodes", "3", "--out", str(out)], world(), lambda nodes, settings, watcher: self.fail("late")
                )

    def test_missed_targets_show(self) -> None:
        """A figure that misses its target is marked in the table and gives exit code 1."""
        here = world()
        code = run_scale(
            ["--nodes", "1000", "--out", self.mktemp()], here, lambda nodes, settings, watcher: sized(nodes)
        )
        self.assertEqual(code, 1)
        assert isinstance(here.out, io.StringIO)
        self.assertRegex(here.out.getvalue(), r"traffic.cpu +1 ms a second +<= 0.5 +NO")
        self.assertRegex(here.out.getvalue(), r"auctions.messages +1 datagrams +<= 6 +yes")


class DrawingTests(SynchronousTestCase):
    def test_svg(self) -> None:
        """Each curve with points has its own chart; the drawing is valid XML for any values."""
        for values in ([1.0, 1.0], [0.0, 0.0], [0.001, 5e6], [3.0, 4.0]):
            points = {curve.metric: [(3, values[0]), (1000, values[1])] for curve in CURVES[:5]}
            root = ElementTree.fromstring(draw_svg(CURVES, points, "a & b"))
            titles = [text.text for text in root.iter("{http://www.w3.org/2000/svg}text")]
            for curve in CURVES:
                self.assertEqual(curve.title in titles, curve in CURVES[:5], curve.title)


class PageTests(SynchronousTestCase):
    def test_table(self) -> None:
        """A value that misses its target is bold; the last column extrapolates over the logarithm of the size."""
        hops = [(n, 1.0 + 0.3 * math.log2(n)) for n in (3, 100, 300, 1000)]
        shown = format_markdown(CURVES, {"lookups.hops.mean": hops, "traffic.cpu": [(100, 1.0), (1000, 1.0)]})
        self.assertRegex(shown, r"Hops of a lookup \| hops \|.*\| 6.979 \|")
        self.assertRegex(shown, r"Processor of a node.* \| - \| 1 \| - \| \*\*1\*\* \| <= 0.5 \|  \|")
        self.assertIsNone(extrapolate(hops[:3]))
        # If the targets depend on the size of the team, the table shows them.
        shown = format_markdown(CURVES, {"auctions.agree.p95": [(n, 0.7) for n in (3, 100, 1000, 10_000)]})
        self.assertIn("| 0.7 | **0.7** | 0.7 | 0.7 | <= 1; <= 0.6 at 100, <= 0.8 at 1,000 |", shown)


class MeasurementTests(SynchronousTestCase):
    def test_ends_soon(self) -> None:
        """An interrupted survey ends at the next check, within 0.25 s of simulated time."""
        looks: list[int] = []

        def is_stopped() -> bool:
            looks.append(1)
            return len(looks) == 5

        with self.assertRaises(MeasurementStopped):
            measure_size(3, SurveySettings(), ProgressCallbacks(is_stopped=is_stopped))
        self.assertEqual(len(looks), 5)

    def test_small_team(self) -> None:
        """A survey of five nodes measures every figure without violations; its digest is reproducible."""
        settings = SurveySettings(settle=5.0, quiet=5.0, lookups=2.0, exact=5, auctions=1, takeovers=1, swarm_most=5)
        one, same = measure_size(5, settings), measure_size(5, settings)
        self.assertEqual(one.violations, [])
        self.assertEqual(one.hash, same.hash)
        metrics = {metric.name: metric.value for metric in one.metrics}
        self.assertEqual([curve.metric for curve in CURVES if metrics.get(curve.metric) is None], [])
        self.assertEqual((metrics["lookups.success"], metrics["auctions.right"]), (1.0, 1.0))
