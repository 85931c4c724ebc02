"""Attack S13: to write records with a key that no present certificate allows, and to fill the stores of the others."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred

from middleware.admission.certificate import guest_pass
from middleware.entangled.data.store import OWNER_SHARE
from middleware.entangled.errors import Full, NotAcknowledged
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.record import Record, Slot, hashed_key
from middleware.entangled.replication.cache import MAX_AGE
from middleware.entangled.replication.replica import FORBIDDEN
from middleware.entangled.wire.endpoint import Endpoint
from middleware.roles import DEVICE, GATEWAY, OPERATOR, VIEWER
from tests.attacks.siege import SOURCE, ClosedTeam, SiegeCase

KEYS = ("halt", "tasks", "deployments", "anything")


class RecordCase(SiegeCase):
    """A closed team of three, and an insider."""

    def setUp(self) -> None:
        """Make the team."""
        super().setUp()
        self.team: ClosedTeam = self.siege()
        for name in ("dog", "cat"):
            self.team.enlist(name)

    def hand_over(self, carrier: Endpoint, record: Record) -> list[Any]:
        """Hand a record to every node by every method that takes one; return the outcomes of the STOREs."""
        packed, key, found = [record.packed()], record.key, []
        for house in self.team.houses:
            contact = self.team.contact(house)
            for method, arguments in (
                ("cache", (key, packed, MAX_AGE)),
                ("push", (key, 1, packed, [])),
            ):
                carrier.ask(contact, method, *arguments, changes=True).addErrback(lambda failure: None)
            for handed in ((packed,), (packed, [600.0])):
                found.append(self.outcome(self.team, carrier.ask(contact, "store", *handed, changes=True), 1.0))
        return found

    def believed(self, key: bytes) -> list[Record]:
        """Everything that any node of the team reads, holds or hands out of ``key``."""
        found: list[Record] = []
        for house in self.team.houses:
            read = self.outcome(self.team, house.node.get(key))
            found += read if isinstance(read, list) else []
            found += house.node.replica.held(key)
            found += house.node.replica.cache.get(key, self.team.clock.seconds()) or []
        return found


class InventedKeyTests(RecordCase):
    """A viewer signs with a key that is on no membership list."""

    def test_nobody_takes_a_record_of_an_invented_key(self) -> None:
        """A record that is signed by an invented key is refused first-hand and second-hand, in every namespace."""
        viewer, _ = self.insider(self.team, "eye", VIEWER)
        invented = Identity(b"invented" * 4)
        for name in KEYS:
            record = Record(hashed_key(name), "x", invented.public, 1, "team", 600.0, b"\xc3").signed(invented)
            self.assertEqual(self.hand_over(viewer, record), [[FORBIDDEN]] * 6, name)
            self.assertEqual(self.believed(record.key), [], name)

    def test_junk_fills_nothing(self) -> None:
        """Junk records of 400 invented keys change no store, and the members go on writing."""
        viewer, _ = self.insider(self.team, "eye", VIEWER)
        contact = self.team.contact(self.team.houses[0])
        rows = [len(house.node.store) for house in self.team.houses]
        for number in range(400):
            invented = Identity(number.to_bytes(32))
            record = Record(hashed_key("junk"), "x", invented.public, 1, "team", 600.0, bytes(64)).signed(invented)
            viewer.ask(contact, "store", [record.packed()], changes=True).addErrback(lambda failure: None)
            self.team.run(0.02)
        self.team.run(2.0)
        self.assertEqual([len(house.node.store) for house in self.team.houses], rows)
        put = self.outcome(self.team, self.team.houses[1].node.put(hashed_key("good"), "x", b"\xc3"))
        self.assertEqual(int(put), 3)

    def test_a_lying_replica_is_not_believed(self) -> None:
        """A node that answers a read with a record of an invented key and a junk certificate is not believed."""
        liar, own = self.insider(self.team, "liar", DEVICE)
        invented = Identity(b"invented" * 4)
        key = hashed_key("halt")
        record = Record(key, "halt", invented.public, 9, "team", 600.0, b"\xc2").signed(invented)
        liar.expose("certificates", lambda peer, owners: [b"junk" for _ in owners])
        liar.expose("find_value", lambda peer, *rest: [[record.packed()], None, 1])
        reader = self.team.houses[0].node._reader
        self.outcome(self.team, liar.ask(self.team.contact(self.team.houses[0]), "ping", bytes(8), changes=True))
        answer = self.outcome(self.team, Deferred.fromCoroutine(reader.pages(Contact(own.public, SOURCE), key)))
        self.assertEqual(answer.records, [])


class RevokedKeyTests(RecordCase):
    """An operator whose certificate was revoked, and a member that carries its records."""

    def test_what_a_revoked_operator_signs_is_refused(self) -> None:
        """Records of a revoked operator are refused, whoever hands them over, and those it wrote before are dropped."""
        _, operator = self.insider(self.team, "op", OPERATOR)
        accomplice, _ = self.insider(self.team, "friend", DEVICE, at=SOURCE._replace(port=667))
        key = hashed_key("tasks")
        before = Record(key, "old", operator.public, 1, "team", 600.0, b"\xc3").signed(operator)
        grant = self.team.signer.grant(operator.public, "op", (OPERATOR,), self.team.wall())
        self.outcome(self.team, self.team.tell(grant))
        self.team.run(1.0)
        self.assertEqual(self.hand_over(accomplice, before), [[0]] * 6)
        self.outcome(self.team, self.team.tell(self.team.signer.revoke(operator.public, "op", self.team.wall())))
        self.team.run(11.0)
        self.assertEqual(self.believed(key), [])
        after = Record(key, "new", operator.public, 2, "team", 600.0, b"\xc3").signed(operator)
        self.assertEqual(self.hand_over(accomplice, after), [[FORBIDDEN]] * 6)
        house = self.team.houses[1]
        self.team.close(house, is_sudden=True)
        self.team.open(house)
        self.team.run(2.0)
        self.assertEqual(self.hand_over(accomplice, after), [[FORBIDDEN]] * 6)
        self.assertEqual(self.believed(key), [])


class ShareTests(RecordCase):
    """A member that fills the stores with records that it may write."""

    def test_a_full_owner_stops_only_itself(self) -> None:
        """A device that writes until it is refused has its share of each store; the others go on writing."""
        most = 40
        for house in self.team.houses:
            store: Any = house.node.store
            store._max_rows = most * OWNER_SHARE
        device, own = self.insider(self.team, "flood", DEVICE)
        contact = self.team.contact(self.team.houses[0])
        refused = 0
        for number in range(2 * most):
            record = Record(hashed_key("flood"), f"{number}", own.public, 1, "team", 600.0, b"\xc3").signed(own)
            outcome = self.outcome(self.team, device.ask(contact, "store", [record.packed()], changes=True), 0.1)
            refused += isinstance(outcome, Exception)
        self.assertGreaterEqual(refused, most)
        self.assertLessEqual(len(self.team.houses[0].node.store.owned(own.public)), most)
        for number in range(10):
            put = self.outcome(self.team, self.team.houses[1].node.put(hashed_key("good"), f"{number}", b"\xc3"))
            self.assertEqual(int(put), 3)

    def test_a_member_is_told_that_its_share_is_used_up(self) -> None:
        """The writer itself fails with ``Full`` or is not acknowledged, and nothing of it is half stored."""
        for house in self.team.houses:
            store: Any = house.node.store
            store._max_rows = 4 * OWNER_SHARE
        node = self.team.houses[1].node
        outcomes = [self.outcome(self.team, node.put(hashed_key("mine"), f"{number}", b"\xc3")) for number in range(9)]
        self.assertTrue(any(isinstance(each, Full | NotAcknowledged) for each in outcomes), outcomes)


class GuestTests(RecordCase):
    """A guest whom only its gateway has met."""

    def test_records_of_a_guest_are_read_from_others(self) -> None:
        """A node that never met a guest reads its record from a replica, with the certificate from there."""
        paper = self.team.paper("gate", GATEWAY)
        guest = Identity(b"g" * 32)
        shown = guest_pass(paper.identity, paper.shown, guest.public, "phone", int(self.team.wall()))
        stranger = self.team.houses[2]
        self.team.board.cut(SOURCE._replace(port=668), self.team.address_of(stranger))
        phone = self.attacker(self.team, guest, paper.secrets[0][1], shown, SOURCE._replace(port=668))
        key = hashed_key("pictures")
        record = Record(key, "x", guest.public, 1, "team", 600.0, b"\xc3").signed(guest)
        for house in self.team.houses[:2]:
            asked = phone.ask(self.team.contact(house), "store", [record.packed()], changes=True)
            self.assertEqual(self.outcome(self.team, asked), [0])
        self.assertFalse(stranger.team.door.is_known(guest.public))
        answer = self.outcome(self.team, stranger.node.get(key))
        self.assertEqual(answer, [record])
        self.assertTrue(stranger.team.door.may_store(Slot(key, guest.public, "x")))
