"""Tests of traces."""

from __future__ import annotations

import io
import json

from twisted.trial.unittest import SynchronousTestCase

from sim.team.trace import Trace


class TraceTests(SynchronousTestCase):
    """Behaviour of ``Trace``."""

    def test_each_event_is_a_line_up_to_a_bound(self) -> None:
        """Head, events and end are one JSON object a line; beyond the bound they are only counted."""
        out = io.StringIO()
        trace = Trace(out, 2)
        trace.begin(seed=3)
        trace.told(1.25, "born", 0, "")
        trace.told(2.0, "fault", -1, "1: crash")
        trace.told(3.0, "killed", 0, "")
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
