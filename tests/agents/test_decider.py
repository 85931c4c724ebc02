"""Tests of ``agents.decider``: the rounds of a task, and the reports that a decision takes into account."""

from __future__ import annotations

from dataclasses import replace

from twisted.trial.unittest import SynchronousTestCase

from agents.decider import DEPARTED_MEMORY_S, PeerReports, RoundCounter
from middleware.tasks.task import Member

B = Member("b", "dog2", "WAITING", 2.0, "a", "d1", epoch=3, serial=1)


class RoundCounterTests(SynchronousTestCase):
    def test_first_decision_opens_no_round(self) -> None:
        """The first decision opens no round; before it, a change of the inputs opens no round either."""
        epoch = RoundCounter()
        for basis in (("a",), ("a", "b")):
            self.assertEqual(epoch.determine_round(basis, "", "", ()), 0)
        self.assertEqual(epoch.determine_round(("a", "b", 1), "a", "d1", ()), 0)

    def test_change_after_a_decision_opens_a_round(self) -> None:
        """After a decision, each change of the inputs of the decision opens exactly one new round."""
        epoch = RoundCounter()
        epoch.determine_round((1,), "a", "d1", ())
        self.assertEqual([epoch.determine_round((n,), "a", "d1", ()) for n in (1, 2, 2, 3)], [0, 1, 1, 2])

    def test_same_decision_joins_the_round_of_another(self) -> None:
        """If another agent made the same decision in a newer round, the agent joins the newer round."""
        epoch = RoundCounter()
        epoch.determine_round((1,), "a", "d0", ())
        epoch.advance(3)
        self.assertEqual(epoch.determine_round((2,), "a", "d1", (B,)), 3)
        epoch.advance(5)
        self.assertEqual(epoch.determine_round((3,), "b", "d1", (replace(B, epoch=5),)), 6)


class PeerReportsTests(SynchronousTestCase):
    def costs(self, peer_reports: PeerReports, now: float) -> dict[str, float | None]:
        """Return the costs of the members at ``now``; None if a bid has expired."""
        return {member.uuid: member.cost for member in peer_reports.members(now)}

    def test_old_round_is_ignored(self) -> None:
        """A report of an older round is ignored, whenever it arrives; a report of a newer round is used."""
        peer_reports = PeerReports("a")
        peer_reports.update([B], 0.0)
        peer_reports.update([replace(B, cost=9.0, epoch=2, serial=7)], 1.0)
        self.assertEqual(self.costs(peer_reports, 1.0), {"b": 2.0})
        peer_reports.update([replace(B, cost=1.0, epoch=4, serial=0)], 2.0)
        self.assertEqual(self.costs(peer_reports, 2.0), {"b": 1.0})

    def test_who_left_is_forgotten_after_a_while(self) -> None:
        """A late report of a departed member is ignored.

        ``DEPARTED_MEMORY_S`` later, a restarted member is accepted.
        """
        peer_reports = PeerReports("a")
        peer_reports.update([B], 0.0)
        peer_reports.update([], 1.0)
        again = replace(B, epoch=0, serial=0)
        peer_reports.update([again], 1.5)
        self.assertEqual(len(peer_reports), 0)
        peer_reports.update([again], 1.0 + DEPARTED_MEMORY_S + 0.1)
        self.assertEqual(len(peer_reports), 1)

    def test_stale_report_is_no_bid(self) -> None:
        """A bid expires after its validity period minus its age on arrival.

        A report with a newer serial number renews the bid.
        """
        peer_reports = PeerReports("a")
        bid = replace(B, valid_for=3.0, age=1.0)
        peer_reports.update([bid], 10.0)
        self.assertEqual(self.costs(peer_reports, 12.0), {"b": 2.0})
        peer_reports.update([bid], 12.1)  # the same record has no effect
        self.assertEqual(self.costs(peer_reports, 12.1), {"b": None})
        peer_reports.update([replace(bid, serial=2)], 12.2)
        self.assertEqual(self.costs(peer_reports, 12.3), {"b": 2.0})

    def test_own_report_comes_back(self) -> None:
        """An agent does not count its own report from before its restart as the report of a member.

        The agent only continues the report's round and serial numbers.
        """
        peer_reports = PeerReports("b")
        peer_reports.update([B], 0.0)
        self.assertEqual((len(peer_reports), peer_reports.own_report), (0, B))
