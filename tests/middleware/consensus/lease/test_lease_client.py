"""Tests of ``middleware.consensus.lease.lease_client``."""

from __future__ import annotations

from middleware.consensus.lease.client_states import State
from middleware.entangled.data.memory import MemoryStore
from sim.team.leases.radio_link import LinkQuality
from sim.team.leases.takeover import measure_takeover, measure_upkeep
from tests.middleware.consensus.lease.room import TTL, LeaseCase, T


class LeaseClientTests(LeaseCase):
    def test_release_by_the_listener(self) -> None:
        """If a callback releases when the lease is lost, the claim ends and no further request is sent."""
        for lose in ("outrank", "cut"):
            self.room = self.made(seed=f"listener {lose}")
            client = self.wanting(0)
            client._on_change = lambda client=client: client.release() if not client.token else None  # type: ignore[misc]
            if lose == "outrank":
                client.on_higher_token(9)
            else:
                self.cut(0, 3, 4, 5)
                self.run_for(2 * TTL)
            self.assertEqual((client.state, client._round, client._timer), (State.IDLE, None, None), lose)
            self.run_for(2 * TTL)
            self.assertIs(client.state, State.IDLE, lose)

    def test_first_in_line_is_ready(self) -> None:
        """The first standby gets the lease as soon as the lease expires at a majority, and never earlier."""
        for seed in range(5):
            self.room = self.made(seed=f"ready {seed}")
            self.wanting(0)
            self.client(1).stand_by(1)
            self.run_for(TTL)
            self.room.kill(0)
            members = [self.room.nodes[place] for place in (3, 4, 5)]
            _, ends, _ = sorted(one.machine.to_simulator_time(one.acceptor.log.get(T).lease_until) for one in members)  # type: ignore[union-attr]
            self.run_for(ends - self.room.clock.seconds() - 0.001)
            self.assertIsNone(self.client(1).lease, seed)
            self.run_for(0.02)
            self.assertIsNotNone(self.client(1).lease, seed)

    def test_ready_for_a_lease_that_is_renewed(self) -> None:
        """A standby that has a promise does not take over if the holder returns before the lease ends."""
        self.wanting(0)
        self.client(1).stand_by(1)
        self.run_for(TTL)
        self.cut(0, 3, 4, 5)
        until = [self.room.nodes[place].acceptor.log.get(T).lease_until for place in (3, 4, 5)]  # type: ignore[union-attr]
        self.run_for(min(until) - self.room.nodes[3].machine.seconds() - 0.2)
        self.room.radio.cut.clear()
        self.run_for(2 * TTL)
        self.assertEqual((self.holders(), self.token(0)), ([0], 1))

    def test_place_in_the_line_that_changes(self) -> None:
        """If a standby's rank changes shortly before the lease ends, it claims at the time of the new rank."""
        for seed in range(5):
            self.room = self.made(seed=f"moved {seed}")
            self.wanting(0)
            self.client(1).stand_by(1)
            self.client(2).stand_by(2)
            self.run_for(TTL)
            self.room.kill(0)
            self.run_for(0.55 * TTL)
            self.client(1).stand_by(3)
            self.client(2).stand_by(1)
            self.run_for(0.45 * TTL + 0.1)
            self.assertEqual(self.holders()[-1:], [2], seed)

    def test_place_in_the_line_that_changes_after_a_release(self) -> None:
        """A standby that has not heard from a majority claims after a release, even if its rank changes."""
        self.cut(1, 4, 5)
        self.client(1).stand_by(3)
        self.run_for(1.5 * TTL)
        self.client(1).on_released(0)
        self.run_for(0.35)
        self.client(1).stand_by(2)
        self.room.radio.cut.clear()
        self.run_for(0.2)
        self.assertEqual(self.holders(), [1])

    def test_council_that_moved(self) -> None:
        """A standby that learns of a new council polls it immediately, and is notified of a release there."""
        self.wanting(0)
        self.client(1).stand_by(1)
        moved = self.client(0).change_council([self.room.contacts[place] for place in (3, 4, 6)])
        self.outcome(moved, 0.1)
        self.client(1).suspect_holder()
        self.run_for(0.1)
        self.client(0).release()
        self.run_for(0.1)
        self.assertEqual(self.holders(), [1])

    def test_second_in_line_lets_the_first_try(self) -> None:
        """Of two standbys that find the lease free at the same time, the standby with the first rank gets the lease."""
        for seed in range(5):
            self.room = self.made(seed=f"free {seed}")
            for place, rank in ((2, 2), (1, 1)):
                self.client(place).stand_by(rank)
                self.client(place).suspect_holder()
            self.run_for(0.1)
            self.assertEqual(self.holders(), [1], seed)

    def test_heir_that_never_looked(self) -> None:
        """A standby that is notified before its first poll claims with a sufficient ballot at its first attempt."""
        for seed in range(5):
            self.room = self.made(seed=f"heir {seed}")
            for _ in range(4):
                self.client(0).release()
                self.wanting(0)
            self.client(1).stand_by(1)
            self.room.nodes[0].leave(T, [1])
            self.run_for(0.04)
            self.assertEqual(self.holders(), [1], seed)

    def test_member_that_keeps_silent(self) -> None:
        """A holder keeps its ballot while a restarted member grants nothing, because a new ballot would not help."""
        self.room.kill(3)
        self.room.stores[3] = MemoryStore()
        self.room.nodes[3] = self.room.start_life(3)
        self.wanting(0)
        first = self.room.nodes[4].acceptor.log.get(T).holder  # type: ignore[union-attr]
        self.run_for(2 * TTL)
        for place in (3, 4):
            self.assertEqual(self.room.nodes[place].acceptor.log.get(T).holder, first)  # type: ignore[union-attr]

    def test_stand_by_that_is_named(self) -> None:
        """A client with a rank as standby can claim a free lease; a holder that gets such a rank keeps its lease."""
        self.client(0).stand_by(3)
        self.client(0).claim()
        self.run_for(2 * TTL)
        self.assertEqual(self.holders(), [0])
        self.client(0).stand_by(1)
        self.run_for(2 * TTL)
        self.assertEqual(self.holders(), [0])

    def test_outranked_while_it_holds(self) -> None:
        """If the device has obeyed a higher token, the holder's lease is void, and the holder claims a higher token."""
        client = self.wanting(0)
        client.on_higher_token(1)
        self.assertEqual(self.token(0), 1)
        client.on_higher_token(7)
        self.assertIsNone(client.lease)
        self.run_for(0.1)
        self.assertEqual(self.token(0), 8)

    def test_want_again_while_a_claim_is_under_way(self) -> None:
        """Replies to requests from before a release are ignored; the next claim has a new token."""
        client = self.client(0)
        for _ in range(5):
            client.claim()
            self.run_for(0.003)
            client.release()
        client.claim()
        self.run_for(TTL)
        self.assertEqual(self.holders(), [0])

    def test_claim_that_is_dropped_holds_nobody_up(self) -> None:
        """If a client cancels its claim, all members release it, even if some of them have granted it."""
        for steps in range(1, 12):
            self.room = self.made(seed=f"dropped {steps}")
            self.wanting(0, 0.001 * steps)
            self.client(0).release()
            self.wanting(1, 0.4)
            self.assertEqual(self.holders(), [1], steps)

    def test_loss_is_told(self) -> None:
        """A holder that cannot renew stops at its deadline, and claims again when it reaches the council."""
        client = self.wanting(0)
        self.cut(0, 3, 4)
        self.run_for(TTL)
        self.assertIsNone(client.lease)
        self.run_for(TTL / 3)
        self.assertEqual(client.token, 0)
        self.room.radio.cut.clear()
        self.run_for(TTL)
        self.assertEqual(self.token(0), 2)

    def test_member_that_promised_to_another_is_won_back(self) -> None:
        """A holder keeps its lease and token although a member, while unreachable, promised a higher ballot."""
        self.wanting(0)
        self.cut(0, 3)
        self.client(1).stand_by()
        self.run_for(2 * TTL)
        self.room.radio.cut.clear()
        self.run_for(2 * TTL)
        self.room.kill(4)
        self.run_for(2 * TTL)
        self.assertEqual((self.holders(), self.token(0)), ([0], 1))

    def test_time_to_stop_longer_than_the_lease(self) -> None:
        """A robot with a stopping time longer than the TTL never acts."""
        self.room = self.made(stop_time=2.0)
        self.wanting(0, 5.0)
        self.assertEqual(self.holders(), [])

    def test_claim_that_is_dropped_shortens_no_rest(self) -> None:
        """Cancelling a later claim does not shorten the stopping time after a release, even with a fast clock."""
        self.room = self.made(stop_time=0.3, rates=(1.01, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0))
        self.wanting(0, 1.0)
        self.client(0).release()
        stopped = self.room.clock.seconds()
        self.run_for(0.27)
        self.wanting(0, 0.01)
        self.client(0).release()
        self.run_for(0.1)
        for place in (3, 4, 5):
            bidder = self.room.nodes[place]
            until = bidder.machine.to_simulator_time(bidder.acceptor.log.get(T).lease_until)  # type: ignore[union-attr]
            self.assertGreaterEqual(until, stopped + 0.3)

    def test_rest_after_the_deadline_counts_on_the_clock_of_the_device(self) -> None:
        """If a holder with a fast clock resumes after its deadline, it releases only when its robot stands still."""
        self.room = self.made(stop_time=0.3, rates=(1.01, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0))
        self.wanting(0, 1.0)
        machine, lease = self.room.nodes[0].machine, self.client(0).lease
        assert lease is not None
        obeyed_until = self.room.clock.seconds() + lease.deadline - machine.seconds()
        machine.freeze(False)
        self.room.clock.advance(machine.to_simulator_time(lease.deadline) + 0.1 - self.room.clock.seconds())
        machine.thaw()
        self.client(0).release()
        self.run_for(0.1)
        for place in (3, 4, 5):
            bidder = self.room.nodes[place]
            until = bidder.machine.to_simulator_time(bidder.acceptor.log.get(T).lease_until)  # type: ignore[union-attr]
            self.assertGreaterEqual(until, obeyed_until + 0.3)

    def test_rough_weather(self) -> None:
        """At 50 % loss, with duplicates and delays, there is never more than one holder, and often there is one."""
        self.room.radio.quality = LinkQuality(0.02, 0.05, 0.5, 0.3, 5.0)
        for place in range(3):
            self.client(place).claim()
        held = 0
        for _ in range(400):
            self.run_for(0.1)
            self.assertLessEqual(len(self.holders()), 1)
            held += len(self.holders())
        self.assertGreater(held, 100)
        self.assertEqual(self.room.recorder.violations, [])


class DurationTests(LeaseCase):
    def test_takeover(self) -> None:
        """Of two hundred takeovers at 10 % loss, half take less than 1.5 s, and 99 % less than 2 s."""
        seconds = sorted(measure_takeover(seed) for seed in range(200))
        self.assertLess(seconds[100], 1.5)
        self.assertLess(seconds[198], 2.0)

    def test_upkeep(self) -> None:
        """Holding a lease takes at most twelve datagrams per second."""
        self.assertLessEqual(measure_upkeep(), 12.0)
