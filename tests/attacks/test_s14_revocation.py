"""Attack S14: evade a revocation, fill the membership list, or be a member that cannot be revoked."""

from __future__ import annotations

import random

from middleware.admission.certificate import issue_certificate, issue_guest_certificate, sign_join
from middleware.admission.closed_admission import MAX_GUESTS_PER_GATEWAY
from middleware.admission.join_code import JoinCode, parse_code
from middleware.admission.membership_list import (
    MAX_ENTRIES,
    RESERVED_ENTRIES,
    MembershipList,
    invitation_id,
    pack_admission,
)
from middleware.admission.statement import Invite
from middleware.entangled.errors import Full, NotAdmitted
from middleware.entangled.identity import Identity
from middleware.entangled.wire.admission_check import REVOKED, UNLISTED
from tests.attacks.siege import SOURCE, SiegeCase
from tests.middleware.admission.paper import NOW, granted, identity, operator
from tests.middleware.admission.village import Village

BOOT = identity("boot")


class BackdatingTests(SiegeCase):
    def setUp(self) -> None:
        """Create a team with a malicious bootstrap node, and a join code for five members."""
        super().setUp()
        self.team: Village = self.village(bootstraps=2)
        self.thief = self.team.houses[1]
        self.code: JoinCode = parse_code(self.team.invite("dog", uses=5))
        invite = self.team.houses[0].team.membership_list.list_invitations()[0]
        grant = self.team.houses[0].team.membership_list.find_grant(self.thief.public)
        assert grant is not None
        self.invite, self.grant = invite, grant[1]
        known = self.team.houses[0].team.membership_list.find_invitation(invitation_id(invite.public))
        assert known is not None
        self.packed = known[1]

    def mint(self, seed: int, begin: int) -> tuple[Identity, bytes]:
        """Return a new member that the malicious node admits, with a certificate that starts at ``begin``."""
        own = Identity(bytes([seed]) * 32)
        came = (own.public, "", sign_join(self.code.key, own.public, ""))
        thief = self.thief.kept.membership.identity
        return own, issue_certificate(thief, self.grant, (self.packed, self.invite), came, f"dog-{seed}", begin)

    def enter(self, own: Identity, shown: bytes, port: int) -> str:
        """Return the code with which the first node rejects the member, or "" if that node admits the member."""
        secret = self.team.houses[0].kept.membership.secrets[0][1]
        endpoint = self.attacker(self.team, own, secret, shown, SOURCE._replace(port=port))
        return self.refusal(self.team, endpoint.ask, self.team.houses[0], 4.0)

    def test_backdated_members(self) -> None:
        """Members admitted by a revoked bootstrap node are rejected, whatever their dates.

        Members that the operator keeps stay.
        """
        kept, shown = self.mint(1, int(self.team.wall()))
        self.assertEqual(self.enter(kept, shown, 701), "")
        revoke = self.team.signer.revoke(self.thief.public, "boot1", self.team.wall(), members=[kept.public])
        self.outcome(self.team, self.team.tell(revoke))
        self.team.run(2.0)
        for number in (2, 3, 4):
            own, shown_too = self.mint(number, self.invite.not_before)
            self.assertEqual(self.enter(own, shown_too, 700 + number), REVOKED)
        self.assertIn("dog-1", self.team.members())
        self.assertNotIn("dog-2", self.team.members())

    def test_revoked_with_all(self) -> None:
        """If the operator revokes a bootstrap node and keeps none of the members that it admitted, all are revoked."""
        own, shown = self.mint(1, int(self.team.wall()))
        self.enter(own, shown, 701)
        self.assertIn("dog-1", self.team.members())
        self.outcome(self.team, self.team.tell(self.team.signer.revoke(self.thief.public, "boot1", self.team.wall())))
        self.team.run(2.0)
        self.assertNotIn("dog-1", self.team.members())

    def test_more_uses_than_the_code_has(self) -> None:
        """A bootstrap node cannot list more members for a code than the code has uses."""
        codes = [self.enter(*self.mint(number, int(self.team.wall())), 700 + number) for number in range(1, 9)]
        self.assertEqual(codes, [""] * 5 + [UNLISTED] * 3)


class RoomTests(SiegeCase):
    def test_room_for_the_operator(self) -> None:
        """A membership list that a bootstrap node filled accepts a revocation of the operator, which frees space."""
        signer = operator(1)
        membership_list = MembershipList(signer.public)
        grant = granted(signer, "boot", "bootstrap")
        membership_list.add(grant, NOW)
        rng = random.Random(1)
        with self.assertRaises(Full):
            for code in range(MAX_ENTRIES):
                invitation = signer.invite(f"p{code}", ("device",), 100, NOW, 3600.0, rng)
                invite = membership_list.add(invitation.invite, NOW)
                assert isinstance(invite, Invite)
                for number in range(invite.uses):
                    public = rng.randbytes(32)
                    came = (public, "", sign_join(invitation.code.key, public, ""))
                    shown = issue_certificate(BOOT, grant, (invitation.invite, invite), came, f"p{code}-{number}", NOW)
                    membership_list.add(pack_admission(public, shown), NOW)
        self.assertGreater(len(membership_list.list_admissions()), 400)
        self.assertLessEqual(len(membership_list.list_admissions()), MAX_ENTRIES - RESERVED_ENTRIES)
        membership_list.add(signer.revoke(BOOT.public, "boot", NOW), NOW)
        self.assertIsNotNone(membership_list.find_revocation(BOOT.public))
        self.assertEqual(membership_list.list_admissions(), [])


class UnlistedTests(SiegeCase):
    def test_who_is_met_is_listed(self) -> None:
        """A member with a grant that is on no membership list is added by its first session, and can be revoked."""
        team = self.village()
        team.enlist("cat")
        hidden, own = self.insider(team, "ghost", "viewer")
        self.assertNotIn("ghost", team.members())
        self.outcome(team, hidden.ask(team.contact(team.houses[0]), "ping", bytes(8), changes=True))
        team.run(6.0)
        self.assertEqual([team.members(place) for place in (0, 1)], [["cat", "ghost", "vaio"]] * 2)
        self.outcome(team, team.tell(team.signer.revoke(own.public, "ghost", team.wall())))
        team.run(2.0)
        error = self.outcome(team, hidden.ask(team.contact(team.houses[0]), "roll.secret", 1), 4.0)
        self.assertIsInstance(error, NotAdmitted)

    def test_any_key_can_be_revoked(self) -> None:
        """A key that is not on the membership list can be revoked; after that its certificate is rejected."""
        team = self.village()
        paper = team.paper("ghost", "viewer")
        public = paper.identity.public
        self.outcome(team, team.tell(team.signer.revoke(public, "ghost", team.wall())))
        hidden = self.attacker(team, paper.identity, paper.secrets[0][1], paper.certificate)
        self.assertEqual(self.refusal(team, hidden.ask, team.houses[0], 4.0), REVOKED)


class GuestTests(SiegeCase):
    def test_guests_of_one_gateway_are_few(self) -> None:
        """A node admits a limited number of guests of one gateway, and rejects all further ones as ``unlisted``."""
        team = self.village()
        paper = team.paper("gate", "gateway")
        refused = []
        for number in range(MAX_GUESTS_PER_GATEWAY + 3):
            guest = Identity(number.to_bytes(32))
            shown = issue_guest_certificate(paper.identity, paper.certificate, guest.public, "phone", int(team.wall()))
            refused.append(team.houses[0].team.admission.admit(guest.public, shown))
        self.assertEqual(refused, [""] * MAX_GUESTS_PER_GATEWAY + [UNLISTED] * 3)
