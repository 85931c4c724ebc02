"""Tests of ``middleware.consensus.lease.acceptor``."""

from __future__ import annotations

import math

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.lease.acceptor import IDLE_AGE_S, MAX_LISTENERS, LeaseAcceptor
from middleware.consensus.lease.lease_codec import BALLOT_MODULUS, CODEC
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.quorum import acceptor_log
from middleware.entangled.quorum.ballot import Ballot
from middleware.entangled.quorum.register import Reply, ReplyKind
from tests.middleware.consensus.lease.test_lease_codec import MEMBERS

TTL = 2.0


def ballot(number: int, agent: str) -> Ballot:
    """Return a ballot of an agent that was never restarted."""
    return Ballot(number * BALLOT_MODULUS, agent)


class AcceptorTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.acceptor = LeaseAcceptor(MemoryStore(), -math.inf)

    def prepare(self, number: int, agent: str, now: float, configuration: int = 1) -> Reply:
        """Send a prepare request."""
        return self.acceptor.prepare("t", configuration, ballot(number, agent), TTL, now)

    def propose(self, number: int, agent: str, token: int, now: float, configuration: int = 1) -> Reply:
        """Send a lease proposal."""
        return self.acceptor.lease("t", configuration, ballot(number, agent), token, TTL, now)

    def test_promise_for_the_time_after_a_lease(self) -> None:
        """Near the end of a lease another proposer gets a promise for the time after this end, but no grant."""
        self.prepare(1, "a", 0.0)
        self.propose(1, "a", 1, 0.0)
        self.assertEqual(self.prepare(2, "b", 1.5).kind, ReplyKind.HELD)
        self.assertEqual(self.prepare(0, "b", 1.75).kind, ReplyKind.HELD)
        promised = self.prepare(2, "b", 1.75)
        self.assertEqual((promised.kind, promised.remaining, promised.token), (ReplyKind.GRANTED, 0.25, 1))
        self.assertEqual(self.propose(2, "b", 2, 1.99).kind, ReplyKind.HELD)
        self.assertEqual(self.propose(2, "b", 2, 2.0).kind, ReplyKind.GRANTED)

    def test_promise_ends_no_lease(self) -> None:
        """A holder can renew its lease despite another proposer's promise, but cannot claim a new lease."""
        self.prepare(1, "a", 0.0)
        self.propose(1, "a", 1, 0.0)
        self.prepare(2, "b", 1.75)
        self.assertEqual(self.propose(1, "a", 2, 1.8).kind, ReplyKind.OUTBID)
        self.assertEqual(self.propose(1, "a", 1, 1.8).kind, ReplyKind.GRANTED)
        self.assertEqual(self.propose(2, "b", 2, 2.0).kind, ReplyKind.HELD)
        self.acceptor.release_by_ballot("t", ballot(2, "b"), 2.1)
        self.assertEqual(self.propose(1, "a", 1, 2.2).kind, ReplyKind.GRANTED)
        self.assertEqual(self.propose(2, "b", 2, 4.3).kind, ReplyKind.OUTBID)
        self.assertEqual(self.prepare(3, "b", 4.3).kind, ReplyKind.GRANTED)

    def test_former_life_is_another(self) -> None:
        """A restarted agent must wait for the end of its previous lease, because its robot may still move."""
        self.prepare(1, "a", 0.0)
        self.propose(1, "a", 1, 0.0)
        self.assertEqual(
            self.acceptor.prepare("t", 1, Ballot(9 * BALLOT_MODULUS + 5, "a"), TTL, 1.0).kind, ReplyKind.HELD
        )

    def test_release(self) -> None:
        """After a release the lease is free immediately and waiting proposers are notified.

        A late proposal does not restore the lease.
        """
        self.prepare(1, "a", 0.0)
        self.propose(1, "a", 1, 0.0)
        self.prepare(2, "b", 0.5)
        self.prepare(2, "c", 0.5)
        self.assertEqual(self.acceptor.release_by_ballot("t", ballot(1, "a"), 1.0), ["b", "c"])
        self.assertEqual(self.acceptor.release_by_ballot("t", ballot(1, "a"), 1.0), [])
        self.assertEqual(self.propose(1, "a", 1, 1.0).kind, ReplyKind.OUTBID)
        self.assertEqual(self.prepare(2, "b", 1.0).kind, ReplyKind.GRANTED)

    def test_release_before_the_robot_rests(self) -> None:
        """If the robot still moves at a release, others get a promise immediately, and a grant when it stands still."""
        self.prepare(1, "a", 0.0)
        self.propose(1, "a", 1, 0.0)
        self.prepare(2, "b", 0.5)
        self.assertEqual(self.acceptor.release_by_ballot("t", ballot(1, "a"), 1.0, 0.2), ["b"])
        promised = self.prepare(2, "b", 1.05)
        self.assertEqual((promised.kind, round(promised.remaining, 3)), (ReplyKind.GRANTED, 0.15))
        early = self.propose(2, "b", 2, 1.15)
        self.assertEqual((early.kind, round(early.remaining, 3)), (ReplyKind.HELD, 0.05))
        self.assertEqual(self.propose(1, "a", 1, 1.16).kind, ReplyKind.OUTBID)
        self.assertEqual(self.propose(2, "b", 2, 1.2).kind, ReplyKind.GRANTED)

    def test_change_by_the_holder(self) -> None:
        """If a holder changes the council, no member of the old or the next council grants to others for one TTL."""
        self.prepare(1, "a", 0.0)
        self.propose(1, "a", 1, 0.0)
        self.prepare(2, "a", 0.1)
        self.assertEqual(
            self.acceptor.accept("t", 1, ballot(2, "a"), MEMBERS[:3], 0.1, 1, True).kind, ReplyKind.GRANTED
        )
        self.assertEqual(self.prepare(3, "b", 0.2).kind, ReplyKind.HELD)
        self.assertEqual(self.propose(2, "a", 1, 0.2).kind, ReplyKind.SEALED)
        self.acceptor.install("t", 2, MEMBERS[:3], 1, 0.3, ballot(2, "a"), TTL)
        self.assertEqual(self.acceptor.prepare("t", 2, ballot(3, "b"), TTL, 1.0).kind, ReplyKind.HELD)
        self.assertEqual(self.acceptor.prepare("t", 2, ballot(3, "b"), TTL, 0.2 + TTL).kind, ReplyKind.GRANTED)
        self.assertEqual(self.acceptor.lease("t", 2, ballot(3, "b"), 2, TTL, 0.2 + TTL).kind, ReplyKind.HELD)
        self.assertEqual(self.acceptor.prepare("t", 2, ballot(4, "a"), TTL, 0.4).kind, ReplyKind.GRANTED)
        self.assertEqual(self.acceptor.prepare("t", 2, ballot(5, "b"), TTL, 0.3 + TTL).kind, ReplyKind.GRANTED)

    def test_release_that_overtakes_its_proposal(self) -> None:
        """If the release of a ballot arrives before the proposal with this ballot, the proposal is not granted."""
        self.prepare(1, "a", 0.0)
        self.acceptor.release_by_ballot("t", ballot(1, "a"), 0.1)
        self.assertEqual(self.propose(1, "a", 1, 0.2).kind, ReplyKind.OUTBID)
        self.assertEqual(self.prepare(2, "a", 0.3).kind, ReplyKind.GRANTED)

    def test_release_of_an_older_ballot_too(self) -> None:
        """The release of an agent's latest ballot also releases all its older ballots, in any order of arrival."""
        for proposes_first in (True, False):
            self.setUp()
            self.prepare(1, "a", 0.0)
            self.propose(1, "a", 1, 0.0)
            self.prepare(2, "a", 0.1)
            if proposes_first:
                self.propose(2, "a", 1, 0.2)
            self.acceptor.release_by_ballot("t", ballot(2, "a"), 0.3)
            self.assertEqual(self.propose(2, "a", 1, 0.4).kind, ReplyKind.OUTBID)
            self.acceptor.release_by_ballot("t", ballot(1, "a"), 0.5)
            self.assertEqual(self.prepare(3, "b", 0.6)[:4:3], (ReplyKind.GRANTED, 0.0))

    def test_freed(self) -> None:
        """Another member's notice of a release is accepted only if it names the holder and the token of the lease."""
        self.prepare(1, "a", 0.0)
        self.propose(1, "a", 1, 0.0)
        for agent, token in (("b", 1), ("a", 0), ("a", 2)):
            self.assertEqual(self.acceptor.release_by_token("t", agent, token, 0.5), [])
            self.assertEqual(self.prepare(2, "b", 0.5).kind, ReplyKind.HELD)
        self.assertEqual(self.acceptor.release_by_token("t", "a", 1, 0.5, 0.1), ["b"])
        self.assertEqual(self.propose(1, "a", 1, 0.55).kind, ReplyKind.OUTBID)
        self.assertEqual(self.prepare(2, "b", 0.6).kind, ReplyKind.GRANTED)
        self.assertEqual(self.acceptor.release_by_token("u", "a", 1, 0.5), [])

    def test_listeners_are_bounded(self) -> None:
        """The number of waiting proposers is limited; the most recent proposers are notified."""
        self.prepare(1, "a", 0.0)
        self.propose(1, "a", 1, 0.0)
        for number in range(3 * MAX_LISTENERS):
            self.prepare(2, f"b{number:03d}", 0.5)
        told = self.acceptor.release_by_ballot("t", ballot(1, "a"), 1.0)
        self.assertEqual((len(told), told[-1]), (MAX_LISTENERS, f"b{3 * MAX_LISTENERS - 1:03d}"))

    def test_no_room(self) -> None:
        """An acceptor that has no space for a further task answers QUIET and grants nothing."""
        self.patch(acceptor_log, "MAX_REGISTERS", 1)
        self.prepare(1, "a", 0.0)
        for reply in (
            self.acceptor.prepare("u", 1, ballot(1, "a"), TTL, 0.0),
            self.acceptor.lease("u", 1, ballot(1, "a"), 1, TTL, 0.0),
            self.acceptor.close("u", "a", 1, 0, 0.0),
            self.acceptor.install("u", 2, MEMBERS[:3], 0, 0.0),
        ):
            self.assertEqual(reply.kind, ReplyKind.QUIET)
            self.assertGreater(reply.remaining, 0.0)

    def test_close_after_release(self) -> None:
        """The last holder may close the task under its token after its release, also across a restart."""
        store = MemoryStore()
        self.acceptor = LeaseAcceptor(store, -math.inf)
        self.propose(1, "a", 3, 0.0)
        self.acceptor.release_by_ballot("t", ballot(1, "a"), 0.5)
        self.propose(2, "b", 4, 0.5)
        self.acceptor.release_by_ballot("t", ballot(2, "b"), 1.0)
        self.acceptor = LeaseAcceptor(store, -math.inf)
        kinds = [self.acceptor.close("t", "a", 1, token, 1.0).kind for token in (3, 4)]
        self.assertEqual(kinds, [ReplyKind.OUTBID, ReplyKind.BEHIND])
        self.assertEqual(self.acceptor.close("t", "b", 1, 4, 1.0).kind, ReplyKind.OVER)

    def test_close_under_a_token_of_others(self) -> None:
        """An acceptor that did not grant a token does not sign that a task ended under this token."""
        self.propose(1, "a", 3, 0.0)
        self.acceptor.accept("t", 1, ballot(2, "b"), MEMBERS, 3.0, 5)
        self.assertEqual(
            [self.acceptor.close("t", agent, 1, 5, 3.0).kind for agent in ("a", "b")], [ReplyKind.BEHIND] * 2
        )

    def test_close(self) -> None:
        """After a close the acceptor grants and renews nothing; the reply contains the remaining time of the lease."""
        self.prepare(1, "a", 0.0)
        self.propose(1, "a", 3, 0.0)
        self.assertEqual(self.acceptor.close("t", "b", 1, 2, 0.5).kind, ReplyKind.OUTBID)
        closed = self.acceptor.close("t", "b", 1, 0, 0.5)
        self.assertEqual((closed.kind, closed.remaining), (ReplyKind.OVER, 1.5))
        self.assertEqual(self.acceptor.close("t", "a", 1, 3, 0.5).remaining, 0.0)
        self.assertEqual(self.propose(1, "a", 3, 0.6).kind, ReplyKind.OVER)
        self.assertEqual(self.prepare(9, "b", 99.0).kind, ReplyKind.OVER)

    def test_change(self) -> None:
        """An accepted change seals the council.

        A reply contains the change, and after the decision the new council.
        """
        self.prepare(1, "a", 0.0)
        changed = self.acceptor.accept("t", 1, ballot(1, "a"), MEMBERS[:3], 0.0, 4)
        self.assertEqual(changed.kind, ReplyKind.GRANTED)
        self.assertEqual(self.propose(1, "a", 5, 0.1).kind, ReplyKind.SEALED)
        asked = self.prepare(2, "b", 0.1)
        self.assertEqual(
            (asked.kind, asked.accepted, asked.value, asked.token), (ReplyKind.SEALED, ballot(1, "a"), MEMBERS[:3], 4)
        )
        self.assertEqual(self.acceptor.accept("t", 1, ballot(1, "a"), MEMBERS[:2], 0.2, 4).kind, ReplyKind.OUTBID)
        installed = self.acceptor.install("t", 2, MEMBERS[:3], 4, 0.3, proof=b"proof")
        self.assertEqual(installed.kind, ReplyKind.GRANTED)
        told = self.prepare(3, "b", 0.4)
        self.assertEqual((told.kind, told.configuration, told.proof), (ReplyKind.MOVED, 2, b"proof"))
        self.assertEqual(self.prepare(3, "b", 0.4, configuration=2).kind, ReplyKind.GRANTED)
        self.assertEqual(self.propose(3, "b", 4, 0.4, configuration=2).kind, ReplyKind.OUTBID)
        self.assertEqual(self.propose(3, "b", 5, 0.4, configuration=2).kind, ReplyKind.GRANTED)

    def test_promise_survives_a_restart(self) -> None:
        """A promise survives a restart; an acceptor with a corrupt stored entry grants nothing."""
        store = MemoryStore()
        LeaseAcceptor(store, -math.inf).prepare("t", 1, ballot(2, "a"), TTL, 0.0)
        self.acceptor = LeaseAcceptor(store, 50.0)
        self.assertEqual(self.prepare(1, "b", 51.0).kind, ReplyKind.OUTBID)
        self.acceptor.accept("t", 1, ballot(2, "a"), MEMBERS[:3], 51.0)
        self.acceptor = LeaseAcceptor(store, 60.0)
        self.assertEqual(self.prepare(3, "b", 61.0).kind, ReplyKind.SEALED)
        store.set_note(CODEC.bucket_of("t"), b"rotten")
        self.acceptor = LeaseAcceptor(store, 50.0)
        self.assertEqual(self.prepare(1, "b", 51.0).kind, ReplyKind.QUIET)

    def test_forgotten(self) -> None:
        """After a task was evicted, a lower bound for later ballots and tokens remains, also after a restart."""
        self.patch(acceptor_log, "MAX_REGISTERS", 1)
        store = MemoryStore()
        self.acceptor = LeaseAcceptor(store, -math.inf)
        self.prepare(2, "b", 0.0)
        self.propose(2, "b", 5, 0.0)
        self.assertEqual(self.acceptor.prepare("u", 1, ballot(9, "a"), TTL, 0.9 * IDLE_AGE_S).kind, ReplyKind.QUIET)
        self.assertEqual(self.acceptor.prepare("u", 1, ballot(9, "a"), TTL, 1.1 * IDLE_AGE_S).kind, ReplyKind.GRANTED)
        self.patch(acceptor_log, "MAX_REGISTERS", 2)
        for acceptor in (self.acceptor, LeaseAcceptor(store, 1.2 * IDLE_AGE_S)):
            asked = acceptor.prepare("t", 1, ballot(2, "a"), TTL, 1.3 * IDLE_AGE_S)
            self.assertEqual((asked.kind, asked.token), (ReplyKind.OUTBID, 5))
