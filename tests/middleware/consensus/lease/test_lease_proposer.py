"""Tests of ``middleware.consensus.lease.lease_proposer``."""

from __future__ import annotations

from dataclasses import replace

from middleware.consensus.lease.lease_proposer import NoMajority, Superseded
from middleware.entangled.errors import Refused
from middleware.entangled.quorum.ballot import Ballot
from tests.middleware.consensus.lease.room import TTL, LeaseCase, T


class LeaseProposerTests(LeaseCase):
    def change(self, place: int, *members: int) -> object:
        """Return the result of a council change that an agent requests: None, or the error."""
        council = self.client(place).proposer
        return self.outcome(council.change_members([self.room.contacts[n] for n in members]))

    def places(self, place: int) -> list[int]:
        """Return the indexes of the council members, as known by an agent."""
        return [self.room.get_place(member) for member in self.client(place).proposer.members]

    def test_change(self) -> None:
        """A change installs the new council with the next configuration number; its next lease has a higher token."""
        self.wanting(0)
        self.client(0).release()
        self.run_for(0.1)
        self.assertIsNone(self.change(1, 3, 4, 6))
        self.assertEqual((self.places(1), self.client(1).proposer.configuration), ([3, 4, 6], 2))
        for gone in (3, 5):
            self.room.kill(gone)
        self.wanting(1, 1.0)
        self.assertEqual(self.token(1), 2)

    def test_who_knows_the_old_council_is_told(self) -> None:
        """A client that only knows the old council is redirected by any member, even by a former one."""
        self.assertIsNone(self.change(1, 0, 1, 2))
        self.assertEqual(self.places(2), [0, 1, 2])
        self.room.charters[T] = replace(self.room.charters[T], changes=())
        self.client(0)
        self.assertEqual(self.places(0), [3, 4, 5])
        self.wanting(0, 0.3)
        self.assertEqual((self.places(0), self.holders()), ([0, 1, 2], [0]))

    def test_member_that_was_away_is_told(self) -> None:
        """If a new council member was unreachable during the change, the next client that claims informs it."""
        self.cut(6, *range(6))
        self.assertIsNone(self.change(1, 3, 4, 6))
        self.room.radio.cut.clear()
        self.wanting(1)
        self.room.kill(3)
        self.run_for(3 * TTL)
        self.assertEqual(self.holders(), [1])

    def test_moved_by_the_holder(self) -> None:
        """A holder that changes its council gets the next lease there, with a higher token."""
        for stop_time in (0.0, 0.3):
            self.room = self.made(stop_time)
            self.wanting(0)
            self.client(1).stand_by(1)
            self.run_for(TTL)
            self.room.recorder.stop_robot(0, T)
            moved = self.client(0).change_council([self.room.contacts[n] for n in (3, 4, 6)])
            self.assertIsNone(self.client(0).lease)
            self.assertIsNone(self.outcome(moved, stop_time + 0.2))
            self.assertEqual((self.holders(), self.token(0)), ([0], 2))
            self.assertEqual((self.places(0), self.room.recorder.wins), ([3, 4, 6], 2))
            self.room.kill(5)
            self.run_for(TTL)
            self.room.kill(0)
            self.run_for(2 * TTL)
            self.assertEqual((self.holders(), self.places(1), self.room.recorder.violations), ([1], [3, 4, 6], []))

    def test_move_that_fails(self) -> None:
        """If a change of the council fails, the holder claims the lease again at the old council."""
        self.wanting(0)
        self.run_for(TTL)
        moved = self.client(0).change_council([self.room.contacts[n] for n in (1, 2, 6)])
        self.cut(0, 1, 2, 6)
        self.assertIsInstance(self.outcome(moved), NoMajority)
        self.run_for(TTL)
        self.room.radio.cut.clear()
        self.run_for(3 * TTL)
        self.assertEqual(self.holders(), [0])

    def test_silent_members_are_known(self) -> None:
        """The holder knows for each member the time since its last answer; an answer resets this time."""
        self.wanting(0)
        self.cut(4, *range(4), 5, 6)
        self.run_for(4.0)
        council = self.client(0).proposer
        self.assertEqual(
            (council.find_silent_members(3.0), council.find_silent_members(4.5)), ((self.room.contacts[4],), ())
        )
        self.room.radio.cut.clear()
        self.run_for(TTL)
        self.assertEqual(council.find_silent_members(0.0), ())
        self.client(0).release()
        self.cut(5, *range(5), 6)
        self.run_for(5.0)
        self.assertEqual(council.find_silent_members(3.0), ())
        for _ in range(3):
            council.ping_members()
            self.run_for(2.0)
        self.assertEqual(council.find_silent_members(3.0), (self.room.contacts[5],))

    def test_learnt_from_the_record(self) -> None:
        """A newer configuration in the task's record is adopted, and an older configuration is ignored."""
        council = self.client(0).proposer
        council.learn_charter(self.chartered([4, 5, 6], [0, 1, 2]).packed)
        for packed in (self.chartered([4, 5, 6]).packed, b"", b"?"):
            council.learn_charter(packed)
            self.assertEqual((council.configuration, self.places(0)), (3, [0, 1, 2]))

    def test_two_changes_at_once(self) -> None:
        """After two concurrent changes to different councils both clients have the same council."""
        for seed in range(12):
            self.room = self.made(seed=f"two {seed}")
            for place, members in ((0, (3, 4, 6)), (1, (5, 6, 2))):
                council = self.client(place).proposer
                council.change_members([self.room.contacts[n] for n in members]).addErrback(lambda f: f.trap(Refused))
            self.run_for(3.0)
            for place in (0, 1):
                self.wanting(place, 1.0)
                self.client(place).release()
                self.run_for(0.1)
            self.assertEqual(self.places(0), self.places(1))

    def test_change_that_was_half_done_is_completed(self) -> None:
        """A client that finds a change that was accepted but not finished completes it before it claims the lease."""
        self.cut(1, 6, 0, 2)
        council = self.client(1).proposer
        error = self.outcome(council.change_members([self.room.contacts[n] for n in (0, 2, 6)]))
        self.assertIsInstance(error, NoMajority)
        self.wanting(0, 0.5)
        self.assertEqual((self.places(0), self.holders()), ([0, 2, 6], [0]))

    def test_change_of_the_highest_ballot_is_completed(self) -> None:
        """Of two changes that one member each accepted, the change with the higher ballot is completed."""
        for place, council in ((4, (0, 2, 6)), (3, (1, 2, 6))):
            members = tuple(self.room.contacts[n] for n in council)
            acceptor, now = self.room.nodes[place].acceptor, self.room.nodes[place].machine.seconds()
            acceptor.accept(T, 1, Ballot(5 - place, "x"), members, now)
        self.cut(0, 5)
        self.assertIsInstance(self.change(0, 1, 3, 6), Superseded)
        self.assertEqual(self.places(0), [1, 2, 6])

    def test_another_change_came_first(self) -> None:
        """A change fails with ``Superseded`` if another change of the council was decided first."""
        self.client(2)
        self.assertIsNone(self.change(1, 3, 4, 6))
        self.assertIsInstance(self.change(2, 3, 5, 6), Superseded)
        self.assertEqual(self.places(2), [3, 4, 6])

    def test_strange_councils(self) -> None:
        """A council without members, or with too many members, raises ``ValueError``."""
        for members in ([], [self.room.contacts[0]] * 8):
            self.assertRaises(ValueError, self.client(0).proposer.change_members, members)

    def test_close_waits_for_whoever_may_still_act(self) -> None:
        """A close is acknowledged when a majority has stored it and the lease in force has expired."""
        self.wanting(0)
        self.cut(0, 3, 4, 5)
        closing = self.client(1).proposer.close()
        self.run_for(TTL - 0.3)
        self.assertNoResult(closing)
        self.run_for(0.4)
        self.assertIsNone(self.successResultOf(closing))
        self.assertEqual(self.holders(), [])
        for place in (1, 2):
            self.wanting(place, 1.0)
        self.assertEqual(self.holders(), [])

    def test_holder_closes_at_once(self) -> None:
        """A holder whose robot stands still closes the task without waiting for the end of the lease."""
        client = self.wanting(0)
        self.assertIsNone(self.outcome(client.proposer.close(self.token(0)), 0.05))
        self.wanting(1, 1.0)
        self.assertEqual((self.holders(), self.client(1).is_over), ([], True))

    def test_close_by_who_missed_a_change(self) -> None:
        """A client with an old council is redirected when it closes, and waits for the lease of the new council."""
        stale = self.client(0)
        self.assertIsNone(self.change(1, 3, 6, 2))
        self.wanting(1)
        self.assertEqual(self.holders(), [1])
        self.cut(0, 3)
        closing = stale.proposer.close()
        self.run_for(TTL - 0.3)
        self.assertNoResult(closing)
        self.run_for(0.5)
        self.assertIsNone(self.successResultOf(closing))
        self.assertEqual((self.holders(), self.client(1).is_over), ([], True))

    def test_close_without_a_majority(self) -> None:
        """A close that only a minority has stored is not acknowledged."""
        self.cut(0, 3, 4)
        self.assertIsInstance(self.outcome(self.client(0).proposer.close()), NoMajority)

    def test_change_after_the_end(self) -> None:
        """The council of a closed task cannot be changed."""
        self.outcome(self.client(0).proposer.close())
        error = self.change(1, 3, 4, 6)
        self.assertIsInstance(error, Refused)
        self.assertIn("the task has ended", str(error))
