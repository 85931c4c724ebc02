"""Attack S10: act as a stolen or malicious member, which the team must exclude within ten seconds of its revocation."""

from __future__ import annotations

from typing import Any

from middleware.admission.membership_file import Membership
from middleware.entangled.record import hash_key
from tests.attacks.siege import SOURCE, SiegeCase
from tests.middleware.admission.village import House, Village, network_of

IN_FORCE = 10.0


class RevocationCase(SiegeCase):
    """A team with one malicious member."""

    members = 9

    def setUp(self) -> None:
        super().setUp()
        self.team: Village = self.village(bootstraps=2)
        for number in range(2, self.members):
            self.team.enlist(f"dog{number}", "device", "operator", "bootstrap")
        self.team.run(10.0)
        self.bad: House = self.team.houses[7]
        self.others = [house for house in self.team.houses if house is not self.bad]

    def revoke(self) -> None:
        """Publish the revocation at the first node."""
        self.team.tell(self.team.signer.revoke(self.bad.public, self.bad.name, self.team.wall()))

    def out(self, among: list[House]) -> list[str]:
        """Return the nodes that still have the revoked member as a contact, in a session or in the membership list."""
        return [
            house.name
            for house in among
            if self.bad.public in [contact.public for contact in house.node.overlay.contacts()]
            or house.node.endpoint.has_session(self.team.contact(self.bad))
            or self.bad.name in [member.name for member in house.team.list_members()]
        ]

    def refusals(self, bare: Any, among: list[House]) -> set[str]:
        """Return the codes with which nodes reject an attacker that uses the stolen identity."""
        return {self.refusal(self.team, bare.ask, house, 0.5) for house in among}

    def bare(self, at: int = 1, incarnation: int = 2**62) -> Any:
        """Return an endpoint on another machine with the identity, certificate and secret of the stolen store."""
        paper: Membership = self.bad.kept.membership
        where = SOURCE._replace(port=600 + at)
        return self.attacker(self.team, paper.identity, paper.secrets[0][1], paper.certificate, where, incarnation)


class TwentyTests(RevocationCase):
    members = 20

    def test_out_within_ten_seconds(self) -> None:
        """Ten seconds after the revocation no connected node has the member as a contact.

        Each rejects it as ``revoked``.
        """
        self.revoke()
        self.team.run(IN_FORCE)
        self.assertEqual(self.out(self.others), [])
        self.team.close(self.bad, is_sudden=True)
        self.assertEqual(self.refusals(self.bare(), self.others), {"revoked"})

    def test_after_a_cut(self) -> None:
        """When a partition ends, the nodes that it had cut off exclude the revoked member within ten seconds."""
        near = self.team.houses[:12]
        far = self.team.houses[12:]
        self.team.switchboard.partition([self.team.address_of(each) for each in near])
        self.team.run(30.0)
        self.revoke()
        self.team.run(IN_FORCE)
        self.assertEqual(self.out([house for house in near if house is not self.bad]), [])
        self.team.switchboard.heal()
        self.team.run(IN_FORCE)
        self.assertEqual(self.out(far), [])


class RevocationTests(RevocationCase):
    def test_across_a_restart(self) -> None:
        """A restarted node still rejects the revoked member, even if the node can contact no other node."""
        self.revoke()
        self.team.run(IN_FORCE)
        self.team.close(self.bad, is_sudden=True)
        for house in self.others:
            self.team.close(house, is_sudden=True)
        first = self.others[3]
        self.team.open(first)
        self.team.run(1.0)
        self.assertEqual(self.refusals(self.bare(), [first]), {"revoked"})
        for house in self.others:
            if house is not first:
                self.team.open(house)
        self.team.run(10.0)
        self.assertEqual(self.refusals(self.bare(2), self.others[:4]), {"revoked"})

    def test_a_copy_of_its_store(self) -> None:
        """A copy of the member's store on another machine is rejected, for a lower or higher incarnation number."""
        self.revoke()
        self.team.run(IN_FORCE)
        for number, incarnation in enumerate(
            (1, 2**62)
        ):  # with a lower incarnation number the reason may also be that a higher number is known
            told = self.refusals(self.bare(number, incarnation), self.others[:3])
            self.assertLessEqual(told, {"revoked", "doubled"} if incarnation == 1 else {"revoked"})

    def test_its_bootstrap_days_are_over(self) -> None:
        """A revoked bootstrap node cannot admit a new member."""
        code = self.team.invite("pup")
        self.revoke()
        self.team.run(IN_FORCE)
        knocked = self.team.knock(code, (self.bad.place,), timeout=6.0)
        self.team.run(8.0)
        knocked.addErrback(lambda failure: None)
        self.assertNotIn("pup", self.team.members())

    def test_what_it_wrote_on_lease_goes(self) -> None:
        """Leased records of the revoked member expire."""
        key = hash_key("devices")
        self.outcome(self.team, self.bad.node.put(key, "dog7", b"here", "leased"))
        self.assertEqual(len(self.outcome(self.team, self.others[0].node.get(key))), 1)
        self.revoke()
        self.team.run(IN_FORCE + 3.0)
        self.assertEqual(self.outcome(self.team, self.others[0].node.get(key)), [])

    def test_after_the_secret_is_rotated(self) -> None:
        """After a rotation of the secret the revoked member gets no reply to a handshake."""
        self.revoke()
        members = [house.public for house in self.others]
        self.team.run(2.0)
        self.team.tell(self.team.signer.rotate_secret(2, members, self.team.wall(), 5.0, self.team.dice))
        self.team.run(30.0)
        self.team.close(self.bad, is_sudden=True)
        bare = self.bare()
        sent: list[Any] = []
        for house in self.others:
            network: Any = network_of(house)
            send = network.send

            def sends(datagram: bytes, to: Any, send: Any = send) -> None:
                if to.host == SOURCE.host:
                    sent.append(datagram)
                send(datagram, to)

            network.send = sends
        outcome = self.outcome(self.team, bare.ask(self.team.contact(self.others[0]), "ping", bytes(8)), 3.0)
        self.assertEqual((type(outcome).__name__, sent), ("NoAnswer", []))
