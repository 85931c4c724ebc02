"""Tests of ``Glance`` in ``webnode.state_builder``; tests of whole teams check its states."""

from __future__ import annotations

from typing import Any

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from webnode.state_builder import MAX_AGE_S, StateCache


class GlanceTests(SynchronousTestCase):
    def test_read_once_for_many(self) -> None:
        """Reads within a tenth of a second share one state; a later read makes a new one."""
        clock, read = Clock(), [0]

        def state() -> dict[str, Any]:
            read[0] += 1
            return {"n": read[0]}

        glance = StateCache(state, clock.seconds)
        self.assertEqual([glance()["n"] for _ in range(100)], [1] * 100)
        clock.advance(MAX_AGE_S)
        self.assertEqual((glance()["n"], glance()["n"]), (2, 2))
