"""Tests of scenario files."""

from __future__ import annotations

import random
import re
from dataclasses import dataclass
from statistics import fmean, median
from typing import Annotated

from msgspec import Meta
from twisted.trial.unittest import SynchronousTestCase

from middleware.errors import BadSetting
from sim.team import durations
from sim.team.command import KINDS
from sim.team.scenario import FOLDER, Scenario, list_names, load_scenario, parse_scenario


@dataclass(frozen=True)
class _Load:
    rate: Annotated[float, Meta(ge=0.0, le=100.0)] = 1.0


SETTINGS = {"lookups": _Load}

WHOLE = """
about = "a bad day"
nodes = 50
kind = "swarm"
seconds = 60.0

[join]
how = "batches"
size = 10

[link]
kind = "wifi"
loss = 0.05

[[fault]]  # the first
kind = "crash"
at = 10.0
share = 0.5

[[fault]]
kind = "cut"
at = 20
places = [0, 3]
lasts = 5.0

[load.lookups]
rate = 2.0

[targets]
"hops" = "<= 5"
"""

WRONG = {
    "nodes = 0": ("1", "nodes"),
    "about = 'x'\nnods = 3": ("2", "nods"),
    "nodes = true": ("1", "nodes"),
    "seconds = -1.0": ("1", "seconds"),
    "[join]\nhow = 'slowly'": ("2", "[join] how"),
    "nodes = 5\n[join]\nhow = 'batches'\nsize = 6": ("4", "[join] size"),
    "seconds = 5.0\nlead = 5.0": ("2", "lead"),
    "about = 'x'\njoin = { how = 'slowly' }": ("2", "[join] how"),
    "about = 'x'\njoin.how = 'slowly'": ("2", "[join] how"),
    "join = 3": ("1", "join"),
    "[link]\nburst = 0.1": ("2", "[link] burst"),
    "[link]\nloss = 0.1\nburst = 0.1\nasymmetry = 0.5": ("4", "[link] asymmetry"),
    "[link]\nasymmetry = 0.5": ("2", "[link] asymmetry"),
    "nodes = 2\n[nat]\nshare = 0.5": ("3", "[nat] share"),
    "nodes = 2\n[sessions]\nmedian = 60.0": ("3", "[sessions] median"),
    "[[fault]]\nkind = 'crash'\ncount = 1": ("1", "[[fault]] 1 at"),
    "[[fault]]\nkind = 'crush'\nat = 1.0": ("2", "[[fault]] 1 kind"),
    "[[fault]]\nkind = 'crash'\nat = 1.0\ncount = 1\n[[fault]]\nkind = 'cut'\nat = 1.0\ncount = 1": (
        "5",
        "[[fault]] 2 lasts",
    ),
    "[[fault]]\nkind = 'crash'\nat = 99.0\ncount = 1": ("3", "[[fault]] 1 at"),
    "[[fault]]\nkind = 'crash'\nat = 1.0\ncount = 1\nshare = 0.5": ("2", "[[fault]] 1 kind"),
    "[[fault]]\nkind = 'crash'\nat = 1.0\nplaces = [10]": ("4", "[[fault]] 1 places"),
    "[[fault]]\nkind = 'crash'\nat = 1.0\nplaces = [-1]": ("4", "[[fault]] 1 places"),
    "[[fault]]\nkind = 'crash'\nat = 1.0\ncount = 11": ("4", "[[fault]] 1 count"),
    "[[fault]]\nkind = 'crash'\nat = 1.0\nshare = 1.0": ("4", "[[fault]] 1 share"),
    "[[fault]]\nkind = 'pairs'\nat = 1.0\nlasts = 1.0": ("1", "[[fault]] 1 share"),
    "[[fault]]\nkind = 'crowd'\nat = 1.0": ("1", "[[fault]] 1 count"),
    "[[fault]]\nkind = 'rate'\nat = 1.0\nlasts = 1.0\ncount = 1\namount = 3.0": ("6", "[[fault]] 1 amount"),
    "[[fault]]\nkind = 'step'\nat = 1.0\ncount = 1": ("1", "[[fault]] 1 amount"),
    "[[fault]]\nkind = 'weather'\nat = 1.0\nlasts = 1.0": ("1", "[[fault]] 1 amount"),
    "[[fault]]\nkind = 'rebind'\nat = 1.0\ncount = 1": ("2", "[[fault]] 1 kind"),
    "[[fault]]\nkind = 'crash'\nat = 1.0\ncount = 1\namount = 2.0": ("5", "[[fault]] 1 amount"),
    "[[fault]]\nkind = 'rebind'\nat = 1.0\ncount = 1\nlasts = 2.0": ("5", "[[fault]] 1 lasts"),
    "[[fault]]\nkind = 'weather'\nat = 1.0\nlasts = 1.0\nshare = 0.5": ("5", "[[fault]] 1 share"),
    "fault = 3": ("1", "fault"),
    "nodes = 5\n[fault]\nkind = 'crash'": ("2", "fault"),
    "nodes = 5\n[[join]]\nhow = 'at once'": ("2", "join"),
    "nodes = 5\n[load]\nlookups = 3": ("3", "load.lookups"),
    "[load.lookups]\nrate = 1.0\nspeed = 3": ("3", "[load.lookups] speed"),
    "[load.nothing]": ("1", "[load.nothing]"),
    "load = 3": ("1", "load"),
    "[targets]\nhops = 5": ("2", "[targets] hops"),
    '[targets]\n"p50, s" = "about 5"': ("2", "[targets] p50, s"),
    "targets = 1": ("1", "targets"),
}


def _read(text: str, **changes: object) -> Scenario:
    return parse_scenario(text, "bad.toml", "bad", SETTINGS, changes)


class ScenarioTests(SynchronousTestCase):
    """A scenario file is either read completely or rejected before the first step."""

    def test_file_means_what_it_says(self) -> None:
        """Tables, faults in order, workloads and targets are read; missing values get their defaults."""
        scenario = _read(WHOLE)
        self.assertEqual((scenario.nodes, scenario.kind, scenario.join.size), (50, "swarm", 10))
        self.assertEqual([fault.kind for fault in scenario.faults], ["crash", "cut"])
        self.assertEqual(scenario.faults[1].places, (0, 3))
        self.assertEqual(scenario.loads, (("lookups", _Load(2.0)),))
        self.assertEqual([(name, str(bound)) for name, bound in scenario.targets], [("hops", "<= 5")])
        self.assertEqual(scenario.sessions.session_durations, None)

    def test_wrong_values_are_named_with_their_line(self) -> None:
        """The error for each invalid value contains file, line, key and a remedy."""
        for text, (line, key) in WRONG.items():
            error = self.assertRaises(BadSetting, _read, text)
            self.assertEqual((error.file, error.key), (f"bad.toml:{line}", key), text)
            self.assertTrue(error.problem and error.remedy, text)

    def test_any_file_is_a_scenario_or_is_refused(self) -> None:
        """A damaged file is either valid or rejected with a remedy; no other exception is raised."""
        rng, refused = random.Random(1), 0
        values = ("-1", "nan", "inf", "true", "'x'", "[]", "{}", "[1, 'a']", "9" * 30, "[[1]]", "1979-05-27")
        for _ in range(600):
            lines = WHOLE.splitlines()
            for _ in range(rng.randint(1, 3)):
                at = rng.randrange(len(lines))
                if rng.random() < 0.6 and "=" in lines[at]:
                    lines[at] = f"{lines[at].partition('=')[0]}= {rng.choice(values)}"
                elif rng.random() < 0.5:
                    lines.insert(
                        at, rng.choice([*lines, "[[join]]", "[fault]", "load = 3", "[load.lookups.x]", "x.y=1"])
                    )
                else:
                    lines[at] = lines[at][: len(lines[at]) // 2] + rng.choice('[]="{}\x00')
            try:
                _read("\n".join(lines))
            except BadSetting as error:
                refused += 1
                self.assertTrue(error.remedy)
        self.assertGreater(refused, 300)

    def test_what_is_no_toml_says_where(self) -> None:
        """The error for a file that is not TOML contains the line that the TOML parser reports."""
        error = self.assertRaises(BadSetting, _read, "nodes = 5\nseconds = = 3")
        self.assertIn("line 2", str(error))

    def test_command_line_comes_before_the_file(self) -> None:
        """``--nodes`` overrides the value in the file, and is checked like that value."""
        self.assertEqual(_read(WHOLE, nodes=70).nodes, 70)
        error = self.assertRaises(BadSetting, _read, WHOLE, nodes=0)
        self.assertEqual((error.file, error.key), ("command line", "--nodes"))

    def test_scenarios_that_ship_are_lawful(self) -> None:
        """Each scenario in the package is valid and has a description."""
        self.assertIn("steady", list_names())
        for name in list_names():
            self.assertTrue(load_scenario(name, {name: kind.settings for name, kind in KINDS.items()}).about, name)

    def test_example_of_the_document_is_lawful(self) -> None:
        """The scenario in docs/how-to/simulate-teams.md is valid."""
        document = (FOLDER.parent.parent / "docs" / "how-to" / "simulate-teams.md").read_text(encoding="utf-8")
        found = re.findall(r"```toml\n(.*?)```", document, re.DOTALL)
        self.assertEqual(len(found), 1)
        sorts = {name: kind.settings for name, kind in KINDS.items()}
        self.assertEqual(len(parse_scenario(found[0], "docs/how-to/simulate-teams.md", "example", sorts).faults), 1)

    def test_unknown_names_are_refused_with_the_nearest(self) -> None:
        """The error for an unknown name suggests the nearest name; an unreadable file is rejected."""
        self.assertIn("steady", self.assertRaises(BadSetting, load_scenario, "stedy", {}).remedy)
        self.assertIn("cannot be read", self.assertRaises(BadSetting, load_scenario, "/nowhere/x.toml", {}).problem)


class DurationDistributionTests(SynchronousTestCase):
    """Tests of ``DurationDistribution``."""

    def test_half_of_them_are_shorter_than_the_median(self) -> None:
        """Random durations have the expected median and mean."""
        for kind in durations.KINDS:
            stays, rng = durations.DurationDistribution(kind, 60.0), random.Random(1)
            drawn = [stays.draw(rng) for _ in range(40_000)]
            self.assertApproximates(median(drawn), 60.0, 2.0, kind)
            self.assertApproximates(fmean(drawn) / stays.mean, 1.0, 0.06, kind)

    def test_rate_of_leaving_is_the_same_from_the_start(self) -> None:
        """Sessions that have begun before the start end at a constant rate from the start: n / mean per second."""
        for kind in durations.KINDS:
            stays, rng = durations.DurationDistribution(kind, 60.0), random.Random(2)
            ends = []
            for _ in range(20_000):
                moment = stays.draw_remaining(rng)
                while moment < 60.0:
                    ends.append(moment)
                    moment += stays.draw(rng)
            expected = 20_000 / stays.mean * 20.0
            for start in (0.0, 20.0, 40.0):
                count = sum(start <= moment < start + 20 for moment in ends)
                self.assertApproximates(count / expected, 1.0, 0.08, f"{kind} from {start}")
