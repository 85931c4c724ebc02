"""Tests of the membership list."""

from __future__ import annotations

import random

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.admission.certificate import renew_certificate, verify_certificate, wrap_grant
from middleware.admission.membership_list import MAX_SECRETS, MembershipList, invitation_id, pack_admission
from middleware.admission.statement import DEFAULT_LIFE_S, INVITATION_REMEMBERED_S
from middleware.entangled.errors import Forged, Malformed
from tests.middleware.admission.paper import LATER, NOW, admitted, granted, identity, invited, make_list, operator

OPERATOR = operator()
DOG, CAT, VAIO = (identity(name).public for name in ("dog", "cat", "vaio"))


def entries() -> list[bytes]:
    """Return statements of every kind, some of which concern the same key."""
    dice = random.Random(1)
    found = [granted(OPERATOR, "vaio", "bootstrap"), OPERATOR.grant(DOG, "dog", ("viewer",), NOW + 1)]
    found += [granted(OPERATOR, "dog"), invited(OPERATOR)[1], pack_admission(DOG, admitted(OPERATOR, "dog"))]
    found += [OPERATOR.revoke(DOG, "dog", NOW + n) for n in (5, 4)]
    return found + [OPERATOR.rotate_secret(n, [DOG], NOW, 60, dice) for n in range(1, MAX_SECRETS + 3)]


ENTRIES = entries()


class MembershipListTests(SynchronousTestCase):
    def test_foreign_statements_are_refused(self) -> None:
        """Statements of another operator and random bytes are not added."""
        mine = MembershipList(OPERATOR.public)
        self.assertRaises(Forged, mine.add, granted(operator(2), "dog"), NOW)
        self.assertRaises(Forged, mine.add, pack_admission(DOG, admitted(operator(2), "dog")), NOW)
        self.assertRaises(Malformed, mine.add, b"junk", NOW)
        self.assertEqual((len(mine), mine.digest), (0, bytes(8)))

    def test_known_is_not_new(self) -> None:
        """If a statement is already known, adding it again returns None, which stops its propagation."""
        mine = MembershipList(OPERATOR.public)
        self.assertIsNotNone(mine.add(ENTRIES[0], NOW))
        self.assertIsNone(mine.add(ENTRIES[0], NOW))

    def test_later_word_holds(self) -> None:
        """The later of two grants for a key wins, and the earlier of two revocations, in any order of arrival."""
        for order in (ENTRIES, ENTRIES[::-1]):
            mine = make_list(OPERATOR, *order)
            found, revocation = mine.find_grant(DOG), mine.find_revocation(DOG)
            assert found is not None and revocation is not None
            self.assertEqual((found[0].roles, revocation.at), (("viewer",), NOW + 4))

    @given(st.permutations(ENTRIES))
    @settings(max_examples=60, deadline=None)
    def test_order_does_not_matter(self, order: list[bytes]) -> None:
        """Two lists with the same statements have the same digest, whatever the order of arrival."""
        self.assertEqual(make_list(OPERATOR, *order).digest, make_list(OPERATOR, *ENTRIES).digest)

    @given(st.permutations(range(7)))
    @settings(max_examples=60, deadline=None)
    def test_order_of_renewals(self, order: list[int]) -> None:
        """Two lists that receive renewals, a later grant and a revocation in any order are equal after a comparison."""
        vaio, grant, later = identity("vaio"), granted(OPERATOR, "vaio", "bootstrap"), NOW + 300 * 86_400
        found = [grant, pack_admission(CAT, admitted(OPERATOR, "cat")), granted(OPERATOR, "dog")]
        for name, shown, moment in (
            ("dog", wrap_grant(found[2]), later - 99),
            ("dog", wrap_grant(found[2]), later),
            ("cat", admitted(OPERATOR, "cat"), later),
        ):
            public = identity(name).public
            again = renew_certificate(vaio, grant, verify_certificate(OPERATOR.public, public, shown), shown, moment)
            found.append(pack_admission(public, again))
        found.append(OPERATOR.revoke(VAIO, "vaio", later, [CAT], [(DOG, later - 99 + DEFAULT_LIFE_S)]))
        mine = make_list(OPERATOR, *[found[place] for place in [*order, *order]], now=later)
        ends = {each.name: each.not_after for each in mine.list_members(later)}
        self.assertEqual(ends, {"cat": NOW + DEFAULT_LIFE_S, "dog": later - 99 + DEFAULT_LIFE_S})
        self.assertEqual(mine.digest, make_list(OPERATOR, *found, *found, now=later).digest)

    def test_revoked_key(self) -> None:
        """A revoked key stays rejected, even if it gets a later grant."""
        shown = admitted(OPERATOR, "dog")
        member = verify_certificate(OPERATOR.public, DOG, shown)
        mine = make_list(OPERATOR, OPERATOR.revoke(DOG, "dog", NOW), OPERATOR.grant(DOG, "dog", ("device",), NOW + 9))
        self.assertEqual(mine.find_refusal(member, NOW + 9), "revoked")
        self.assertEqual(mine.list_members(NOW + 9), [])

    def test_what_has_run_out_goes(self) -> None:
        """An expired invitation is kept for a week, as the reason for rejections, and then deleted."""
        _, packed, invite = invited(OPERATOR)
        mine = make_list(OPERATOR, packed)
        name = invitation_id(invite.public)
        self.assertEqual(mine.expire(NOW + LATER + INVITATION_REMEMBERED_S - 1), 0)
        self.assertIsNotNone(mine.find_invitation(name))
        self.assertEqual(mine.expire(NOW + LATER + INVITATION_REMEMBERED_S), 1)
        self.assertEqual((mine.find_invitation(name), mine.digest), (None, bytes(8)))
        self.assertIsNone(mine.add(packed, NOW + LATER + INVITATION_REMEMBERED_S))

    def test_newest_secrets_stay(self) -> None:
        """The list keeps only the newest secrets of the team."""
        numbers = [secret.number for secret in make_list(OPERATOR, *ENTRIES).list_secrets()]
        self.assertEqual(numbers, [6, 5, 4, 3])

    def test_name_of_a_member(self) -> None:
        """A member's roles come from the operator's latest grant; its admission is kept."""
        mine = make_list(OPERATOR, pack_admission(DOG, admitted(OPERATOR, "dog")))
        mine.add(OPERATOR.grant(DOG, "dog", ("device", "bootstrap"), NOW + 1), NOW)
        [member] = mine.list_members(NOW + 2)
        self.assertEqual((member.roles, member.admitter), (("device", "bootstrap"), VAIO))
