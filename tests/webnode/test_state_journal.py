"""Tests of ``webnode.state_journal``."""

from __future__ import annotations

import random
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from webnode.state_journal import KEYS, MAX_CHANGES, Journal


def state(**devices: Any) -> dict[str, Any]:
    rows = [{"uuid": uuid, "status": status} for uuid, status in devices.items()]
    return {"node": "vaio", "devices": rows, "tasks": [], "groups": []}


def applied(known: dict[str, Any], content: Any) -> dict[str, Any]:
    """Return the state of a page after a change; each list becomes a table."""
    now = {name: dict(value) if name in KEYS else value for name, value in known.items()}
    for name, value in content.items():
        if name in KEYS:
            now[name] |= {row[KEYS[name]]: row for row in value}
        elif name != "without":
            now[name] = value
    for name, gone in content.get("without", {}).items():
        for each in gone:
            del now[name][each]
    return now


class JournalTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.journal = Journal("ab")

    def taken(self, *states: dict[str, Any]) -> Any:
        for each in states:
            change = self.journal.add_state(each)
        return None if change is None else change.content

    def test_tell_what_differs(self) -> None:
        """A change contains only new or different rows, and removed rows."""
        self.taken(state(a="IDLE", b="IDLE"))
        self.assertEqual(self.taken(state(a="DONE", b="IDLE")), {"devices": [{"uuid": "a", "status": "DONE"}]})
        self.assertEqual(self.taken(state(a="DONE")), {"devices": [], "without": {"devices": ["b"]}})
        self.assertEqual(self.taken({**state(a="DONE"), "halted": True}), {"halted": True})
        self.assertIsNone(self.taken({**state(a="DONE"), "halted": True}))

    def test_resume(self) -> None:
        """A page that sends its last id receives the later changes in order."""
        self.taken(state(a="IDLE"), state(a="DONE"), state(b="DONE"))
        missed = self.journal.list_since(self.journal.parse_event_id("ab-1"))
        self.assertEqual([change.n for change in missed or []], [2, 3])
        self.assertEqual(self.journal.list_since(self.journal.parse_event_id(self.journal.make_event_id(3))), [])

    def test_tell_all_after_a_gap(self) -> None:
        """If an id is too old, too high, invalid, or from another node or before a restart, the whole state is sent."""
        for n in range(MAX_CHANGES + 3):
            self.taken(state(a=n))
        for name in ("ab-1", "ab-2", "ac-60", "ab-999", "ab-", "ab-x", "ab--1", "", "ab-" + "9" * 40, "ab-²"):
            self.assertIsNone(self.journal.list_since(self.journal.parse_event_id(name)), name)
        self.assertEqual(len(self.journal.list_since(self.journal.parse_event_id("ab-3")) or []), MAX_CHANGES)

    def test_take_nothing_that_json_cannot_carry(self) -> None:
        """A state that is not valid JSON is rejected; the next change is relative to the last valid state."""
        self.taken(state(a="IDLE"))
        self.assertRaises(ValueError, self.journal.add_state, state(a=float("nan")))
        self.assertRaises(ValueError, self.journal.add_state, {**state(a="IDLE"), "halted": float("nan")})
        self.assertEqual((self.journal.n, self.taken(state(a="IDLE"))), (1, None))

    def test_end_where_the_state_is(self) -> None:
        """Any kept state plus its later changes gives the newest state."""
        dice = random.Random(5)
        known = []
        for _ in range(200):
            devices = {uuid: dice.choice(("IDLE", "DONE")) for uuid in "abcdef" if dice.random() < 0.7}
            now = {**state(**devices), "halted": dice.random() < 0.5}
            self.journal.add_state(now)
            tables = {name: {row[KEYS[name]]: row for row in now[name]} for name in KEYS}
            known.append((self.journal.n, {**now, **tables}))
        for n, before in known:
            missed = self.journal.list_since(n)
            if missed is not None:
                for change in missed:
                    before = applied(before, change.content)
                self.assertEqual(before, known[-1][1])
