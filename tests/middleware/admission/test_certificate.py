"""Tests of certificate chains."""

from __future__ import annotations

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.admission.certificate import (
    GUEST_LIFE_S,
    MAX_CERTIFICATE_BYTES,
    MAX_CLOCK_SKEW_S,
    Member,
    issue_certificate,
    issue_guest_certificate,
    renew_certificate,
    sign_join,
    verify_certificate,
    wrap_grant,
)
from middleware.admission.statement import DEFAULT_LIFE_S
from middleware.entangled.errors import Forged, Malformed
from tests.middleware.admission.paper import LATER, NOW, admitted, granted, identity, invited, make_list, operator

OPERATOR = operator()
DOG = identity("dog")


class CertificateTests(SynchronousTestCase):
    def test_granted_by_the_operator(self) -> None:
        """A grant of the operator makes only the key in this grant a member."""
        shown = wrap_grant(granted(OPERATOR, "dog", "device", "gateway"))
        member = verify_certificate(OPERATOR.public, DOG.public, shown)
        self.assertEqual((member.name, member.roles), ("dog", ("device", "gateway")))
        self.assertRaises(Forged, verify_certificate, OPERATOR.public, identity("cat").public, shown)
        self.assertRaises(Forged, verify_certificate, operator(2).public, DOG.public, shown)

    def test_let_in_by_a_bootstrap_node(self) -> None:
        """Invitation, proof and admission together make a member that has the roles and lifetime of the invitation."""
        member = verify_certificate(OPERATOR.public, DOG.public, admitted(OPERATOR, "dog"))
        _, _, invite = invited(OPERATOR)
        expected = (DOG.public, "dog", ("device",), NOW, NOW + invite.life, invite.public, identity("vaio").public)
        self.assertEqual(member, Member(*expected, uses=1, since=NOW, life=invite.life))

    def test_renewed_by_a_bootstrap_node(self) -> None:
        """A renewal postpones the expiry of a certificate from a grant or a join by code, and can be renewed itself."""
        vaio, grant = identity("vaio"), granted(OPERATOR, "vaio", "bootstrap")
        for shown in (wrap_grant(granted(OPERATOR, "dog")), admitted(OPERATOR, "dog")):
            before = verify_certificate(OPERATOR.public, DOG.public, shown)
            for year in (1, 2, 3):
                shown = renew_certificate(
                    vaio,
                    grant,
                    verify_certificate(OPERATOR.public, DOG.public, shown),
                    shown,
                    NOW + year * DEFAULT_LIFE_S,
                )
                after = verify_certificate(OPERATOR.public, DOG.public, shown)
                self.assertEqual((after.name, after.roles, after.renewer), (before.name, before.roles, vaio.public))
                self.assertEqual(
                    (after.not_after, after.admitter), (NOW + (year + 1) * DEFAULT_LIFE_S, before.admitter)
                )
            self.assertRaises((Forged, Malformed), verify_certificate, OPERATOR.public, vaio.public, shown)
            self.assertLessEqual(len(shown), MAX_CERTIFICATE_BYTES)

    def test_it_takes_two(self) -> None:
        """An admission that is not signed with the code, or whose signer lacks the role bootstrap, is forged."""
        code, packed, invite = invited(OPERATOR)
        grant, plain = granted(OPERATOR, "vaio", "bootstrap"), granted(OPERATOR, "vaio", "device")
        vaio = identity("vaio")
        made_up = issue_certificate(
            vaio, grant, (packed, invite), (DOG.public, "", sign_join(vaio, DOG.public, "")), "dog", NOW
        )
        came = (DOG.public, "", sign_join(code.key, DOG.public, ""))
        not_allowed = issue_certificate(vaio, plain, (packed, invite), came, "dog", NOW)
        by_itself = issue_certificate(DOG, grant, (packed, invite), came, "dog", NOW)
        for shown in (made_up, not_allowed, by_itself):
            self.assertRaises(Forged, verify_certificate, OPERATOR.public, DOG.public, shown)

    def test_bootstrap_node_chooses_no_other_name(self) -> None:
        """A bootstrap node cannot admit a newcomer under a name that neither the invitation nor the request allows."""
        vaio, grant = identity("vaio"), granted(OPERATOR, "vaio", "bootstrap")
        for uses, wish, name in ((1, "", "cat"), (2, "rex", "cat"), (2, "", "cat-1")):
            code, packed, invite = invited(OPERATOR, uses=uses)
            came = (DOG.public, wish, sign_join(code.key, DOG.public, wish))
            shown = issue_certificate(vaio, grant, (packed, invite), came, name, NOW)
            self.assertRaises(Forged, verify_certificate, OPERATOR.public, DOG.public, shown)

    def test_admission_needs_a_living_invitation(self) -> None:
        """An expired invitation admits no member, and no admission outlasts the lifetime in its invitation."""
        late = admitted(OPERATOR, "dog", now=NOW + int(LATER) + 1)
        self.assertRaises(Malformed, verify_certificate, OPERATOR.public, DOG.public, late)
        fields = msgpack.unpackb(admitted(OPERATOR, "dog"))
        fields[6] += 1
        self.assertRaises(Malformed, verify_certificate, OPERATOR.public, DOG.public, msgpack.packb(fields))

    def test_it_has_its_time(self) -> None:
        """A certificate is early before its start, minus a tolerance for clock skew, and expired after its end."""
        member = verify_certificate(OPERATOR.public, DOG.public, wrap_grant(granted(OPERATOR, "dog")))
        self.assertEqual(member.check_dates(NOW - MAX_CLOCK_SKEW_S - 1), "early")
        self.assertEqual(member.check_dates(NOW - MAX_CLOCK_SKEW_S), "")
        self.assertEqual(member.check_dates(member.not_after), "expired")

    def test_guest(self) -> None:
        """A gateway can admit a guest for one day; a member that is not a gateway cannot, nor can a guest."""
        page, phone, friend = identity("page"), identity("phone"), identity("friend")
        own = wrap_grant(granted(OPERATOR, "page", "gateway"))
        shown = issue_guest_certificate(page, own, phone.public, "phone", NOW)
        member = verify_certificate(OPERATOR.public, phone.public, shown)
        mine = make_list(OPERATOR)
        self.assertEqual((member.name, member.roles, mine.find_refusal(member, NOW)), ("phone", ("device",), ""))
        self.assertEqual(mine.find_refusal(member, NOW + GUEST_LIFE_S), "expired")
        self.assertRaises(Forged, verify_certificate, OPERATOR.public, friend.public, shown)
        again = issue_guest_certificate(phone, shown, friend.public, "friend", NOW)
        self.assertRaises(Forged, verify_certificate, OPERATOR.public, friend.public, again)
        plain = issue_guest_certificate(page, wrap_grant(granted(OPERATOR, "page")), phone.public, "phone", NOW)
        self.assertEqual(mine.find_refusal(verify_certificate(OPERATOR.public, phone.public, plain), NOW), "role")
        mine.add(OPERATOR.revoke(page.public, "page", NOW), NOW)
        self.assertEqual(mine.find_refusal(member, NOW), "revoked")

    def test_guest_of_one_who_came_by_code(self) -> None:
        """A gateway that joined by code can admit a guest, unless all names in the certificate chain are long."""
        page, phone = identity("page"), identity("phone")
        shown = issue_guest_certificate(page, admitted(OPERATOR, "page"), phone.public, "phone-of-a-visitor", NOW)
        voucher = verify_certificate(OPERATOR.public, phone.public, shown).gateway
        self.assertEqual(None if voucher is None else voucher.name, "page")
        grant, own = granted(OPERATOR, "vaio", "bootstrap"), admitted(OPERATOR, "page")
        again = renew_certificate(
            identity("vaio"), grant, verify_certificate(OPERATOR.public, page.public, own), own, NOW + DEFAULT_LIFE_S
        )
        shown = issue_guest_certificate(page, again, phone.public, "phone-of-a-visitor", NOW + DEFAULT_LIFE_S)
        self.assertEqual(verify_certificate(OPERATOR.public, phone.public, shown).name, "phone-of-a-visitor")
        long = admitted(OPERATOR, "n" * 40, bootstrap="b" * 40, wish="w" * 40)
        self.assertRaises(Malformed, issue_guest_certificate, page, long, phone.public, "phone", NOW)

    def test_longest_fits(self) -> None:
        """A chain with names of the maximum length, and its renewal, do not exceed the maximum size of a chain."""
        long, boot = "n" * 40, "b" * 40
        shown = admitted(OPERATOR, long, bootstrap=boot, wish="w" * 40)
        member = verify_certificate(OPERATOR.public, identity(long).public, shown)
        again = renew_certificate(
            identity(boot), granted(OPERATOR, boot, "bootstrap"), member, shown, NOW + DEFAULT_LIFE_S
        )
        for each in (shown, again):
            self.assertLessEqual(len(each), MAX_CERTIFICATE_BYTES)
            self.assertEqual(verify_certificate(OPERATOR.public, identity(long).public, each).name, long)

    @given(st.data())
    @settings(max_examples=200, deadline=None)
    def test_reads_anything(self, data: st.DataObject) -> None:
        """For truncated, changed and random input the decoder raises only ``Forged`` or ``Malformed``."""
        old = data.draw(st.sampled_from((admitted(OPERATOR, "dog"), wrap_grant(granted(OPERATOR, "dog")))))
        member, grant = verify_certificate(OPERATOR.public, DOG.public, old), granted(OPERATOR, "vaio", "bootstrap")
        again = renew_certificate(identity("vaio"), grant, member, old, NOW + DEFAULT_LIFE_S)
        whole = bytearray(data.draw(st.sampled_from((old, again))))
        place = data.draw(st.integers(0, len(whole) - 1))
        whole[place] ^= data.draw(st.integers(1, 255))
        cut = bytes(whole[: data.draw(st.integers(0, len(whole)) | st.just(len(whole)))])
        self.assertRaises((Forged, Malformed), verify_certificate, OPERATOR.public, DOG.public, cut)
        anything = data.draw(st.binary(max_size=100))
        self.assertRaises((Forged, Malformed), verify_certificate, OPERATOR.public, DOG.public, anything)
