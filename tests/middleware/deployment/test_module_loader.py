"""Tests of ``middleware.deployment.module_loader``, which loads an operator's source or rejects it with a reason."""

from __future__ import annotations

import sys

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.deployed_modules import BEHAVIOUR, STRATEGY
from middleware.consensus.strategy import Report
from middleware.deployment.manifest import make_next_manifest
from middleware.deployment.module_loader import load_module
from middleware.errors import Undeployable

GOOD = """
from __future__ import annotations
from dataclasses import dataclass
from middleware.consensus.strategies.nearest import Nearest

@dataclass
class Weight:
    share: float = 0.5

class Strategy(Nearest):
    name = "mine"
    weight = Weight()
"""
SPIN = """
class Behaviour:
    def __init__(self, parameters, rng): self.cost = float(parameters["cost"])
    cost = None
    def look(self, seen, now): pass
    def search(self, now): return {}
    def hold(self, now): return {}
    def execute(self, now): raise RuntimeError("dizzy")
"""
BASE = (
    "from middleware.consensus.strategies.nearest import Nearest\nfrom middleware.consensus.strategy import Consensus\n"
)


class ModuleTests(SynchronousTestCase):
    def setUp(self) -> None:
        before = set(sys.modules)
        self.addCleanup(lambda: [sys.modules.pop(name) for name in sorted(set(sys.modules) - before)])

    def refusal(self, source: str | bytes, kind: str = STRATEGY) -> str:
        """Return the reason why a source is rejected, and check that no module remains."""
        data = source.encode() if isinstance(source, str) else source
        before = set(sys.modules)
        error = self.assertRaises(Undeployable, load_module, make_next_manifest("best", kind, data, None), data)
        self.assertEqual([name for name in set(sys.modules) - before if "deployed" in name], [])
        self.assertEqual(len(str(error).splitlines()), 1)
        return str(error.problem)

    def test_strategy_decides_under_its_name_and_version(self) -> None:
        """Each call creates a new strategy, whose decisions contain its deployed name and version."""
        source = GOOD.encode()
        manifest = make_next_manifest("best", STRATEGY, source, None)
        strategy = load_module(manifest, source)()
        self.assertEqual(strategy.find([Report("a", 2.0), Report("b", 1.0)]).assigned_agent, "b")
        self.assertEqual((strategy.name, strategy.version), ("deployed:best", f"1 {manifest.digest[:8]}"))
        self.assertIsNot(load_module(manifest, source)(), strategy)

    def test_behaviour_takes_parameters(self) -> None:
        """A behaviour is created with a task's parameters."""
        source = SPIN.encode()
        made = load_module(make_next_manifest("spin", BEHAVIOUR, source, None), source)({"cost": 2}, None)
        self.assertEqual(made.cost, 2.0)

    def test_what_cannot_run_is_refused(self) -> None:
        """A source is rejected with the reason if it does not parse, raises, does not end or is of a different kind."""
        for source, reason in (
            ("def f(:\n", "line 1: "),
            (b"\xff\xfe", ""),
            ("x = 1\0", ""),
            ("(" * 100_000, ""),
            ("1 / 0", "raises ZeroDivisionError"),
            ("raise SystemExit(3)", "raises SystemExit"),
            ("raise KeyboardInterrupt", "raises KeyboardInterrupt"),
            ("import nothing_of_that_name", "raises ModuleNotFoundError"),
            ("while True: pass", "takes more than"),
            ("try:\n  while 1: pass\nexcept Exception: pass", "takes more than"),
            ("x = 1", "a strategy has to define Strategy"),
            ("Strategy = 7", "a strategy has to define Strategy"),
            (SPIN, "a strategy has to define Strategy"),
            ("class Strategy: pass", "a strategy has to define find"),
        ):
            self.assertIn(reason, self.refusal(source), source[:40])
        self.assertIn("a behaviour has to define Behaviour", self.refusal(GOOD, BEHAVIOUR))
        self.assertIn("a behaviour has to define look", self.refusal("class Behaviour: pass", BEHAVIOUR))

    def test_what_is_no_strategy_is_refused(self) -> None:
        """A strategy is rejected if it loops, returns an unknown agent, depends on the order or breaks another rule."""
        for body, reason in (
            ("def find(self, c):\n  while True: pass", "takes more than"),
            ("def find(self, c): return Consensus('x' * 40 if c else None)", "did not report"),
            ("def find(self, c): return Consensus('x' * 40)", "without any report"),
            ("def find(self, c): return Consensus(c[0].agent if c else None)", "depends on the order"),
            ("def find(self, c): return None", "raises AttributeError"),
            ("def improves(self, a, b, h): return True", "better than itself"),
            ("def merge(self, a, b): return tuple(r for r in (*a, *b) if r.cost > 2)", "find after merge"),
        ):
            indented = "".join(f"  {line}\n" for line in body.splitlines())
            self.assertIn(reason, self.refusal(f"{BASE}class Strategy(Nearest):\n{indented}"))

    def test_other_source_than_signed_never_runs(self) -> None:
        """A source whose digest or size differs from the manifest is rejected before it runs."""
        source = b"import sys; sys.modules['swarm_canary'] = sys"
        manifest = make_next_manifest("best", STRATEGY, b"x" * len(source), None)
        error = self.assertRaises(Undeployable, load_module, manifest, source)
        self.assertIn("does not match the signed digest", str(error))
        self.assertNotIn("swarm_canary", sys.modules)

    def test_tracer_of_others_is_put_back(self) -> None:
        """If a trace function (coverage, a debugger) was set, it is restored after a module was loaded."""
        before = sys.gettrace()
        self.refusal("while True: pass")
        self.assertIs(sys.gettrace(), before)
