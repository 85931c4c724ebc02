"""Tests of how strategies are found."""

from __future__ import annotations

import sys

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.nearest import Nearest
from middleware.consensus.strategy import Report, digest_of, strategy_for
from middleware.errors import UnknownStrategy


class Broken:
    """A strategy that cannot even be made."""

    def __init__(self) -> None:
        raise ZeroDivisionError("broken")


class StrategyTests(SynchronousTestCase):
    def test_built_in(self) -> None:
        """The thesis' strategy is there by name."""
        self.assertIsInstance(strategy_for("nearest"), Nearest)

    def test_unknown_names_the_known(self) -> None:
        """A name that nobody has is answered with those that there are."""
        error = self.assertRaises(UnknownStrategy, strategy_for, "farthest")
        self.assertIn("'farthest'", str(error))
        self.assertIn("nearest", str(error))

    def test_dotted_only_on_demand(self) -> None:
        """A task that comes from a peer cannot name a module to import; the own settings can."""
        sys.modules.pop("this", None)
        self.assertRaises(UnknownStrategy, strategy_for, "this:s")
        self.assertNotIn("this", sys.modules)
        self.assertIsInstance(strategy_for("middleware.consensus.nearest:Nearest", dotted=True), Nearest)

    def test_what_cannot_be_loaded(self) -> None:
        """A module that is missing, a class that is, an empty name or a broken class all are an unknown strategy."""
        broken = f"{__name__}:Broken"
        for name in ("no.such:X", "middleware.consensus.nearest:No", ":X", ".x:Y", "math:", broken, "math:pi"):
            self.assertRaises(UnknownStrategy, strategy_for, name, dotted=True)

    def test_digest(self) -> None:
        """Equal reports have one digest in any order, duplicates included, and another cost has another."""
        a, b, c = Report("a", 1.0), Report("a", 2.0), Report("b", 1.0)
        self.assertEqual(digest_of([a, b, c]), digest_of([c, b, a]))
        self.assertEqual(len({digest_of(each) for each in ([a, c], [b, c], [a], [])}), 4)
