"""Attack S4: replay a recording immediately, later, after a restart, to other nodes, and to other teams."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred

from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import SwitchboardNetwork
from middleware.entangled.record import hash_key
from middleware.entangled.wire.admission_check import LogLimiter
from middleware.entangled.wire.method import KEEP_ANSWER_S
from middleware.entangled.wire.session import MAX_RESPONSES, MAX_UNCONFIRMED
from tests.attacks.siege import SiegeCase
from tests.fuzz.ground import state_of
from tests.middleware.admission.village import Tape, Village, network_of

ELSEWHERE = Address("10.9.9.9", 99)


class ReplayCase(SiegeCase):
    """A test case with a team of four, and a complete recording of its datagrams during some seconds."""

    def setUp(self) -> None:
        """Record joins, writes, reads, watches, calls and a removal."""
        super().setUp()
        self.tape = Tape()
        self.runs: list[int] = []
        self.sent: Counter[int] = Counter()
        self.team = self.village()
        self.tape.tap(network_of(self.team.houses[0]))
        self.team.tape = self.tape
        self.expose()
        for name in ("dog", "cat", "pig"):
            self.team.enlist(name, "device", "operator")
        self.work(self.team)
        self.team.tape = None

    def expose(self) -> None:
        """Expose a method that counts its calls at each node."""

        def add(peer: object, number: int) -> int:
            self.runs.append(number)
            return number

        self.team.houses[0].node.endpoint.expose("add", add, changes=True)

    def work(self, team: Village) -> None:
        """Let the team write, read, watch, remove and call."""
        first, second = team.houses[1].node, team.houses[2].node
        key = hash_key("task")
        team.houses[3].node.watch(key, lambda records: None)
        done: list[Deferred[Any]] = [first.put(key, "a", b"1"), second.put(key, "b", b"2" * 3000)]
        team.run(1.0)
        done += [first.get(key), second.remove(key, "b"), first.put(hash_key("here"), "dog", b"x", "leased")]
        team.run(1.0)
        done += [first.call(team.contact(team.houses[0]), "add", number, changes=True) for number in range(5)]
        team.run(2.0)
        for each in done:
            self.successResultOf(each)

    def states(self, team: Village) -> list[str]:
        """Return the hash of each node's state that outlasts a session."""
        found = []
        for house in team.houses:
            endpoint = house.node.endpoint
            half = endpoint._half_open
            self.assertLessEqual(len(half._unconfirmed), MAX_UNCONFIRMED)
            self.assertLessEqual(len(half._responses), MAX_RESPONSES)
            # A replayed INIT may open a session that is never confirmed. The number of such sessions is limited, and no
            # data is sent in them.
            for session in list(half._unconfirmed.values()):
                half.forget(session)
            half.clear()
            # When a recording from before a restart arrives, the node assumes a copy of the sender and logs this once
            # per member.
            self.assertLessEqual(len(endpoint._log_limiter._logged), len(team.houses))
            timers = sorted(call.getTime() for call in team.clock.getDelayedCalls())
            noted, endpoint._log_limiter = endpoint._log_limiter, LogLimiter()
            found.append(state_of([house.node, house.node.store, house.team.membership_list, timers]))
            endpoint._log_limiter = noted
        return found

    def replay(
        self,
        team: Village,
        to: Callable[[int], SwitchboardNetwork] | None = None,
        source: Address | None = None,
    ) -> None:
        """Replay the whole recording immediately; no method may run, and no state may change."""
        places = [house.node._network for house in team.houses]
        known: list[Any] = [network for network, _, _ in self.tape.heard]
        number = {id(network): place for place, network in enumerate(dict.fromkeys(known))}
        before, ran = self.states(team), list(self.runs)
        received = sum(len(datagram) for _, datagram, _ in self.tape.heard)
        bytes_out = self.bytes_out(team)
        for network, datagram, came_from in list(self.tape.heard):
            place: Any = to(number[id(network)]) if to is not None else places[number[id(network)]]
            if place.receiver is not None:
                place.receiver(datagram, source or came_from)
        self.assertEqual(self.states(team), before)
        self.assertEqual(self.runs, ran)
        self.assertLessEqual(self.bytes_out(team) - bytes_out, received)

    def bytes_out(self, team: Village) -> int:
        """Return the number of bytes that the nodes of the team have sent since ``freeze``."""
        return self.sent[id(team)]

    def freeze(self, team: Village) -> None:
        """Drop all datagrams that the nodes send from now on, so that none reaches another node; they are counted."""
        for house in team.houses:
            network: Any = house.node._network

            def count(datagram: bytes, to: Address) -> None:
                self.sent[id(team)] += len(datagram)

            network.send = count


class ReplayTests(ReplayCase):
    def test_the_tape_is_rich(self) -> None:
        """The recording contains many datagrams, and at least one of each kind that a team sends."""
        kinds = {datagram[0] for _, datagram, _ in self.tape.heard}
        self.assertGreaterEqual(kinds, {0x11, 0x12, 0x13, 0x14, 0x15})
        self.assertGreater(len(self.tape.heard), 200)
        self.assertEqual(self.runs, [0, 1, 2, 3, 4])

    def test_at_once(self) -> None:
        """An immediate replay to the same nodes, from another address, or to other nodes has no effect."""
        self.freeze(self.team)
        self.replay(self.team)
        self.replay(self.team, source=ELSEWHERE)
        for house in self.team.houses:
            sessions = house.node.endpoint._sessions.values()
            self.assertNotIn(ELSEWHERE, [session.contact.address for session in sessions])
        count = len(self.team.houses)
        self.replay(self.team, to=lambda place: network_of(self.team.houses[(place + 1) % count]))

    def test_after_responses_are_forgotten(self) -> None:
        """A replay has no effect after the nodes have deleted their cached responses."""
        self.team.run(4 * KEEP_ANSWER_S)
        self.freeze(self.team)
        self.replay(self.team)

    def test_after_a_restart(self) -> None:
        """A replay has no effect after a restart of the nodes, because their sessions in the recording have ended."""
        for house in self.team.houses:
            self.team.close(house, is_sudden=True)
        self.team.run(1.0)
        for house in self.team.houses:
            self.team.open(house)
            self.team.run(0.5)
        self.expose()
        self.team.run(5.0)
        self.freeze(self.team)
        self.replay(self.team)

    def test_to_another_team(self) -> None:
        """A replay to another team gets no answer."""
        other = self.village(seed=2)
        for name in ("dog", "cat", "pig"):
            other.enlist(name)
        other.run(3.0)
        self.freeze(other)
        self.replay(other, to=lambda place: network_of(other.houses[place]))
        self.assertEqual(self.bytes_out(other), 0)

    def test_after_a_rotation(self) -> None:
        """A replay gets no answer after a rotation of the team's secret."""
        members = [house.public for house in self.team.houses]
        self.team.tell(self.team.signer.rotate_secret(2, members, self.team.wall(), 5.0, self.team.dice))
        self.team.run(60.0)
        for house in self.team.houses:
            self.assertEqual(len(house.node.endpoint._peers.ring), 1)
        self.freeze(self.team)
        self.replay(self.team)

    def test_the_hash_notices(self) -> None:
        """A single datagram that is not a replay changes the hash."""
        before = self.states(self.team)
        asked = self.team.houses[1].node.call(self.team.contact(self.team.houses[0]), "add", 9, changes=True)
        self.team.run(0.1)
        self.successResultOf(asked)
        self.assertNotEqual(self.states(self.team), before)
