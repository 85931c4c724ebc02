"""What the twins of ``webnode.board`` promise."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from tests.webnode.memory import MemoryDesk
from webnode.board import (
    AUDITED,
    Board,
    Entry,
    MemoryAudit,
    MemoryChronicle,
    MemoryFallbacks,
    NoLimits,
    OpenSessions,
    Page,
    Visitor,
)


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

    def test_board_says_what_it_has(self) -> None:
        """What a node lacks is not said to the page; a yard counts where there is one."""
        bare = Board(MemoryDesk(), OpenSessions())
        self.assertEqual(bare.has, [])
        NoLimits().count("stream", "10.0.0.9", 1)
        self.assertTrue(NoLimits().may("stream", "10.0.0.9"))
        self.assertEqual(NoLimits().total("stream"), 0)
        yard = MemoryDesk(yard={"walls": [3.0, 2.4], "dogs": [], "target": None})
        self.assertEqual(Board(yard, OpenSessions()).has, ["yard"])
