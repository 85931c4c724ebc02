"""Tests of bidding in large teams on simulated links: number of messages, agreement, and failing links and nodes."""

from __future__ import annotations

import contextlib
import io

from twisted.trial.unittest import SynchronousTestCase

from benchmarks.bidding import BUSIEST, AuctionSimulation, LinkFaults, Outcome, main
from benchmarks.measure import percentile
from middleware.consensus.bidding.path_choice import DIRECT

AFTER = 4.0


def outcome(crowd: AuctionSimulation, until: float = AFTER) -> Outcome:
    """Run one auction of a simulated crowd and return its outcome."""
    crowd.run(until)
    return crowd.make_outcome()


class SmallTests(SynchronousTestCase):
    def test_three_agents(self) -> None:
        """At 10 % datagram loss three agents agree with at most ten messages each."""
        runs = [outcome(AuctionSimulation(3, seed, LinkFaults(0.1))) for seed in range(40)]
        self.assertEqual(min(run.right for run in runs), 1.0)
        self.assertLessEqual(sum(run.messages for run in runs) / len(runs), 10.0)

    def test_every_second_datagram_comes_twice(self) -> None:
        """Duplicated datagrams change nothing: there is one announcement, and every agent receives it."""
        crowd = AuctionSimulation(30, 2, LinkFaults(duplicate=0.5))
        self.assertEqual(outcome(crowd).right, 1.0)
        self.assertEqual({p.announcement and p.announcement.number for p in crowd.parties}, {1})

    def test_first_member_is_dead(self) -> None:
        """If the first member of the council has failed, the next member announces."""
        for seed in range(3):
            crowd = AuctionSimulation(12, seed, LinkFaults(0.1), way=DIRECT)
            crowd.dead.add(crowd._places[crowd.auction.council[0].node_id])
            crowd.best = crowd.find_right_winner()
            self.assertEqual(outcome(crowd, 8.0).right, 1.0)


class LargeTests(SynchronousTestCase):
    def test_hundred_agents(self) -> None:
        """At 10 % loss a hundred agents agree along the tree within 0.6 s, with at most six messages each."""
        runs = [outcome(AuctionSimulation(100, seed, LinkFaults(0.1))) for seed in range(5)]
        took = [t for run in runs for t in run.agreement_times]
        self.assertEqual(min(run.right for run in runs), 1.0)
        self.assertLessEqual(sum(run.messages for run in runs) / len(runs), 6.0)
        self.assertLessEqual(percentile(took, 0.95), 0.6)

    def test_thousand_agents(self) -> None:
        """A thousand agents agree within 0.8 s, with at most six messages each.

        No node exceeds its limit of messages.
        """
        run = outcome(AuctionSimulation(1_000, 3, LinkFaults(0.1)))
        self.assertEqual(run.right, 1.0)
        self.assertLessEqual(run.messages, 6.0)
        self.assertLessEqual(run.busiest, BUSIEST)
        self.assertLessEqual(percentile(run.agreement_times, 0.95), 0.8)

    def test_branch_dies_with_what_it_holds(self) -> None:
        """If a relay fails before it forwarded its bids, each bidder repeats its own bid, so no bid is lost."""
        for seed in range(3):
            crowd = AuctionSimulation(100, seed, LinkFaults(), spread=0.02)
            winner = crowd.costs.index(min(crowd.costs))
            carry = crowd._send_message

            def killing(place: int, message, crowd=crowd, winner=winner, carry=carry) -> None:  # type: ignore[no-untyped-def]
                carry(place, message)
                if place == winner and not crowd.dead:
                    # The first relay of the winning bid confirms it, and then fails.
                    to = crowd._places[message.to.node_id]
                    if crowd.auction.find_rank(message.to.node_id) is None:
                        crowd.schedule(crowd.now + 0.1, crowd.dead.add, to)

            crowd._send_message = killing  # type: ignore[method-assign]
            crowd.run(8.0)
            crowd.best = crowd.find_right_winner()
            self.assertEqual(crowd.make_outcome().right, 1.0)

    def test_announcement_is_lost_for_a_branch(self) -> None:
        """Bidders that receive no announcement send a query to the council."""
        crowd = AuctionSimulation(100, 4, LinkFaults())
        crowd.run(0.45)
        relays = [i for i, p in enumerate(crowd.parties) if len(p.recipients) and p._rank is None]
        crowd.dead.update(relays)
        crowd.best = crowd.find_right_winner()
        self.assertEqual(outcome(crowd, 8.0).right, 1.0)

    def test_replayed(self) -> None:
        """The same seed gives the same run, a different seed a different run."""
        first, same, other = (outcome(AuctionSimulation(60, seed, LinkFaults(0.1, 0.02))).digest for seed in (5, 5, 6))
        self.assertEqual(first, same)
        self.assertNotEqual(first, other)


class CutOffTests(SynchronousTestCase):
    def test_exclusive_without_a_council(self) -> None:
        """An exclusive task is not decided without its council."""
        crowd = AuctionSimulation(20, 1, LinkFaults(), council_is_dead=True)
        self.assertEqual(outcome(crowd, 6.0).right, 0.0)


class CommandTests(SynchronousTestCase):
    def test_command(self) -> None:
        """The command prints a table, and returns 0 if the targets are met."""
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            self.assertEqual(main(["--n", "3", "--loss", "0", "--dead", "0", "--runs", "1"]), 0)
        self.assertEqual(len(printed.getvalue().splitlines()), 2)
        self.assertTrue(printed.getvalue().rstrip().endswith("yes"))
