"""Attack S15: reply to a newcomer as an ordinary member instead of a bootstrap node, or with forged terms."""

from __future__ import annotations

import random
import tomllib
from collections.abc import Callable
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from nacl import bindings
from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.admission import join_codec
from middleware.admission.certificate import issue_certificate, sign_join
from middleware.admission.join_client import JoinClient
from middleware.admission.join_code import JoinCode, TermsContent, compute_fingerprint, parse_code, seal_terms
from middleware.admission.join_codec import JoinReply, JoinRequest, Signer
from middleware.admission.membership_file import Membership
from middleware.admission.operator import Operator
from middleware.admission.statement import Invite, Terms, open_statement, sign_statement
from middleware.entangled.errors import Forged
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from swarmnode.team.init import SHARED_KEYS, format_settings
from tests.attacks.siege import SiegeCase
from tests.middleware.admission.village import Village

DOOR = Address("10.6.6.6", 666)
LINE = st.text(st.characters(exclude_categories=("C", "Z")), min_size=1, max_size=40)
NEWCOMER = Identity(b"n" * 32)
Answer = Callable[[bytes, JoinRequest], bytes]


class JoinTests(SiegeCase):
    """A team with a join code, and a hostile member that knows everything that a member knows."""

    def setUp(self) -> None:
        super().setUp()
        self.team: Village = self.village()
        self.code: JoinCode = parse_code(self.team.invite("dog"))
        self.invitation = self.code.key.public
        self.eye = self.team.enlist("eye", "viewer")
        self.rng = random.Random(7)
        terms = self.eye.team.membership_list.find_terms(self.invitation)
        assert terms is not None
        self.terms = terms

    def check_true_team(self, answer: Answer) -> None:
        """Let the hostile member send ``answer`` to each JOIN_REQUEST first.

        The newcomer must still join the real team.
        """
        network = self.team.switchboard.make_network(*DOOR)
        answered: list[JoinRequest] = []

        def received(datagram: bytes, source: Address) -> None:
            answered.append(join_codec.open_request(datagram, self.invitation))
            network.send(answer(datagram, answered[-1]), source)

        network.listen(received)
        self.addCleanup(network.close)
        port = self.team.switchboard.make_network("10.0.0.2", 9999)
        newcomer = JoinClient(self.code, NEWCOMER.seed, port, self.team.clock, random.Random(8))
        joined: list[Membership] = []
        failed: list[Exception] = []
        work: Deferred[Any] = newcomer.join([DOOR, self.team.address_of(self.team.houses[0])], 12.0)
        work.addCallbacks(joined.append, lambda failure: failed.append(failure.value))
        self.team.run(13.0)
        self.assertTrue(answered)
        self.assertEqual(failed, [])
        [membership] = joined
        self.assertEqual((membership.operator, membership.team), (self.team.signer.public, self.team.signer.team))
        self.assertEqual(dict(membership.settings), {})
        self.assertEqual(membership.secrets[0][1], self.team.houses[0].kept.membership.secrets[0][1])

    def signer(self, identity: Identity, granted: Identity, role: str, terms: bytes = b"") -> Signer:
        """Return a signer with the key of ``identity`` and the operator's grant for the key of ``granted``.

        The signer presents ``terms``, or the real terms if ``terms`` is empty.
        """
        grant = self.team.signer.grant(granted.public, "eye", (role,), self.team.wall())
        return Signer(identity, grant, terms or self.terms)

    def give(self, signer: Signer, shown: bytes) -> Answer:
        """Return a function that replies to each JOIN_REQUEST with a certificate and a secret of the attacker."""
        given = JoinReply(shown, ((9, b"x" * 32, 0),))
        return lambda datagram, heard: join_codec.make_reply(self.invitation, heard, given, signer, self.rng)

    def forge(self, heard: JoinRequest, operator: Operator, terms: bytes) -> bytes:
        """Return a complete JOIN_REPLY of another operator, with its own invitation, bootstrap node and certificate."""
        boot, now = Identity(b"b" * 32), int(self.team.wall())
        grant = operator.grant(boot.public, "boot", ("bootstrap",), now)
        invite = Invite(self.invitation, "dog", ("device",), 1, now, now + 3600, 3600)
        came = (heard.public, heard.requested_name, heard.proof)
        shown = issue_certificate(boot, grant, (sign_statement(operator.identity, invite), invite), came, "dog", now)
        given = JoinReply(shown, ((1, b"x" * 32, 0),))
        return join_codec.make_reply(self.invitation, heard, given, Signer(boot, grant, terms), self.rng)

    def test_another_operator(self) -> None:
        """A reply in the name of a false operator is rejected if it contains the terms of the false operator."""
        impostor = Operator("yard", b"i" * 32, {"presence_lease": 9.0})
        false = JoinCode(self.code.secret ^ 1, compute_fingerprint(impostor.public))
        terms = seal_terms(false, TermsContent(impostor.public, "yard", impostor.settings), self.rng)
        self.check_true_team(lambda datagram, heard: self.forge(heard, impostor, terms))

    def test_another_operator_with_the_true_terms(self) -> None:
        """The reply of a false operator is rejected even with the real terms, because they name the real operator."""
        impostor = Operator("yard", b"i" * 32)
        self.check_true_team(lambda datagram, heard: self.forge(heard, impostor, self.terms))

    def test_an_operator_with_the_same_mark(self) -> None:
        """An operator key with the same 20-bit fingerprint is not enough.

        Only the secret of the code can seal the terms.
        """
        impostor = Operator("yard", b"i" * 32)
        # To find a key with the fingerprint in a given code takes a minute, so the test makes a code with the
        # fingerprint of the false key.
        code = JoinCode(self.code.secret, compute_fingerprint(impostor.public))
        self.invitation = code.key.public
        false = JoinCode(self.code.secret ^ 1, code.fingerprint)
        terms = seal_terms(false, TermsContent(impostor.public, "yard"), self.rng)
        ephemeral = bindings.crypto_scalarmult_base(b"e" * 32)
        heard = JoinRequest(NEWCOMER.public, ephemeral, "", sign_join(code.key, NEWCOMER.public, ""))
        said = self.forge(heard, impostor, terms)
        self.assertRaises(Forged, join_codec.open_reply, said, code, NEWCOMER.public, b"e" * 32)

    def test_secrets_of_a_member(self) -> None:
        """A member without the role bootstrap cannot give a newcomer a secret or certificate in the operator's name."""
        signer = self.signer(self.eye.team.identity, self.eye.team.identity, "viewer")
        self.check_true_team(self.give(signer, self.eye.kept.membership.certificate))

    def test_a_grant_of_another_node(self) -> None:
        """The terms, a bootstrap node's grant and the newcomer's certificate are not enough to sign a valid reply."""
        self.team.knock(self.code.text, seed=NEWCOMER.seed)
        self.team.run(8.0)
        admission = self.eye.team.membership_list.find_admission(NEWCOMER.public)
        assert admission is not None
        signer = self.signer(self.eye.team.identity, self.team.houses[0].team.identity, "bootstrap")
        self.check_true_team(self.give(signer, admission.certificate))

    def test_terms_of_another_invitation(self) -> None:
        """Terms that were sealed for one join code cannot be opened with a different code."""
        other = self.team.signer.invite("cat", ("device",), 1, self.team.wall(), 3600.0, random.Random(9))
        statement = open_statement(self.team.signer.public, other.terms)
        assert isinstance(statement, Terms)
        boot = self.team.houses[0].team.identity
        signer = self.signer(boot, boot, "bootstrap", statement.sealed)
        self.check_true_team(self.give(signer, self.team.houses[0].kept.membership.certificate))

    def test_an_old_answer(self) -> None:
        """A recorded reply of the real bootstrap node cannot be opened in a later attempt to join."""
        boot = self.team.houses[0].team.identity
        old = JoinRequest(NEWCOMER.public, bindings.crypto_scalarmult_base(b"o" * 32), "", b"")
        answer = self.give(self.signer(boot, boot, "bootstrap"), self.team.houses[0].kept.membership.certificate)
        recorded = answer(b"", old)
        self.check_true_team(lambda datagram, heard: recorded)

    def test_a_forged_refusal(self) -> None:
        """A signed rejection from a member without the role bootstrap does not end the newcomer's attempt."""
        signer = self.signer(self.eye.team.identity, self.eye.team.identity, "viewer")
        self.check_true_team(
            lambda datagram, heard: join_codec.make_refusal(self.invitation, heard, "used", signer, self.rng)
        )

    def test_a_hint(self) -> None:
        """An unauthenticated hint that the code is used up does not end the newcomer's attempt."""
        self.check_true_team(
            lambda datagram, heard: join_codec.make_unsigned_refusal(join_codec.read_invitation_id(datagram), "used")
        )

    def test_an_invitation_without_terms(self) -> None:
        """A newcomer with a code of an older version is rejected, and the error advises to request a new code."""
        village = self.village(seed=3)
        old = village.signer.invite("dog", ("device",), 1, village.wall(), 3600.0, village.dice)
        village.tell(old.invite)
        village.run(1.0)
        knocked = village.knock(old.code.text, timeout=5.0)
        village.run(6.0)
        self.assertEqual(self.failureResultOf(knocked).value.code, "old")


class SettingsTests(SynchronousTestCase):
    @settings(max_examples=100)
    @given(LINE, LINE)
    def test_no_text_becomes_structure(self, kind: str, membership: str) -> None:
        """Text in generated settings is parsed back as the same text; it cannot add a table or a key."""
        text = format_settings("dog", membership, ["edge"], None, (), {"kind": kind})
        found = tomllib.loads(text)
        self.assertEqual(set(found), {"node"})
        self.assertEqual((found["node"]["kind"], found["node"]["membership"]), (kind, membership))
        self.assertEqual(set(found["node"]), {"name", "membership", "store", "roles", "kind"})

    def test_keys_that_may_be_given(self) -> None:
        """A newcomer cannot receive settings that run code, open a page, grant a right or contain a file path."""
        for key in ("name", "store", "membership", "team_key", "roles", "host", "known_nodes", "tunnels", "deployment"):
            self.assertNotIn(key, SHARED_KEYS)
