"""Attack S9: surround a key or a node with identities of the attacker, poison routing tables, and lie in lookups."""

from __future__ import annotations

import random
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.contact import Contact
from middleware.entangled.errors import NotAdmitted
from middleware.entangled.identity import Identity, derive_node_id
from middleware.entangled.kademlia.routing_table import RoutingTable
from middleware.entangled.network.network import Address
from middleware.entangled.record import hash_key
from tests.attacks.siege import SOURCE, SiegeCase
from tests.fleet import EntangledTeam, FleetCase
from tests.middleware.admission.village import Village

K = 8


def sybils(count: int, seed: int = 1) -> list[Contact]:
    """Return invented identities, each with a different address."""
    dice = random.Random(seed)
    return [
        Contact(dice.randbytes(32), Address(f"10.{6 + n // 65025}.{n // 255 % 255}.{1 + n % 254}", 666))
        for n in range(count)
    ]


class OutsiderTests(SiegeCase):
    def everybody(self, team: Village) -> set[bytes]:
        """Return the keys that the nodes of the team regard as members."""
        nodes = [house.node for house in team.houses]
        return {contact.public for node in nodes for contact in node.overlay.contacts()}

    def test_ten_thousand_around_a_key(self) -> None:
        """Ten thousand invented identities near a key enter no table, although a member returns them in lookups.

        The key stays readable.
        """
        team = self.village()
        for name in ("dog", "cat", "pig", "cow"):
            team.enlist(name)
        key = hash_key("task")
        self.outcome(team, team.houses[1].node.put(key, "x", b"kept"))
        members = self.everybody(team)
        crowd = sorted(
            sybils(10_000), key=lambda each: int.from_bytes(derive_node_id(each.public)) ^ int.from_bytes(key)
        )
        for house in team.houses:
            self.assertFalse(crowd[0] in house.node.overlay.contacts())
        bad, _ = self.insider(team, "bad")  # a member returns the invented identities in lookups
        page = [contact.pack() for contact in crowd[:K]]
        bad.expose("find_node", lambda peer, target: page)
        bad.expose("members", lambda peer, after: page)
        bad.expose("ping", lambda peer, digest: bytes(8), changes=True)
        bad.expose("known", lambda peer: [[fields, 0] for fields in page])
        for house in team.houses:
            self.outcome(team, bad.ask(team.contact(house), "ping", bytes(8), changes=True))
        team.run(20.0)
        found = [self.outcome(team, house.node.get(key), 5.0) for house in team.houses]
        self.assertEqual([[record.value for record in each] for each in found], [[b"kept"]] * len(team.houses))
        self.assertFalse({each.public for each in crowd} & self.everybody(team))
        self.assertLessEqual(members, self.everybody(team))

    def test_identities_without_certificates(self) -> None:
        """Invented identities that have the team's secret but no certificate are rejected, and enter no table."""
        team = self.village()
        secret = team.houses[0].team.secret
        refused = 0
        for number in range(60):
            own = Identity(random.Random(number).randbytes(32))
            bad = self.attacker(team, own, secret, b"", SOURCE._replace(port=1000 + number))
            asked = bad.ask(team.contact(team.houses[0]), "ping", bytes(8), changes=True)
            refused += isinstance(self.outcome(team, asked, 0.2), NotAdmitted)
        self.assertEqual(refused, 60)
        self.assertEqual(self.everybody(team), set())
        self.assertEqual(len(team.houses[0].node.endpoint._sessions), 0)


class TableTests(SynchronousTestCase):
    def test_flushed_by_ever_new_ids(self) -> None:
        """Ten thousand new contacts displace no contact that still replies."""
        old, [me] = sybils(40, 3), sybils(1, 2)
        table = RoutingTable(me.node_id, K)
        for contact in old:
            table.record_contact(contact, 0.0)
        before = set(table.list_contacts())
        for moment, contact in enumerate(sybils(10_000)):
            doubtful = table.record_contact(contact, 10.0 + moment / 100)
            if doubtful is not None and doubtful in before:
                table.record_contact(doubtful, 10.0 + moment / 100)  # the old contact replies
        self.assertLessEqual(before, set(table.list_contacts()))
        self.assertLess(len(table), 40 * K)

    def test_own_id(self) -> None:
        """A contact with the node's own id is not added."""
        [contact] = sybils(1)
        table = RoutingTable(contact.node_id, K)
        table.record_contact(contact, 0.0)
        self.assertEqual(len(table), 0)


class InsiderTests(FleetCase):
    def lied(self, fleet: EntangledTeam, share: float) -> list[int]:
        """Let a share of the members lie in lookups and discard records; return the honest members."""
        dice = random.Random(4)
        count = round(share * len(fleet.nodes))
        liars = sorted(dice.sample(range(1, len(fleet.nodes)), count))
        page = [fleet.nodes[place].contact.pack() for place in liars][:K]
        page += [contact.pack() for contact in sybils(K)]
        for place in liars:
            methods: dict[str, Any] = {
                "find_node": lambda peer, target: page[:K],
                "members": lambda peer, after: page[:K],
                "find_value": lambda peer, key, *rest: [[], None, 1, page[:K]],
                "store": lambda peer, packed, *rest: [0] * len(packed),
                "watch": lambda peer, key, digest: [0, [[], None]],
            }
            for name, answer in methods.items():
                fleet.nodes[place].endpoint.expose(name, answer, changes=name in ("store", "watch"))
        return [place for place in range(len(fleet.nodes)) if place not in liars]

    def share_read(self, share: float) -> float:
        """Return the share of 40 keys, written before the members lie, that honest members read correctly."""
        fleet = self.fleet(20)
        fleet.run(10.0)
        values = {hash_key(f"k{number}"): b"%d" % number for number in range(40)}
        for number, (key, value) in enumerate(values.items()):
            self.done(fleet, fleet.nodes[number % 20].put(key, "x", value), 0.5)
        honest = self.lied(fleet, share)
        fleet.run(5.0)
        right = 0
        for number, (key, value) in enumerate(values.items()):
            reader = fleet.nodes[honest[number % len(honest)]]
            found: list[Any] = []
            reader.get(key).addBoth(found.append)
            fleet.run(3.0)
            right += bool(found) and isinstance(found[0], list) and [r.value for r in found[0]] == [value]
        return right / len(values)

    def test_thirty_of_a_hundred(self) -> None:
        """If 10 % of the members lie, all keys are read correctly.

        If 20 % lie, at least 99 % of the keys are read correctly; if 30 % lie, at least 95 %.
        """
        for share, least in ((0.10, 1.0), (0.20, 0.99), (0.30, 0.95)):
            self.assertGreaterEqual(self.share_read(share), least, share)

    def test_liars_bring_nobody_in(self) -> None:
        """A contact that a liar returns enters no table before it proves its key at its address."""
        fleet = self.fleet(12)
        fleet.run(5.0)
        self.lied(fleet, 0.3)
        fleet.run(30.0)
        made_up = {each.public for each in sybils(K)}
        for node in fleet.nodes:
            self.assertFalse(made_up & {contact.public for contact in node.overlay.contacts()})
