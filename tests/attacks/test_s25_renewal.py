"""Attack S25: evade the operator's decision by renewals that are self-made, backdated, or signed by hostile nodes."""

from __future__ import annotations

from collections.abc import Sequence

import msgpack
from twisted.internet.defer import Deferred

from middleware.admission.certificate import (
    Member,
    issue_certificate,
    renew_certificate,
    sign_join,
    verify_certificate,
    wrap_grant,
)
from middleware.admission.join_code import JoinCode, parse_code
from middleware.admission.membership_file import Membership
from middleware.admission.membership_list import invitation_id, pack_admission
from middleware.admission.statement import DEFAULT_LIFE_S
from middleware.entangled.identity import Identity
from middleware.entangled.wire.admission_check import EXPIRED, FOREIGN, REVOKED, UNLISTED
from tests.attacks.siege import SOURCE, SiegeCase
from tests.middleware.admission.paper import identity

DAY = 86_400
DOG = identity("dog")


class RenewalCase(SiegeCase):
    """A team with two bootstrap nodes, of which the second is hostile, and a plain member that checks certificates."""

    def setUp(self) -> None:
        super().setUp()
        self.port = 700
        self.team = self.village(bootstraps=2)
        self.admission = self.team.enlist("cat")
        self.honest, self.thief = (self.grant_of(house.public) for house in self.team.houses[:2])
        self.keys = [house.kept.membership.identity for house in self.team.houses[:2]]
        self.team.run(2.0)

    def grant_of(self, public: bytes) -> bytes:
        found = self.team.houses[0].team.membership_list.find_grant(public)
        assert found is not None
        return found[1]

    def word(self, roles: Sequence[str] = ("device",), life: float = DEFAULT_LIFE_S, own: Identity = DOG) -> bytes:
        """Return a certificate that consists of a new grant of the operator, valid from now on."""
        return wrap_grant(self.team.signer.grant(own.public, "dog", roles, self.team.wall(), life))

    def read(self, shown: bytes, own: Identity = DOG) -> Member:
        return verify_certificate(self.team.signer.public, own.public, shown)

    def renew(self, shown: bytes, ago: float = 0.0, own: Identity = DOG, by: int = 1) -> bytes:
        """Return the certificate ``shown`` as renewed ``ago`` seconds ago, by default by the hostile bootstrap node."""
        member, begin = self.read(shown, own), int(self.team.wall() - ago)
        return renew_certificate(self.keys[by], (self.honest, self.thief)[by], member, shown, begin)

    def said(self, shown: bytes, own: Identity = DOG) -> str:
        """Return the code with which the honest nodes reject a certificate, or "" if they accept it."""
        answers = {self.team.houses[place].team.admission.admit(own.public, shown) for place in (0, 2)}
        self.assertEqual(len(answers), 1, answers)
        return answers.pop()

    def end(self, own: Identity = DOG) -> int:
        """Return the expiry of the key's certificate, as known by a plain member."""
        member = self.admission.team.admission.find_member(own.public)
        assert member is not None
        return member.not_after

    def let_in(self, code: JoinCode, name: str, own: Identity = DOG) -> bytes:
        """Return the certificate of a key that the hostile node admits with a code."""
        found = self.admission.team.membership_list.find_invitation(invitation_id(code.key.public))
        assert found is not None
        came = (own.public, "", sign_join(code.key, own.public, ""))
        return issue_certificate(self.keys[1], self.thief, (found[1], found[0]), came, name, int(self.team.wall()))

    def tell(self, statement: bytes) -> None:
        self.outcome(self.team, self.team.tell(statement))
        self.team.run(2.0)

    def enter(self, shown: bytes, own: Identity = DOG) -> str:
        """Return the code with which a node rejects a peer with this key and certificate."""
        secret = self.admission.kept.membership.secrets[0][1]
        self.port += 1
        endpoint = self.attacker(self.team, own, secret, shown, SOURCE._replace(port=self.port))
        return self.refusal(self.team, endpoint.ask, self.admission, 4.0)


class RevokedBootstrapTests(RenewalCase):
    def test_backdated(self) -> None:
        """After a bootstrap node's revocation only those of its renewals are valid that the operator kept.

        The dates in the renewals have no influence.
        """
        old = self.word()
        self.team.days = 300
        kept = self.renew(old)
        self.assertEqual(self.said(kept), "")
        end = self.read(kept).not_after
        self.team.days = 310
        renewals = [(DOG.public, end)]
        self.tell(self.team.signer.revoke(self.keys[1].public, "boot1", self.team.wall(), renewals=renewals))
        self.team.days = 400
        self.assertEqual(self.said(kept), "")
        for ago in (0, 95 * DAY, 100 * DAY, 399 * DAY):
            late = self.renew(old, ago)
            if late != kept:
                self.assertEqual(self.said(late), "")  # the kept renewal is on the membership list and applies instead
        self.assertEqual(self.end(), end)
        self.team.days = 300 + 366
        self.assertEqual({self.said(self.renew(old, ago * DAY)) for ago in (0, 10, 300, 360)}, {EXPIRED})

    def test_not_kept(self) -> None:
        """Renewals that the operator did not keep are void; another node can renew the previous certificate."""
        old = self.word()
        self.team.days = 300
        self.assertEqual(self.said(self.renew(old)), "")
        self.tell(self.team.signer.revoke(self.keys[1].public, "boot1", self.team.wall()))
        self.assertEqual(self.end(), self.read(old).not_after)
        self.team.days = 370
        self.assertEqual(self.said(self.renew(old, 80 * DAY)), EXPIRED)
        self.assertEqual(self.enter(self.renew(old, 80 * DAY)), EXPIRED)
        self.assertEqual(self.said(self.renew(old, by=0)), "")

    def test_behind_a_void_renewal(self) -> None:
        """A member with a valid grant and an invalid renewal of it is admitted by the grant, and is listed."""
        ghost = identity("ghost")
        old = wrap_grant(self.team.signer.grant(ghost.public, "ghost", ("viewer",), self.team.wall()))
        self.tell(self.team.signer.revoke(self.keys[1].public, "boot1", self.team.wall()))
        self.assertEqual(self.said(self.renew(old, own=ghost), ghost), "")
        self.assertEqual([("ghost" in self.team.members(place)) for place in (0, 2)], [True, True])

    def test_without_the_role(self) -> None:
        """A bootstrap node that lost this role cannot renew certificates, even with its earlier grant."""
        old = self.word()
        self.team.days = 300
        grant = self.team.signer.grant(self.keys[1].public, "boot1", ("device",), self.team.wall())
        self.tell(grant)
        self.team.days = 370
        self.assertEqual({self.said(self.renew(old, ago * DAY)) for ago in (0, 80, 360)}, {EXPIRED})

    def test_laundered_admission(self) -> None:
        """If a revoked bootstrap node admitted a member, the member is revoked even if another node renewed it."""
        shown = self.let_in(parse_code(self.team.invite("pup")), "pup")
        self.team.days = 300
        shown = self.renew(shown, by=0)
        self.assertEqual(self.said(shown), "")
        self.tell(self.team.signer.revoke(self.keys[1].public, "boot1", self.team.wall()))
        self.assertEqual(self.said(shown), REVOKED)
        self.assertNotIn("pup", self.team.members(2))


class SelfRenewalTests(RenewalCase):
    def test_a_plain_member(self) -> None:
        """A renewal signed by a member without the role bootstrap is invalid, no matter whose key is renewed."""
        old = self.word(("device", "operator", "gateway"))
        grant = msgpack.unpackb(old)[1]
        self.team.days = 360
        mine = renew_certificate(DOG, grant, self.read(old), old, int(self.team.wall()))
        self.assertEqual(self.said(mine), FOREIGN)
        forged = renew_certificate(DOG, self.honest, self.read(old), old, int(self.team.wall()))
        self.assertEqual(self.said(forged), FOREIGN)

    def test_a_bootstrap_node_beside_others(self) -> None:
        """A bootstrap node with an expired renewal cannot renew its own certificate if there is another such node."""
        old, own = wrap_grant(self.thief), self.keys[1]
        self.team.days = 300
        mine = [self.renew(old, ago, own) for ago in (0, 200 * DAY)]
        self.tell_renewal(0)
        self.team.days = 370
        self.assertEqual({self.said(each, own) for each in mine}, {EXPIRED})

    def tell_renewal(self, place: int) -> None:
        """Let the other one of the two bootstrap nodes renew the bootstrap node with the index ``place``."""
        shown = wrap_grant((self.honest, self.thief)[place])
        public = self.keys[place].public
        again = self.renew(shown, own=self.keys[place], by=1 - place)
        self.team.houses[2].team._gossip.add(pack_admission(public, again))
        self.team.run(2.0)

    def test_a_short_one_renews_nobody(self) -> None:
        """A bootstrap node with a grant for a month cannot renew certificates, even within that month."""
        own = identity("helper")
        grant = self.team.signer.grant(own.public, "helper", ("bootstrap",), self.team.wall(), 30 * DAY)
        old = self.word()
        again = renew_certificate(own, grant, self.read(old), old, int(self.team.wall()))
        self.assertEqual(self.said(again), FOREIGN)


class WideningTests(RenewalCase):
    def test_roles_that_were_taken_away(self) -> None:
        """A renewal of an earlier grant does not restore roles that the operator removed with a later grant."""
        old = self.word(("device", "operator"))
        self.team.days = 1
        self.tell(msgpack.unpackb(self.word(("viewer",)))[1])
        self.team.days = 2
        again = self.renew(old)
        self.assertEqual(self.said(again), "")
        self.assertEqual(self.admission.team.admission.roles_of(DOG.public), {"viewer"})

    def test_when_the_narrower_grant_has_ended(self) -> None:
        """An expired grant still overrides the operator's earlier grants to the same key."""
        old = self.word(("device", "operator"))
        self.assertEqual(self.said(old), "")
        self.team.days = 1
        self.tell(msgpack.unpackb(self.word(("viewer",), 10 * DAY))[1])
        self.team.days = 20
        self.team.run(12.0)
        self.assertEqual(self.said(old), EXPIRED)
        self.assertEqual(self.said(self.renew(old)), EXPIRED)

    def test_another_word(self) -> None:
        """Roles, name, lifetime and dates of a renewal are signed; a renewal with any change is rejected."""
        old = self.word()
        self.team.days = 300
        fields = msgpack.unpackb(self.renew(old))
        wider = msgpack.unpackb(self.word(("operator",)))[1]
        for place, value in ((1, [wider]), (2, fields[2] + 1), (3, fields[3] + 1), (3, fields[3] + DEFAULT_LIFE_S)):
            changed = [*fields[:place], value, *fields[place + 1 :]]
            self.assertEqual(self.said(msgpack.packb(changed)), FOREIGN)

    def test_longer_than_its_life(self) -> None:
        """A renewal that exceeds the lifetime granted by the operator is rejected."""
        old = self.word()
        member = self.read(old)
        long = Member(member.public, "dog", member.roles, 0, 0, since=member.since, life=3 * DEFAULT_LIFE_S)
        again = renew_certificate(self.keys[1], self.thief, long, old, int(self.team.wall()))
        self.assertEqual(self.said(again), FOREIGN)

    def test_a_name_by_a_bootstrap_node(self) -> None:
        """A bootstrap node cannot change the name of a member that joined with a code."""
        dog = self.team.welcome("dog")
        shown, own = dog.kept.membership.certificate, dog.kept.membership.identity
        fields = msgpack.unpackb(shown)
        fields[4] = "vaio"
        again = renew_certificate(
            self.keys[1], self.thief, self.read(shown, own), msgpack.packb(fields), int(self.team.wall())
        )
        self.assertEqual(self.said(again, own), FOREIGN)

    def test_shortened(self) -> None:
        """A bootstrap node cannot shorten the validity of a certificate."""
        old = self.word()
        self.team.days = 300
        good = self.renew(old, by=0)
        self.assertEqual(self.said(good), "")
        self.assertEqual(self.said(self.renew(old, 290 * DAY)), "")
        self.assertEqual(self.end(), self.read(good).not_after)

    def test_in_the_place_of_a_good_one(self) -> None:
        """A longer renewal of an earlier grant does not displace a renewal of the current grant."""
        old = self.word(life=3 * DEFAULT_LIFE_S)
        self.team.days = 1
        new = self.word()
        self.tell(msgpack.unpackb(new)[1])
        self.team.days = 300
        self.said(self.renew(old))
        good = self.renew(new, by=0)
        self.assertEqual((self.said(good), self.end()), ("", self.read(good).not_after))

    def test_another_origin(self) -> None:
        """A renewal that states another name or admitting node than the admission is invalid.

        It does not displace a valid renewal.
        """
        dog = self.team.move_in(self.successResultOf(self.knocked("pup", 2)))
        shown, own = dog.kept.membership.certificate, dog.kept.membership.identity
        self.team.days = 300
        fields = msgpack.unpackb(shown)
        fields[4] = "pup-9"
        other = msgpack.packb(fields)
        member = self.read(shown, own)
        bad = renew_certificate(self.keys[1], self.thief, member, other, int(self.team.wall()) + 99)
        self.assertEqual((member.name, self.read(bad, own).name), ("pup-1", "pup-9"))
        for place in (0, 2):
            self.assertIsNone(
                self.team.houses[place].team.membership_list.add(pack_admission(own.public, bad), self.team.wall())
            )
        good = self.renew(shown, own=own, by=0)
        self.assertEqual((self.said(good, own), self.end(own)), ("", self.read(good, own).not_after))
        self.assertIn("pup-1", self.team.members(2))

    def knocked(self, name: str, uses: int) -> Deferred[Membership]:
        """Return a newcomer that joins with a code for several members."""
        knocked = self.team.knock(self.team.invite(name, uses))
        self.team.run(2.0)
        return knocked

    def test_ahead_of_time(self) -> None:
        """A renewal that starts in the future is invalid before its start, and ends no later than other renewals."""
        old = self.word()
        self.team.days = 300
        ahead = self.renew(old, -100 * DAY)
        self.assertEqual(self.said(ahead), "")
        self.team.days = 370
        self.assertEqual(self.said(ahead), EXPIRED)


class RevivalTests(RenewalCase):
    def test_revoked_member(self) -> None:
        """A revoked member stays rejected even with a renewal by any node of any time.

        No node offers the revoked member a renewal.
        """
        dog = self.team.enlist("dog")
        shown, own = dog.kept.membership.certificate, dog.kept.membership.identity
        before = self.renew(shown, own=own, by=0)
        self.assertEqual(self.said(before, own), "")
        self.tell(self.team.signer.revoke(own.public, "dog", self.team.wall()))
        self.team.days = 300
        for again in (before, self.renew(shown, own=own), self.renew(shown, 300 * DAY, own)):
            self.assertEqual(self.said(again, own), REVOKED)
        due = self.team.houses[0].team._renewer.find_due_members(self.team.wall())
        self.assertNotIn(own.public, [each.public for each in due])

    def test_temporary_guest(self) -> None:
        """A bootstrap node cannot renew a member whose grant or invitation is valid for less than a year."""
        short = self.word(life=DEFAULT_LIFE_S - 1)
        code, packed, terms = self.team.signer.invite(
            "pup", ("device",), 1, self.team.wall(), 3600.0, self.team.dice, life=float(DAY)
        )
        for each in (terms, packed):
            self.tell(each)
        guest = self.let_in(code, "pup")
        for shown in (short, guest):
            self.assertEqual(self.said(self.renew(shown)), FOREIGN)
        self.assertEqual(self.said(guest), "")
        self.team.days = 370
        for shown in (short, guest):
            self.assertEqual(self.said(self.renew(shown)), FOREIGN)
            self.assertEqual(self.enter(self.renew(shown)), FOREIGN)

    def test_more_keys_than_the_code_has(self) -> None:
        """Renewals cannot add more keys for a code than it has uses, even if the list contains no admission."""
        code = parse_code(self.team.invite("dog", uses=2))
        answers = []
        for number in range(1, 5):
            own = Identity(bytes([number]) * 32)
            shown = self.let_in(code, f"dog-{number}", own)
            answers.append(self.said(self.renew(shown, own=own), own))
        self.assertEqual(answers, ["", "", UNLISTED, UNLISTED])
