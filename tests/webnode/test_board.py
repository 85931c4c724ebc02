"""What the twins of ``webnode.board`` promise."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from webnode.board import (
    AUDITED,
    Board,
    Entry,
    Knob,
    MemoryAudit,
    MemoryChronicle,
    MemoryFallbacks,
    MemoryHalts,
    MemoryPhones,
    MemoryTuning,
    NoLimits,
    OpenSessions,
    Page,
    Visitor,
)
from webnode.desk import MemoryDesk
from webnode.errors import Refusal


class TwinTests(SynchronousTestCase):
    def test_let_everybody_in(self) -> None:
        """Open sessions make an operator of whoever comes, with or without a token."""
        sessions = OpenSessions()
        token = self.successResultOf(sessions.sign_in("whatever", "10.0.0.9", 5.0))
        sessions.revoke(sessions.visitor(token.text, 6.0).token_id)
        self.assertEqual([sessions.visitor(each, 7.0).role for each in (token.text, "")], ["operator"] * 2)
        self.assertGreater(token.until, 5.0)

    def test_audit_keeps_the_newest(self) -> None:
        """The audit in memory gives the newest first, and forgets the oldest."""
        audit = MemoryAudit()
        for number in range(AUDITED + 5):
            audit.note(Visitor("ann", "operator"), "10.0.0.9", "POST /x", str(number), "202")
        self.assertEqual([line["target"] for line in audit.newest(2)], [str(AUDITED + 4), str(AUDITED + 3)])
        self.assertEqual(len(audit.newest(10_000)), AUDITED)

    def test_chronicle_tells_what_is_newer(self) -> None:
        """Entries are told from a number on, all or those about one device or task."""
        chronicle = MemoryChronicle()
        chronicle.entries = [Entry(1, 5.0, "joined", "01", "", "dog1 joined"), Entry(2, 6.0, "task", "02", "t1", "go")]
        chronicle.faulted("01", "kill", 7.0)
        numbers = [[entry.n for entry in chronicle.since(*asked)] for asked in ((0, ""), (1, ""), (0, "01"), (0, "t1"))]
        self.assertEqual(numbers, [[1, 2], [2], [1], [2]])
        self.assertEqual(chronicle.faults, [("01", "kill", 7.0)])

    def test_fallbacks_let_in_their_pages(self) -> None:
        """A page of another web node is let in where it is known, and no other."""
        fallbacks = MemoryFallbacks(Page("02", "http://10.0.0.2:8080"))
        self.assertEqual([page.node for page in fallbacks.here()], ["02"])
        self.assertTrue(fallbacks.lets_in("http://10.0.0.2:8080"))
        self.assertFalse(fallbacks.lets_in("http://10.0.0.2:8081"))

    def test_phones_in_memory_are_counted(self) -> None:
        """The twin of the gateway knows a phone by its secret, takes looks of those that are here, and so many."""
        phones = MemoryPhones(most=1)
        uuid = self.successResultOf(phones.join(b"1" * 32, "anna", {}))
        self.assertEqual(self.successResultOf(phones.join(b"1" * 32, "anna", {})), uuid)
        self.failureResultOf(phones.join(b"2" * 32, "ben", {}), Refusal)
        self.assertGreater(phones.look(uuid, b"jpeg", {"target.distance": 1.0}).fps, 0.0)
        self.assertEqual(phones.looks, [(uuid, b"jpeg", {"target.distance": 1.0})])
        phones.leave(uuid)
        phones.leave(uuid)
        self.assertEqual(self.assertRaises(Refusal, phones.look, uuid, b"jpeg", {}).status, 404)
        self.successResultOf(phones.join(b"2" * 32, "ben", {}))
        self.successResultOf(phones.close())
        self.assertEqual(phones.here, {})

    def test_team_in_memory_obeys(self) -> None:
        """The twin of the stop has all its devices stand and go on, and knows which was said last."""
        halts = MemoryHalts("01", "02")
        self.assertFalse(halts.is_halted())
        self.assertEqual(self.successResultOf(halts.halt("ann")), {"01": "stands", "02": "stands"})
        self.assertTrue(halts.is_halted())
        self.assertEqual(self.successResultOf(halts.release("bob")), {"01": "goes on", "02": "goes on"})
        self.assertFalse(halts.is_halted())

    def test_settings_in_memory(self) -> None:
        """The twin of the settings takes what a device has, and refuses the rest by its key."""
        tuning = MemoryTuning({"01": [Knob("description", "a dog", "A line")]})
        self.assertEqual(self.successResultOf(tuning.settings("02")), [])
        (knob,) = self.successResultOf(tuning.change("01", {"description": "lame"}))
        self.assertEqual(knob.value, "lame")
        self.assertEqual(self.failureResultOf(tuning.change("01", {"colour": "red"}), Refusal).value.field, "colour")

    def test_board_says_what_it_has(self) -> None:
        """What a node lacks is not said to the page; a yard counts where there is one."""
        bare = Board(MemoryDesk(), OpenSessions())
        self.assertEqual(bare.has, [])
        NoLimits().count("stream", "10.0.0.9", 1)
        self.assertTrue(NoLimits().may("stream", "10.0.0.9"))
        self.assertEqual(NoLimits().total("stream"), 0)
        yard = MemoryDesk(yard={"walls": [3.0, 2.4], "dogs": [], "target": None})
        self.assertEqual(Board(yard, OpenSessions()).has, ["yard"])
