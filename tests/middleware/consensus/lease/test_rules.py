"""Tests of the rules of leases and fencing tokens; the name of each test contains the number of its rule."""

from __future__ import annotations

from twisted.internet.defer import Deferred

from drivers.driver import Permit
from drivers.errors import StaleCommand
from drivers.gate import Gate
from middleware.consensus.lease.lease_client import CLOCK_MARGIN, RENEWALS_PER_TTL
from middleware.consensus.lease.lease_proposer import LeaseHeld, NoMajority, Superseded
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.kademlia.distance import select_closest
from middleware.entangled.record import Record
from middleware.tasks.task import COMPLETED, RESULT, Result, Task, find_outcome, group_key
from sim.team.machine import Machine
from tests.fleet import FleetCase
from tests.middleware.consensus.lease.room import TTL, LeaseCase, T


class PinnedTests(FleetCase):
    def test_rule_1_council_is_pinned(self) -> None:
        """The council of a task is the three nodes closest to its key at its creation.

        It stays the same if closer nodes join later.
        """
        fleet = self.swarm(4)
        task = self.done(fleet, Deferred.fromCoroutine(fleet.nodes[0].submit(Task("t1", "search", "Find it"))), 1.0)
        key = group_key("t1")
        contacts = [node.entangled.contact for node in fleet.nodes]
        self.assertEqual(list(task.council), select_closest(contacts, key, 3))
        client = fleet.nodes[1].make_lease_client(task, lambda: None, 0)
        for place in range(4, 9):
            fleet.nodes.append(fleet.make_node(place))
            fleet.nodes[place].startService()
            fleet.run(0.5)
        now_closest = select_closest([node.entangled.contact for node in fleet.nodes], key, 3)
        self.assertNotEqual(list(task.council), now_closest)
        self.assertEqual(client.proposer.members, task.council)


class RuleTests(LeaseCase):
    def test_rule_2_council_changes_by_a_majority_of_the_old_one(self) -> None:
        """A majority of the old council decides a change, but never while a claim is open.

        The new council has the next configuration number.
        """
        council = self.client(1).proposer
        following = [self.room.contacts[n] for n in (0, 1, 2)]
        self.wanting(0)
        self.assertIsInstance(self.outcome(council.change_members(following)), LeaseHeld)
        self.client(0).release()
        self.run_for(0.1)
        self.cut(1, 3, 4)
        self.assertIsInstance(self.outcome(council.change_members(following)), NoMajority)
        self.room.radio.cut.clear()
        self.assertIsNone(self.outcome(council.change_members(following)))
        self.assertEqual((council.configuration, list(council.members)), (2, following))

    def test_rule_3_durations_travel_never_times(self) -> None:
        """Nodes with different clocks work together, because messages contain durations and never times of a clock."""
        sent: list[float] = []
        for bidder in self.room.nodes:
            answer = bidder.answer

            def heard(source: int, method: str, arguments: tuple[object, ...], answer=answer) -> object:  # type: ignore[no-untyped-def]
                reply = answer(source, method, arguments)
                sent.extend(x for x in (*arguments, *(reply if isinstance(reply, list) else ())) if type(x) is float)
                return reply

            bidder.answer = heard  # type: ignore[method-assign]
        clocks = [bidder.machine.seconds() for bidder in self.room.nodes]
        self.assertGreater(max(clocks) - min(clocks), 100.0)
        self.client(1).stand_by()
        self.wanting(0, 3 * TTL)
        self.assertEqual(self.holders(), [0])
        self.assertLessEqual(max(sent), TTL)

    def test_rule_4_token_outlives_restarts(self) -> None:
        """Each lease has a higher token than all earlier leases, even if every member restarts between two leases."""
        tokens = []
        for place in (0, 1, 2, 0):
            self.wanting(place)
            tokens.append(self.token(place))
            self.client(place).release()
            self.run_for(0.1)
            for member in range(self.room.n):
                self.room.kill(member)
                self.room.nodes[member] = self.room.start_life(member)
            self.run_for(0.1)
        self.assertEqual(tokens, sorted(set(tokens)))

    def test_rule_4_restarted_member_keeps_silent(self) -> None:
        """A member that lost its store grants nothing for the maximum TTL.

        A member with its store grants immediately.
        """
        for is_lost in (True, False):
            self.room = self.made(seed=f"silent {is_lost}")
            self.wanting(0)
            self.run_for(1.0)
            for member in (3, 4):
                self.room.kill(member)
                if is_lost:
                    self.room.stores[member] = MemoryStore()
                self.room.nodes[member] = self.room.start_life(member)
            self.client(0).release()
            self.wanting(1, 0.2)
            self.assertEqual(self.holders(), [] if is_lost else [1])
            self.run_for(TTL)
            self.assertEqual(self.holders(), [1])

    def test_rule_5_deadline_counts_from_the_sending(self) -> None:
        """The deadline counts from the sending of the request, not from its answers.

        It is the send time + TTL x (1 - 2 rho) - the stopping time.
        """
        self.room = self.made(stop_time=0.3)
        client = self.client(0)
        self.wanting(0)
        lease = client.lease
        assert lease is not None
        asked_at: list[float] = []
        member = self.room.nodes[3].machine
        take = member.deliver_datagram
        member.deliver_datagram = lambda *a: (asked_at.append(self.room.nodes[0].machine.seconds()), take(*a))[1]  # type: ignore[func-returns-value,method-assign]
        self.run_for(TTL / RENEWALS_PER_TTL)
        renewed = client.lease
        assert renewed is not None
        sent = renewed.deadline - TTL * (1.0 - CLOCK_MARGIN) + 0.3
        self.assertLess(sent, asked_at[0])
        self.assertGreater(sent, asked_at[0] - 0.02)

    def test_rule_5_next_one_starts_when_the_robot_stands(self) -> None:
        """The next holder never starts before the previous robot stands still, with clocks that differ by 1 %."""
        for stop_time in (0.0, 0.4):
            self.room = self.made(stop_time, [0.99, 1.01, 1.0, 1.01, 1.01, 1.01, 1.0])
            client = self.wanting(0, 1.0)
            self.client(1).stand_by()
            self.run_for(TTL)
            lease = client.lease
            assert lease is not None
            self.cut(0, 3, 4, 5)
            ends = 0.0
            while not self.client(1).lease:
                now = client.lease
                ends = self.room.nodes[0].machine.to_simulator_time(now.deadline) if now else ends
                self.run_for(0.005)
            self.assertGreaterEqual(self.room.clock.seconds() + 0.001, ends + stop_time)
            self.assertEqual(self.room.recorder.violations, [])

    def test_rule_6_stand_by_asks_when_pushes_are_lost(self) -> None:
        """A standby takes over without a notice of the release, because it polls the council three times per TTL."""
        self.wanting(0)
        self.client(1).stand_by()
        self.run_for(TTL)
        self.room.notify = lambda *_: None  # type: ignore[method-assign]
        self.client(0).release()
        self.run_for(TTL / RENEWALS_PER_TTL + 0.1)
        self.assertEqual(self.holders(), [1])

    def test_rule_6_renewed_three_times_a_ttl(self) -> None:
        """A lease survives two lost rounds of renewal."""
        self.wanting(0)
        for _ in range(20):
            lease = self.client(0).lease
            assert lease is not None
            self.cut(0, 3, 4, 5)
            self.run_for(TTL * 0.55)
            self.room.radio.cut.clear()
            self.run_for(TTL * 0.45)
        self.assertEqual(self.token(0), 1)

    def test_rule_7_suspended_holder_knows_that_time_has_passed(self) -> None:
        """A holder that resumes after a suspension has no lease, sends nothing, and counts one pause."""
        client = self.wanting(0, 1.0)
        self.client(1).stand_by()
        self.run_for(0.2)
        self.room.nodes[0].machine.freeze(is_suspended=True)
        self.run_for(4 * TTL)
        accepted = len(self.room.recorder.accepted[T])
        self.room.nodes[0].machine.thaw()
        self.assertIsNone(client.lease)
        self.run_for(1.0)
        self.assertEqual((self.holders(), client.late_timer_count), ([1], 1))
        self.assertEqual({place for _, _, place in self.room.recorder.accepted[T][accepted:]}, {1})
        self.assertEqual(self.room.recorder.violations, [])

    def test_rule_7_clock_that_stands_still_is_not_enough(self) -> None:
        """With a clock that stops during a suspension, a holder would wrongly assume that its old lease is valid."""
        self.patch(Machine, "COUNTS_SUSPENSION", False)
        client = self.wanting(0, 1.0)
        self.room.nodes[0].machine.freeze(is_suspended=True)
        self.run_for(4 * TTL)
        self.assertIsNotNone(client.lease)

    def test_rule_8_device_refuses_lower_tokens_and_stops_by_itself(self) -> None:
        """A device rejects a lower token from any sender, and its gate ends a motion at the deadline."""
        gate = Gate()
        gate.admit(Permit(2, 5.0), 4.0)
        self.assertRaises(StaleCommand, gate.admit, Permit(1, 9.0), 4.1)
        self.assertRaises(StaleCommand, gate.admit, Permit(3, 4.0), 4.1)
        self.assertEqual((gate.is_motion_over(4.9), gate.is_motion_over(5.0)), (False, True))

    def test_rule_9_the_end_carries_the_token(self) -> None:
        """A former holder cannot close the task under its old token.

        Of two results, the one with the higher token wins.
        """
        self.wanting(0)
        self.client(0).release()
        self.wanting(1)
        stale = self.client(0).proposer.close(1)
        self.assertIsInstance(self.outcome(stale), Superseded)
        self.assertEqual(self.holders(), [1])
        self.assertIsNone(self.outcome(self.client(1).proposer.close(2)))
        self.assertEqual(self.holders(), [])
        results = [Result(COMPLETED, "dog1", 1.0, 2), Result(COMPLETED, "dog0", 1.0, 1)]
        records = [
            Record(group_key(T), RESULT, bytes([n]) * 32, 1, "team", 0.0, result.pack(), bytes(64))
            for n, result in enumerate(results)
        ]
        for told in (records, records[::-1]):
            self.assertEqual(find_outcome(Task(T, "search", "Find it"), told), results[0])

    def test_rule_10_graceful_leave(self) -> None:
        """After a release the first standby acts within 0.2 s plus the stopping time."""
        for stop_time in (0.0, 0.4):
            self.room = self.made(stop_time)
            self.wanting(0)
            self.client(2).stand_by(2)
            self.client(1).stand_by(1)
            self.run_for(TTL)
            self.room.nodes[0].leave(T)
            self.run_for(max(0.0, stop_time - 0.01))
            self.assertEqual(self.holders(), [])
            self.run_for(0.05)
            self.assertEqual(self.holders(), [1])
            self.assertEqual(self.room.recorder.violations, [])

    def test_rule_11_suspicion_shortens_no_lease(self) -> None:
        """A standby that suspects the holder does not shorten the lease, but is ready when the lease ends."""
        self.wanting(0)
        self.client(1).stand_by()
        for _ in range(40):
            self.client(1).suspect_holder()
            self.run_for(0.1)
        self.assertEqual((self.holders(), self.token(0)), ([0], 1))
        self.room.kill(0)
        self.client(1).suspect_holder()
        self.run_for(TTL - 0.6)
        self.assertIsNone(self.client(1).lease)
        self.run_for(0.7)
        self.assertIsNotNone(self.client(1).lease)
