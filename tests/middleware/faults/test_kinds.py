"""Tests of ``middleware.faults.kinds`` and ``middleware.faults.takeover``: valid faults and takeover times."""

from __future__ import annotations

import math
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.directory.presence import EXECUTING, SEARCHING, Device
from middleware.errors import BadFault
from middleware.faults.kinds import KINDS, Fault, parse_delay, parse_fault
from middleware.faults.takeover import OBSERVATION_S, Takeover, find_executing


class FaultTests(SynchronousTestCase):
    def test_usual(self) -> None:
        """Each kind of fault has a default amount, which is valid."""
        for kind, rule in KINDS.items():
            self.assertEqual(parse_fault(kind), Fault(kind, 15.0, rule.amount))
        self.assertEqual(parse_fault("loss", 3, 0.5), Fault("loss", 3.0, 0.5))
        self.assertEqual(parse_fault("kill", None, 0), Fault("kill"))

    def test_begins(self) -> None:
        """A device replies with the delay until its fault starts; an invalid reply counts as no delay."""
        self.assertEqual(parse_delay(0.5), 0.5)
        for answer in (None, "soon", True, -1.0, 3600.0, math.nan, math.inf, [0.5]):
            self.assertEqual(parse_delay(answer), 0.0)

    def test_unlawful(self) -> None:
        """Any invalid fault from the network is rejected, and the error contains the name of the invalid field."""
        wrong: list[tuple[tuple[Any, ...], str]] = [
            (("fly",), "kind"),
            ((None,), "kind"),
            (([],), "kind"),
            (("loss", 0), "seconds"),
            (("loss", 601), "seconds"),
            (("loss", "15"), "seconds"),
            (("loss", math.nan), "seconds"),
            (("loss", 5, 1.1), "amount"),
            (("delay", 5, True), "amount"),
            (("radio", 5, 0.5), "amount"),
        ]
        for words, field in wrong:
            error = self.assertRaises(BadFault, parse_fault, *words)
            self.assertEqual(error.field, field, words)
            self.assertNotIn("\n", str(error))


class TakeoverTests(SynchronousTestCase):
    def test_time_the_first_other(self) -> None:
        """The takeover time ends when the first other device acts on the same task, and does not change after that."""
        clock = Takeover("a", "t1", 10.0, 14.0)
        clock.observe({"a": "t1", "b": "t2"}, 10.5)
        self.assertIsNone(clock.seconds)
        clock.observe({"a": "t1", "b": "t1"}, 11.5)
        clock.observe({"c": "t1"}, 13.0)
        self.assertEqual((clock.seconds, clock.to), (1.5, "b"))

    def test_end(self) -> None:
        """The measurement of a takeover does not start without a task, and ends a limited time after the fault."""
        self.assertFalse(Takeover("a", "", 10.0, 14.0).is_open(10.1))
        clock = Takeover("a", "t1", 10.0, 14.0)
        self.assertTrue(clock.is_open(14.0))
        clock.observe({"b": "t1"}, 14.0 + OBSERVATION_S)
        self.assertIsNone(clock.seconds)

    def test_acting(self) -> None:
        """A device counts as acting when it executes a task, but not when it searches."""
        devices = [Device("a", "dog1", task="t", status=EXECUTING), Device("b", "dog2", task="t", status=SEARCHING)]
        self.assertEqual(find_executing(devices), {"a": "t"})
