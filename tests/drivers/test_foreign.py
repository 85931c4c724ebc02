"""Tests of drivers from other Python packages, found by entry point or by ``module:Class``."""

from __future__ import annotations

import sys
from pathlib import Path
from shutil import copy

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from drivers.errors import UsageError
from drivers.registry import create_driver, describe, list_kinds

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "driver" / "robot.py"
ENTRIES = """[swarm_node.drivers]
rover = rover_of_tests:Rover
torn = torn_of_tests:Torn
gone = no_such_module_of_tests:Gone
sim = torn_of_tests:Torn
"""
MODULES = ("rover_of_tests", "torn_of_tests", "plain_of_tests")


class ForeignTests(SynchronousTestCase):
    def setUp(self) -> None:
        """Add a Python package with a working driver and broken drivers to the path of this process, as pip does."""
        folder = Path(self.mktemp()).resolve()
        (folder / "rovers-1.dist-info").mkdir(parents=True)
        (folder / "rovers-1.dist-info" / "METADATA").write_text("Name: rovers\nVersion: 1\n")
        (folder / "rovers-1.dist-info" / "entry_points.txt").write_text(ENTRIES)
        copy(EXAMPLE, folder / "rover_of_tests.py")
        (folder / "torn_of_tests.py").write_text("raise RuntimeError('torn\\nin two')\n")
        (folder / "plain_of_tests.py").write_text("class Plain:\n    def __init__(self, *_): pass\n\nNUMBER = 7\n")
        self.patch(sys, "path", [str(folder), *sys.path])
        self.addCleanup(lambda: [sys.modules.pop(name, None) for name in MODULES])

    def refused(self, kind: str) -> str:
        """Return the one-line error for a kind of driver that is refused."""
        lines = {
            str(self.assertRaises(UsageError, create_driver, kind, {"host": "x"}, "dog1", Clock())),
            str(self.assertRaises(UsageError, describe, kind, {"host": "x"})),
        }
        self.assertEqual(len(lines), 1)
        line = lines.pop()
        self.assertNotIn("\n", line)
        self.assertIn(kind, line)
        return line

    def test_kinds_of_others_are_known(self) -> None:
        """A kind from an installed entry point is used like a built-in kind, and is imported only on use."""
        self.assertLess({"rover", "torn", "gone", "aibo", "sim"}, set(list_kinds()))
        self.assertNotIn("rover_of_tests", sys.modules)
        driver = create_driver("rover", {"host": "rover"}, "dog1", Clock())
        self.assertEqual((driver.state, driver.description.kind), ("idle", "rover"))
        self.assertEqual(describe("rover", {"host": "rover"}), driver.description)

    def test_place_is_a_kind(self) -> None:
        """A kind of the form ``module:Class`` needs no entry point."""
        driver = create_driver("rover_of_tests:Rover", {"host": "rover"}, "dog1", Clock())
        self.assertEqual(driver.description, describe("rover_of_tests:Rover", {"host": "rover"}))

    def test_broken_ones_are_named_and_harm_nothing(self) -> None:
        """A driver that cannot be imported or created is refused; the error contains its name.

        Other drivers still work.
        """
        self.assertIn("RuntimeError: torn in two", self.refused("torn"))
        self.assertIn("no_such_module_of_tests", self.refused("gone"))
        self.assertIn("AttributeError", self.refused("rover_of_tests:Nobody"))
        self.assertIn("cannot be called", self.refused("plain_of_tests:NUMBER"))
        self.assertIn("it lacks description, state", self.refused("plain_of_tests:Plain"))
        self.assertIn("KeyError: 'host'", str(self.assertRaises(UsageError, describe, "rover", {})))
        self.assertEqual(describe("rover", {"host": "rover"}).kind, "rover")

    def test_built_in_kinds_stay(self) -> None:
        """An entry point with the name of a built-in kind does not replace it."""
        self.assertEqual(create_driver("sim", {}, "dog1", Clock()).description.kind, "aibo-ers7")
        self.assertEqual(list_kinds().count("sim"), 1)
