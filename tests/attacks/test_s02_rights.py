"""Attack S2: change records of other members, or act with an expired certificate or without the required role."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from middleware.admission.certificate import wrap_grant
from middleware.admission.roles import KINDS, METHODS, ROLES, classify_slot, may_call, may_store
from middleware.entangled.errors import Refused
from middleware.entangled.identity import Identity
from middleware.entangled.record import Record, hash_key
from middleware.entangled.replication.store_reply import Outcome
from tests.attacks.siege import SOURCE, SiegeCase
from tests.middleware.admission.paper import NOW

KEYS = ("halt", "tasks", "devices", "deployments", "signed-out", "group/7")
NAMES = ("order", "member", "result", "council", "done", "verdict/1", "source", "anything")


class MethodTests(SiegeCase):
    def test_every_method_by_every_role(self) -> None:
        """A method that a role may not call is rejected with "role" and not executed; allowed methods are executed."""
        team = self.village()
        house = team.houses[0]
        ran: list[str] = []
        for name in METHODS:
            house.node.endpoint.expose(name, lambda peer, name=name: ran.append(name))
        for number, role in enumerate(ROLES):
            attacker, _ = self.insider(team, role, role, at=SOURCE._replace(port=600 + number))
            self.every(team, attacker, (role,), ran)

    def every(self, team: Any, attacker: Any, which: tuple[str, ...], ran: list[str]) -> None:
        """Call every method of the role table, and a method that the table does not contain."""
        contact = team.contact(team.houses[0])
        refused = team.houses[0].node.endpoint.counters["refused"]
        team.houses[0].node.endpoint.expose("made.up", lambda peer: ran.append("made.up"))
        names = [*METHODS, "made.up"]
        ran.clear()
        asked = {name: attacker.ask(contact, name, changes=True) for name in names}
        outcomes = {name: self.outcome(team, each, 0.05) for name, each in asked.items()}
        for name in set(names) - {each for each in names if may_call(which, each)}:
            attacker.notify(contact, name)  # a notification, which gets no answer, must be rejected, too
        team.run(1.0)
        allowed = [name for name in names if may_call(which, name)]
        self.assertEqual(sorted(ran), sorted(allowed), which)
        for name in set(names) - set(allowed):
            self.assertIsInstance(outcomes[name], Refused, name)
            self.assertEqual(outcomes[name].code, "role", name)
        counted = team.houses[0].node.endpoint.counters["refused"] - refused
        self.assertEqual(counted, 2 * (len(names) - len(allowed)))

    @settings(max_examples=60)
    @given(st.sets(st.sampled_from(ROLES)), st.sampled_from([*METHODS, "made.up", ""]), st.sampled_from(ROLES))
    def test_more_roles_allow_no_less(self, which: set[str], method: str, more: str) -> None:
        """An additional role never removes a right, and a member without roles has no rights."""
        self.assertLessEqual(may_call(which, method), may_call(which | {more}, method))
        self.assertFalse(may_call((), method))


class RecordTests(SiegeCase):
    def test_every_kind_by_every_role(self) -> None:
        """A record in a namespace in which its owner's role may not write is not stored; the sender gets the reason."""
        team = self.village()
        house = team.houses[0]
        kinds = set()
        for number, role in enumerate(ROLES):
            attacker, own = self.insider(team, role, role, at=SOURCE._replace(port=600 + number))
            for key in KEYS:
                for name in NAMES:
                    record = Record(hash_key(key), name, own.public, 1, "team", 600.0, b"x").sign(own)
                    kinds.add(classify_slot(record.slot))
                    asked = attacker.ask(team.contact(house), "store", [record.pack()], changes=True)
                    [decision] = self.outcome(team, asked, 0.1)
                    held = house.node.replica.holds(record)
                    self.assertEqual(held, may_store((role,), record.slot, role), (role, key, name))
                    self.assertEqual(decision == Outcome.FORBIDDEN.value, not held, (role, key, name))
        self.assertEqual(kinds, set(KINDS))


class OwnerTests(SiegeCase):
    def setUp(self) -> None:
        """Create a team of three with a record of the first member, and a malicious member."""
        super().setUp()
        self.team = self.village()
        for name in ("dog", "cat"):
            self.team.enlist(name)
        self.key = hash_key("mine")
        self.outcome(self.team, self.team.houses[0].node.put(self.key, "slot", b"true"))
        self.outcome(self.team, self.team.houses[0].node.put(self.key, "slot", b"truer"))
        [self.record] = self.held()
        self.bad, self.own = self.insider(self.team, "bad", "device", "operator", "gateway", "bootstrap")

    def held(self) -> list[Record]:
        """Return the stored records of the key, which must be equal at all replicas."""
        found = [house.node.replica.get_held(self.key) for house in self.team.houses]
        self.assertTrue(all(each == found[0] for each in found))
        return found[0]

    def attack(self, record: Record) -> None:
        """Send a record to every node with every method that accepts records."""
        packed, key = [record.pack()], record.key
        for house in self.team.houses:
            contact = self.team.contact(house)
            for method, arguments in (
                ("store", (packed,)),
                ("store", (packed, [600.0])),
                ("cache", (key, packed, 60.0)),
                ("push", (key, 1, packed, [])),
                ("push", (key, 1, [], [[record.owner, record.name]])),
                ("let_go", ([record.digest()[:8]],)),
                ("alive", (0.001, bytes(8))),
                ("goodbye", ()),
            ):
                self.bad.ask(contact, method, *arguments, changes=True).addErrback(lambda failure: None)
        self.team.run(0.5)

    def test_anything_of_it_changed(self) -> None:
        """A record with a changed field, a changed signature or a different signer is rejected by every node."""
        other = Identity(b"z" * 32)
        newer = replace(self.record, sequence=self.record.sequence + 9)
        for record in (
            replace(self.record, value=b"false"),
            replace(self.record, value=None),
            newer,
            replace(newer, value=None).sign(self.own),
            replace(newer, ttl=0.5),
            replace(newer, lifetime="leased"),
            replace(self.record, signature=bytes(64)),
            newer.sign(other),
            replace(self.record, name="slot2"),
        ):
            self.attack(record)
            self.assertEqual(self.held(), [self.record])

    def test_an_older_one(self) -> None:
        """An older version that the owner had signed earlier does not replace the record."""
        first = Record(self.key, "slot", self.record.owner, 1, "team", self.record.ttl, b"true")
        older = first.sign(self.team.houses[0].kept.membership.identity)
        self.attack(older)
        self.assertEqual(self.held(), [self.record])

    def test_a_deleted_one(self) -> None:
        """A removed record stays removed, even if another node stored a copy of it."""
        self.outcome(self.team, self.team.houses[0].node.remove(self.key, "slot"))
        self.attack(self.record)
        self.assertEqual([record.value for record in self.held()], [None])

    @settings(max_examples=25)
    @given(st.data())
    def test_any_mixture(self, data: Any) -> None:
        """No combination of changed fields replaces the record."""
        changed = replace(
            self.record,
            name=data.draw(st.sampled_from(["slot", "", "other"])),
            owner=data.draw(st.sampled_from([self.record.owner, self.team.houses[1].public])),
            sequence=data.draw(st.integers(0, 2**63 - 1)),
            lifetime=data.draw(st.sampled_from(["leased", "team"])),
            ttl=data.draw(st.floats(0.001, 1000.0)),
            value=data.draw(st.none() | st.binary(max_size=8)),
        )
        if changed != self.record:
            self.attack(changed.sign(self.own) if data.draw(st.booleans()) else changed)
        self.assertEqual(self.held(), [self.record])


class CertificateTests(SiegeCase):
    def refused(self, number: int, certificate: bytes, incarnation: Identity, secret: bytes) -> str:
        """Return the code with which a node rejects a peer that presents this certificate."""
        attacker = self.attacker(self.team, incarnation, secret, certificate, SOURCE._replace(port=700 + number))
        code = self.refusal(self.team, attacker.ask, self.team.houses[0], 3.0)
        self.assertNotIn(incarnation.public, [each.public for each in self.team.houses[0].node.overlay.contacts()])
        return code

    def test_passes_that_do_not_hold(self) -> None:
        """An expired, early, stolen, truncated or missing certificate, or one of another team, is rejected."""
        self.team = team = self.village()
        other = self.village(seed=2)
        secret = team.houses[0].kept.membership.secrets[0][1]
        own = Identity(b"x" * 32)
        over = team.signer.grant(own.public, "x", ("device",), NOW - 9000, 8000)
        early = team.signer.grant(own.public, "x", ("device",), NOW + 90_000)
        good = team.signer.grant(own.public, "x", ("device",), NOW)
        foreign = other.signer.grant(own.public, "x", ("device",), NOW)
        passes = {
            "over": (wrap_grant(over), "expired"),
            "early": (wrap_grant(early), "early"),
            "foreign": (wrap_grant(foreign), "foreign"),
            "another's": (team.houses[0].kept.membership.certificate, "foreign"),
            "cut short": (wrap_grant(good)[:-1], "foreign"),
            "none": (b"", "foreign"),
            "changed": (wrap_grant(good).replace(b"\xa1x", b"\xa1y"), "foreign"),
        }
        for number, (name, (certificate, code)) in enumerate(passes.items()):
            self.assertEqual(self.refused(number, certificate, own, secret), code, name)
