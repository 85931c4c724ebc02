"""Attack S17: release a stop, prevent a later stop, or make a node forget a stop."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

import msgpack
from twisted.internet.defer import Deferred, fail

from middleware.admission.roles import DEVICE, GATEWAY, OPERATOR, ROLES, VIEWER, may_call
from middleware.entangled.contact import Contact
from middleware.entangled.errors import Refused, Unwritable
from middleware.entangled.identity import Identity
from middleware.entangled.record import Record, Slot
from middleware.stop.stop_set import ID_BYTES, MAX_RELEASED, MAX_SENDERS, MAX_STOPS, MAX_STOPS_OF_SENDER
from middleware.stop.stop_state import (
    METHOD,
    NO_ROBOT,
    NOT_SAVED,
    SLOT,
    STANDS_STILL,
    STOPS_KEY,
    StopState,
    expose_stops,
)
from tests.attacks.siege import SOURCE, SiegeCase
from tests.middleware.admission.village import House, Tape, Village, network_of

SEQUENCES, STEPS = 3, 25


class HaltingTeam(Village):
    """A closed team with ``device.halt`` at each node; ``halts`` contains the current halts, by name."""

    def __init__(self, seed: int) -> None:
        self.halts: dict[str, StopState] = {}
        super().__init__(seed)

    def open(self, house: House) -> None:
        """Start a node, which keeps its robot still until it has learned of the stops in force."""
        super().open(house)
        node: Any = house.node
        halt = expose_stops(node, self.make_life_rng(house.place), node._background.later, lambda stops, words: None)

        def obey() -> str:
            if not halt.is_known:
                halt.request_stops()
            return STANDS_STILL if halt.is_motion_forbidden else NO_ROBOT

        halt.subscribe(obey)
        self.halts[house.name] = halt
        halt.request_stops()
        node._background.every(0.5, halt.recheck)

    def halt(self, house: House) -> StopState:
        return self.halts[house.name]

    def is_on(self) -> dict[str, bool]:
        return {name: halt.is_motion_forbidden for name, halt in self.halts.items()}

    def reopen(self, house: House) -> None:
        """Restart a node with its store."""
        self.close(house, is_sudden=True)
        self.open(house)


class StopCase(SiegeCase):
    """A test case with a team with an operator ``ann``, a second operator ``bob`` and two robots."""

    def setUp(self) -> None:
        super().setUp()
        self.team = self.kept(HaltingTeam(1))
        self.ann = self.team.houses[0]
        self.bob = self.team.enlist("bob", OPERATOR)
        self.dogs = [self.team.enlist(name, DEVICE) for name in ("dog1", "dog2")]
        self.team.run(5.0)
        self.assertEqual(set(self.team.is_on().values()), {False})

    def stop(self, house: House, others: Sequence[House] | None = None) -> dict[str, str]:
        """Let an operator stop the team; return the answers of the nodes, by name."""
        return self.said(self.team.halt(house).stop(house.name, self.contacts(others)))

    def release(self, house: House, stops: Sequence[bytes], others: Sequence[House] | None = None) -> dict[str, str]:
        return self.said(self.team.halt(house).release(stops, house.name, self.contacts(others)))

    def contacts(self, houses: Sequence[House] | None) -> list[Any]:
        return [self.team.contact(house) for house in (self.team.houses if houses is None else houses)]

    def said(self, asked: Deferred[dict[str, str]]) -> dict[str, str]:
        told = self.outcome(self.team, asked)
        names = {house.node.identity.node_id.hex(): house.name for house in self.team.houses}
        return {names[uuid]: words for uuid, words in told.items()}

    def stops(self, house: House) -> list[bytes]:
        return list(self.team.halt(house).stops)

    def ask(self, bare: Any, house: House, *arguments: object) -> Any:
        """Return the result of one call that an attacker makes at a node."""
        return self.outcome(self.team, bare.ask(self.team.contact(house), METHOD, *arguments, changes=True), 0.2)

    def record(self, own: Identity, fields: object, sequence: int = 1) -> Record:
        return Record(STOPS_KEY, SLOT, own.public, sequence, "team", 600.0, msgpack.packb(fields)).sign(own)

    def store(self, bare: Any, record: Record) -> None:
        """Send a record to every node."""
        for house in self.team.houses:
            asked = bare.ask(self.team.contact(house), "store", [record.pack()], changes=True)
            self.outcome(self.team, asked, 0.2)
        self.team.run(3.0)


class DisablingTests(StopCase):
    def test_no_number_disables_a_stop(self) -> None:
        """Huge numbers in an operator's calls and records do not prevent a later stop."""
        bare, own = self.insider(self.team, "thief", OPERATOR)
        for number in (2**53, 2**63, 2**64 - 1):
            for house in self.team.houses:
                self.assertIsInstance(self.ask(bare, house, number, False, "thief"), Refused)
            self.store(bare, self.record(own, [number, False, "thief"], min(number, 2**62)))
        self.stop(self.ann)
        self.team.run(5.0)
        self.assertEqual(set(self.team.is_on().values()), {True})

    def test_releases_in_advance_disable_no_stop(self) -> None:
        """Releases of more invented ids than the table can contain neither end a stop nor prevent a later stop."""
        bare, own = self.insider(self.team, "thief", OPERATOR)
        self.stop(self.bob)
        dice = random.Random(1)
        for _ in range(3):
            ids = [dice.randbytes(ID_BYTES) for _ in range(MAX_RELEASED)]
            for house in self.team.houses:
                self.ask(bare, house, [], ids, "thief")
            self.store(bare, self.record(own, [[], ids[:40], "thief"]))
        self.stop(self.ann)
        self.assertEqual({len(self.stops(house)) for house in self.team.houses}, {2})
        self.release(self.ann, [stop for stop in self.stops(self.ann) if stop in self.team.halt(self.bob).stops][:1])
        self.assertEqual(set(self.team.is_on().values()), {True})

    def test_thousands_of_stops_displace_none(self) -> None:
        """An operator that creates thousands of stops fills only its own share.

        Stops of other operators stay in force.
        """
        [stop] = self.only_stop(self.ann)
        _, own = self.insider(self.team, "thief", OPERATOR)
        dice = random.Random(1)
        dog = self.dogs[0]
        for _ in range(300):
            ids = [dice.randbytes(ID_BYTES) for _ in range(MAX_STOPS)]
            self.team.halt(dog).answer(Contact(own.public, SOURCE), [[each, "thief"] for each in ids], [], "thief")
        self.assertLessEqual(len(self.stops(dog)), MAX_STOPS_OF_SENDER + 1)
        self.assertIn(stop, self.stops(dog))
        self.release(self.bob, [each for each in self.stops(dog) if each != stop], [dog])
        self.assertEqual(self.stops(dog), [stop])
        self.assertTrue(self.team.halt(dog).is_motion_forbidden)
        self.release(self.bob, [stop], [dog])
        self.assertFalse(self.team.halt(dog).is_motion_forbidden)

    def only_stop(self, house: House) -> list[bytes]:
        """Let an operator stop the team, and return the stops."""
        self.stop(house)
        return self.stops(house)


class RightsTests(StopCase):
    def test_only_who_may_order(self) -> None:
        """Only the roles operator and gateway can stop the team or release a stop, by a call or by a record."""
        self.stop(self.ann)
        [stop] = self.stops(self.dogs[0])
        for number, role in enumerate(ROLES):
            if may_call((role,), METHOD):
                continue
            bare, own = self.insider(self.team, role, role, at=SOURCE._replace(port=600 + number))
            for house in self.team.houses:
                self.assertIsInstance(self.ask(bare, house, [], [stop], role), Refused, role)
                self.assertIsInstance(self.ask(bare, house, [[b"x" * 16, role]], [], role), Refused, role)
            self.store(bare, self.record(own, [[[b"y" * 16, role]], [stop], role]))
            self.assertEqual([self.stops(house) for house in self.team.houses], [[stop]] * 4, role)
        self.assertEqual({role for role in ROLES if may_call((role,), METHOD)}, {OPERATOR, GATEWAY})

    def test_invented_keys_release_nothing(self) -> None:
        """A release that a viewer signs with an invented key has no effect."""
        self.stop(self.ann)
        [stop] = self.stops(self.dogs[0])
        bare, _ = self.insider(self.team, "eye", VIEWER)
        self.store(bare, self.record(Identity(bytes(31) + b"i"), [[], [stop], "operator"]))
        self.assertEqual(set(self.team.is_on().values()), {True})

    def test_a_revoked_operator_releases_nothing(self) -> None:
        """A release that an operator signs after its own revocation has no effect, no matter which node sends it."""
        self.stop(self.ann)
        [stop] = self.stops(self.dogs[0])
        own = self.bob.kept.membership.identity
        self.team.tell(self.team.signer.revoke(self.bob.public, "bob", self.team.wall()))
        self.team.run(10.0)
        self.team.close(self.bob, is_sudden=True)
        del self.team.halts["bob"]
        bare, _ = self.insider(self.team, "dog3", DEVICE)
        self.store(bare, self.record(own, [[], [stop], "bob"], 2**40))
        self.assertEqual(set(self.team.is_on().values()), {True})

    def test_junk_changes_nothing(self) -> None:
        """Malformed calls and records are rejected or ignored."""
        self.stop(self.ann)
        [stop] = self.stops(self.dogs[0])
        bare, own = self.insider(self.team, "thief", OPERATOR)
        junk: list[list[object]] = [
            [[], [stop + b"x"], "x"],
            [[], [stop[:-1]], "x"],
            [[], ["a" * 16], "x"],
            [[], [[stop]], "x"],
            [[], [b"x" * 16] * (MAX_RELEASED + 1), "x"],
            [[[b"x" * 16, 7]], [], "x"],
            [[[b"x" * 16]], [], "x"],
            [[[b"x" * 16, "x"]] * (MAX_STOPS + 1), [], "x"],
            [[], [], "x" * 65],
            [{}, {}, {}],
            [-1, True, "x"],
        ]
        for sequence, fields in enumerate(junk, 1):
            self.assertIsInstance(self.ask(bare, self.dogs[0], *fields), Refused, fields)
            self.store(bare, self.record(own, fields, sequence))
            self.assertEqual(self.stops(self.dogs[0]), [stop], fields)
        for value in (b"", b"\xc1", b"\x93", b"\xff" * 2000):
            record = Record(STOPS_KEY, SLOT, own.public, 99, "team", 600.0, value).sign(own)
            self.store(bare, record)
        self.assertEqual([self.stops(house) for house in self.team.houses], [[stop]] * 4)


class ReplayTests(StopCase):
    def test_a_replayed_release_ends_no_later_stop(self) -> None:
        """A replay of all datagrams and records of a release does not end a later stop."""
        self.stop(self.ann)
        first = self.stops(self.dogs[0])
        tape = Tape()
        for house in self.team.houses:
            tape.tap(network_of(house))
        self.release(self.bob, first)
        old = [record for record in self.ann.node.store.get(STOPS_KEY) if record.name == SLOT]
        self.assertEqual(set(self.team.is_on().values()), {False})
        self.stop(self.ann)
        heard, tape.heard = tape.heard, []
        for network, datagram, source in heard:
            assert network.receiver is not None
            network.receiver(datagram, source)
        self.team.run(3.0)
        bare, _ = self.insider(self.team, "thief", OPERATOR)
        for record in old:
            self.store(bare, record)
        self.assertEqual(set(self.team.is_on().values()), {True})

    def test_a_released_stop_does_not_come_back(self) -> None:
        """If the record of a released stop is stored again, it stops no robot."""
        self.stop(self.ann)
        stop = self.stops(self.dogs[0])
        [old] = [record for record in self.dogs[0].node.store.get(STOPS_KEY) if record.owner == self.ann.public]
        self.release(self.bob, stop)
        bare, _ = self.insider(self.team, "dog3", DEVICE)
        for house in self.team.houses:
            house.node.store.discard(Slot(STOPS_KEY, self.ann.public, SLOT))
        self.store(bare, old)
        self.assertEqual(set(self.team.is_on().values()), {False})


class LossTests(StopCase):
    def test_a_restart_of_all_releases_nothing(self) -> None:
        """After a sudden restart of all nodes each keeps its robot still, even before it contacts a peer."""
        self.assertEqual(self.stop(self.ann)["dog1"], STANDS_STILL)
        for house in self.team.houses:
            self.team.close(house, is_sudden=True)
        for house in self.team.houses:
            self.team.open(house)
        self.assertTrue(all(self.team.halt(house).is_stopped for house in self.team.houses))
        self.team.run(20.0)
        self.assertTrue(all(self.team.halt(house).is_stopped for house in self.team.houses))
        self.release(self.bob, self.stops(self.dogs[1]))
        self.assertEqual(set(self.team.is_on().values()), {False})

    def test_a_stop_outlives_its_author(self) -> None:
        """A stop stays in force until its release, even if its author is revoked and its record is lost."""
        self.stop(self.bob)
        stop = self.stops(self.dogs[0])
        self.team.tell(self.team.signer.revoke(self.bob.public, "bob", self.team.wall()))
        self.team.run(10.0)
        self.team.close(self.bob, is_sudden=True)
        del self.team.halts["bob"]
        for house in self.team.houses:
            self.lose(house, Slot(STOPS_KEY, self.bob.public, SLOT))
        self.team.run(60.0)
        self.assertEqual([self.stops(house) for house in self.team.houses if house is not self.bob], [stop] * 3)
        late = self.team.enlist("dog3", DEVICE)
        self.team.run(5.0)
        self.assertEqual(self.stops(late), stop)
        answer = self.outcome(
            self.team, self.ann.node.call(self.team.contact(late), METHOD, [], [], "ann", changes=True), 0.5
        )
        self.assertEqual([named for named, _ in answer[1]], stop)
        self.release(self.ann, stop)
        self.assertEqual(set(self.team.is_on().values()), {False})

    def lose(self, house: House, slot: Slot) -> None:
        """Let a replica drop a record as if the record had expired."""
        record = house.node.store.get_slot(slot)
        if record is not None and house.node.store.discard(slot):
            house.node.replica._notify_gone([record])

    def test_a_stop_that_is_not_saved_says_so(self) -> None:
        """A node that cannot store a stop still obeys it, and states in its answer that the stop is not saved."""
        store: Any = self.dogs[0].node.store
        self.patch(store, "wait_for_write", lambda: fail(Unwritable("the disk is full")))
        self.assertEqual(self.stop(self.ann)["dog1"], STANDS_STILL + NOT_SAVED)
        self.assertTrue(self.team.halt(self.dogs[0]).is_motion_forbidden)

    def test_a_damaged_note_stands(self) -> None:
        """A node with a corrupt stored stop keeps its robot still until that stop is released by its id."""
        self.dogs[0].node.store.set_note("halt/stops", b"\xc1junk")
        self.team.reopen(self.dogs[0])
        self.team.run(3.0)
        self.assertEqual(self.team.is_on(), {"vaio": False, "bob": False, "dog1": True, "dog2": False})
        self.release(self.ann, self.stops(self.dogs[0]))
        self.assertEqual(set(self.team.is_on().values()), {False})

    def test_a_stop_of_an_earlier_version_stands(self) -> None:
        """A stop in the format of an earlier software version is in force, and has to be released by its id.

        A release in that format ends no stop.
        """
        own = self.bob.kept.membership.identity
        bare, _ = self.insider(self.team, "dog3", DEVICE)
        self.store(bare, self.record(own, [7, True, "bob"]))
        [stop] = self.stops(self.dogs[0])
        self.store(bare, self.record(own, [8, False, "bob"], 2))
        self.assertEqual(set(self.team.is_on().values()), {True})
        self.release(self.ann, [stop])
        self.assertEqual(set(self.team.is_on().values()), {False})

    def test_more_senders_than_places(self) -> None:
        """If more senders stop a node than its table can contain, the robot stands still until all are released."""
        dog, dice = self.team.halt(self.dogs[0]), random.Random(1)
        for number in range(MAX_SENDERS + 40):
            peer = Contact(number.to_bytes(32, "big"), SOURCE)
            dog.answer(peer, [[dice.randbytes(ID_BYTES), "x"]], [], "x")
        self.assertLessEqual(len(dog.stops), MAX_SENDERS + MAX_STOPS_OF_SENDER)
        self.release(self.ann, list(dog.stops)[1:], [self.dogs[0]])
        self.assertTrue(dog.is_motion_forbidden)
        self.release(self.ann, list(dog.stops), [self.dogs[0]])
        self.assertFalse(dog.is_motion_forbidden)


class SequenceTests(StopCase):
    def test_stop_holds_on_whole_nodes(self) -> None:
        """Each stop stays in force until its own release, in random sequences of events.

        The events are stops, releases, partitions, restarts and messages of a viewer.
        """
        bare, own = self.insider(self.team, "eye", VIEWER)
        for seed in range(SEQUENCES):
            dice = random.Random(seed)
            for number in range(STEPS):
                self.step(dice, bare, own, number)
            self.team.switchboard.heal()
            self.team.run(20.0)
            self.release(self.ann, sorted({stop for house in self.team.houses for stop in self.stops(house)}))
            self.team.run(20.0)
            self.assertEqual(set(self.team.is_on().values()), {False}, seed)

    def step(self, dice: random.Random, bare: Any, own: Identity, number: int) -> None:
        """Perform one random step, and check the invariants."""
        house = dice.choice((self.ann, self.bob))
        known = self.stops(house)
        match dice.randrange(6):
            case 0 | 1:
                asked = self.team.halt(house).stop(house.name, self.contacts(None))
                [stop] = set(self.stops(house)) - set(known)
                told = self.said(asked)
                for dog in self.dogs:
                    if told.get(dog.name) == STANDS_STILL:
                        self.assertIn(stop, self.stops(dog))
            case 2:
                named = dice.sample(known, dice.randrange(len(known) + 1))
                before = {dog.name: set(self.stops(dog)) for dog in self.dogs}
                self.release(house, named)
                for dog in self.dogs:
                    self.assertLessEqual(before[dog.name] - set(self.stops(dog)), set(named) | self.released(dog))
            case 3:
                near = [self.team.address_of(each) for each in self.team.houses if dice.random() < 0.5]
                self.team.switchboard.partition(near) if dice.random() < 0.6 else self.team.switchboard.heal()
            case 4:
                dog = dice.choice(self.dogs)
                before_restart = self.stops(dog)
                self.team.reopen(dog)
                self.assertEqual(self.stops(dog), before_restart)
            case 5:
                for dog in self.dogs:
                    self.ask(bare, dog, [], self.stops(dog), "eye")
                record = self.record(own, [[], self.stops(self.dogs[0]), "eye"], number + 1)
                bare.ask(self.team.contact(self.dogs[0]), "store", [record.pack()], changes=True).addErrback(str)
        held = {dog.name: set(self.stops(dog)) for dog in self.dogs}
        self.team.run(dice.random() * 5.0)
        for dog in self.dogs:
            self.assertLessEqual(held[dog.name] - set(self.stops(dog)), self.released(dog))

    def released(self, dog: House) -> set[bytes]:
        """Return the ids of the stops that an operator has released."""
        return {stop for house in (self.ann, self.bob) for stop in self.team.halt(house)._own_releases}
