"""Tests of ``webnode.state_builder``; the tests of whole teams check the states that it builds."""

from __future__ import annotations

from typing import Any

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from middleware.directory.presence import MAX_STOPS
from middleware.stop.stop_state import STANDS_STILL
from webnode.state_builder import MAX_AGE_S, StateCache, _make_stop_view


class StateCacheTests(SynchronousTestCase):
    def test_read_once_for_many(self) -> None:
        """Reads within a tenth of a second share one state; a later read builds a new state."""
        clock, read = Clock(), [0]

        def state() -> dict[str, Any]:
            read[0] += 1
            return {"n": read[0]}

        cache = StateCache(state, clock.seconds)
        self.assertEqual([cache()["n"] for _ in range(100)], [1] * 100)
        clock.advance(MAX_AGE_S)
        self.assertEqual((cache()["n"], cache()["n"]), (2, 2))


class StopViewTests(SynchronousTestCase):
    def test_more_stops_than_a_robot_reports(self) -> None:
        """A robot that reports as many stops as fit into its record is shown as stopped, even if more are in force."""
        stops = {f"{number:032x}": "ann" for number in range(MAX_STOPS + 1)}
        for count, is_halted in ((MAX_STOPS, True), (MAX_STOPS - 1, False)):
            robot = {"name": "dog1", "capabilities": {"base2d": {}}, "status": "IDLE", "obeys": STANDS_STILL}
            view = _make_stop_view(stops, [{**robot, "stops": sorted(stops)[:count]}])
            self.assertEqual(view["halted"], is_halted)
            self.assertEqual(view["halt"]["standing"], ["dog1"] if is_halted else [])
