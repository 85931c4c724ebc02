"""Tests of ``webnode.session``: signing in by code, password and invitation."""

from __future__ import annotations

import random
from types import SimpleNamespace
from typing import Any, cast

from twisted.internet.defer import Deferred, succeed
from twisted.trial.unittest import SynchronousTestCase

from middleware.config.settings import Settings
from middleware.entangled.identity import Identity
from middleware.errors import BadSetting
from webnode.auth import OpenSessions, Token, User
from webnode.errors import Refusal
from webnode.password import draw_code, hash_password, verify_password
from webnode.session import (
    MAX_CHECKS,
    MAX_SESSION_S,
    MAX_WAITING_CHECKS,
    PEER_TOKEN_S,
    SESSION_S,
    SignedSessions,
    make_sessions,
)
from webnode.token import TokenKey

HASH = hash_password("correct horse", bytes(16), 4)
HOME = "10.0.0.9"
KEYS = {name: TokenKey(Identity(name.encode().ljust(32))) for name in ("vaio", "pi", "nuc", "eve")}


def uuid(name: str) -> str:
    """Return the id of a node as used by the page."""
    return KEYS[name].node_id.hex()


class SignedSessionsTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.gateways = {KEYS[name].public for name in ("vaio", "pi", "nuc")}
        self.sessions = self.node()

    def node(self, name: str = "vaio", password: str = "", check: Any = None) -> SignedSessions:
        there = check or (lambda text, word: succeed(verify_password(text, word)))
        return SignedSessions(
            KEYS[name], self.gateways.__contains__, "quiet-otter", password, random.Random(name), there
        )

    def signed(self, proof: str = "quiet-otter", now: float = 0.0, source: str = HOME) -> Token:
        return self.successResultOf(self.sessions.sign_in(proof, source, now))

    def refused(self, proof: str, now: float = 0.0, source: str = HOME) -> Refusal:
        refusal: Refusal = self.failureResultOf(self.sessions.sign_in(proof, source, now), Refusal).value
        return refusal

    def test_sign_in_by_the_code(self) -> None:
        """The code, in any notation, signs in an operator for twelve hours.

        The ticket signs in a viewer for the same time.
        """
        for words in ("quiet-otter", " Quiet Otter ", "QUIETOTTER"):
            token = self.signed(words)
            self.assertEqual((token.role, token.until), ("operator", SESSION_S))
        user = self.sessions.authenticate(token.text, SESSION_S - 1.0)
        self.assertEqual((user.name, user.role), ("operator", "operator"))
        looks = self.sessions.authenticate(token.ticket, SESSION_S - 1.0)
        self.assertEqual((looks.role, looks.token_id), ("viewer", user.token_id))
        for text in (token.text, token.ticket):
            self.assertEqual(self.sessions.authenticate(text, SESSION_S), User())

    def test_go_on_at_another_web_node(self) -> None:
        """A peer token is valid for minutes, only at one web node.

        If it is renewed there, the session continues there.
        """
        pi, nuc = self.node("pi"), self.node("nuc")
        token = self.signed()
        self.assertEqual(pi.authenticate(token.text, 1.0), User())
        user = self.sessions.authenticate(token.text, 1.0)
        given = self.sessions.issue_peer_tokens(user, [uuid("pi")], 1.0)[uuid("pi")]
        self.assertEqual((given.role, given.until), ("operator", 1.0 + PEER_TOKEN_S))
        self.assertEqual([each.authenticate(given.text, 2.0).role for each in (self.sessions, nuc)], ["anyone"] * 2)
        there = pi.authenticate(given.text, 2.0)
        self.assertEqual((there.name, there.role, there.token_id), (user.name, user.role, user.token_id))
        self.assertEqual(pi.authenticate(given.ticket, 2.0).role, "viewer")
        renewed = pi.renew_token(there, 2.0)
        self.assertEqual(pi.authenticate(renewed.text, SESSION_S).limit, user.limit)
        further = pi.issue_peer_tokens(pi.authenticate(renewed.text, 3.0), [uuid("vaio"), uuid("nuc")], 3.0)
        self.assertEqual(self.sessions.authenticate(further[uuid("vaio")].text, 4.0).token_id, user.token_id)
        self.assertEqual(nuc.authenticate(further[uuid("nuc")].text, 4.0).token_id, user.token_id)
        refusal = self.assertRaises(
            Refusal, pi.issue_peer_tokens, pi.authenticate(given.ticket, 2.0), [uuid("nuc")], 2.0
        )
        self.assertEqual(refusal.status, 401)

    def test_believe_gateways_alone(self) -> None:
        """A session is invalid while one of the nodes that vouched for it is not a gateway.

        Only gateways allow signing in.
        """
        pi, token = self.node("pi"), self.signed()
        given = self.sessions.issue_peer_tokens(self.sessions.authenticate(token.text, 1.0), [uuid("pi")], 1.0)[
            uuid("pi")
        ]
        renewed = pi.renew_token(pi.authenticate(given.text, 1.0), 1.0)
        invited = pi.issue_guest_token(pi.authenticate(renewed.text, 1.0), "guest", "viewer", 1.0, 60.0)
        guest = self.successResultOf(pi.sign_in(invited.text, HOME, 1.0))
        self.gateways.discard(KEYS["vaio"].public)
        for text in (given.text, given.ticket, renewed.text, invited.text, guest.text):
            self.assertEqual(pi.authenticate(text, 2.0), User())
        self.assertEqual(self.sessions.authenticate(token.text, 2.0), User())
        refusal = self.refused("quiet-otter", 2.0)
        self.assertEqual((refusal.field, refusal.status), ("node", 403))
        self.gateways.add(KEYS["vaio"].public)
        self.assertEqual(self.sessions.authenticate(token.text, 3.0).role, "operator")

    def test_end_what_was_made_of_it(self) -> None:
        """Revoking an invitation ends its sessions; revoking a session ends the tickets derived from it."""
        user = self.sessions.authenticate(self.signed().text, 1.0)
        invitation = self.sessions.issue_guest_token(user, "guest", "phone", 1.0, 600.0)
        guest = self.sessions.authenticate(self.signed(invitation.text, 2.0).text, 2.0)
        derived = self.sessions.issue_derived_token(guest, "phone/1", "phone", 2.0, 1e9)
        self.assertEqual((derived.until, self.sessions.authenticate(derived.ticket, 3.0).name), (601.0, "phone/1"))
        self.sessions.revoke(self.sessions.authenticate(invitation.text, 3.0).token_id)
        self.assertEqual(self.sessions.authenticate(derived.ticket, 3.0), User())
        self.assertEqual(self.refused(invitation.text, 3.0).status, 401)

    def test_refuse_what_is_not_the_code(self) -> None:
        """A wrong code gives status 401 with a hint to ``swarm web``; a user without a token is anonymous."""
        for words in ("", "quiet", "quiet-otter1", "\N{DOG FACE}", "A" * 60):
            refusal = self.refused(words)
            self.assertEqual((refusal.status, refusal.field), (401, "code"))
        self.assertIn("swarm web", refusal.remedy)
        self.assertEqual(self.sessions.authenticate("", 0.0), User())

    def test_slow_guesses_down(self) -> None:
        """After ten wrong codes a source must wait, even with the right code; other sources sign in immediately."""
        told = [self.refused(f"guess {n}").status for n in range(1000)]
        self.assertEqual((told.count(401), told.count(429)), (10, 990))
        self.assertIn("wait 4 s", self.refused("quiet-otter").remedy)
        self.signed(source="192.168.0.7")
        self.signed(now=4.0)
        self.assertEqual(self.refused("wrong", 4.0).status, 401)

    def test_sign_in_by_the_password(self) -> None:
        """If a password is set, both password and code sign in; a wrong password does not."""
        self.sessions = self.node(password=HASH)
        self.assertEqual(self.signed("correct horse").role, "operator")
        self.assertEqual(self.signed().role, "operator")
        self.assertEqual(self.refused("correct hors").status, 401)

    def test_check_two_passwords_at_once(self) -> None:
        """Two passwords are checked simultaneously, some wait, and all further ones get status 503.

        Each of them counts as an attempt.
        """
        asked: list[Deferred[bool]] = []

        def check(text: str, word: str) -> Deferred[bool]:
            asked.append(Deferred())
            return asked[-1]

        self.sessions = self.node(password=HASH, check=check)
        storm = [self.sessions.sign_in("wrong", f"10.0.0.{n}", 0.0) for n in range(50)]
        self.assertEqual(len(asked), MAX_CHECKS)
        busy = [self.failureResultOf(each, Refusal).value.status for each in storm[MAX_CHECKS + MAX_WAITING_CHECKS :]]
        self.assertEqual(busy, [503] * (50 - MAX_CHECKS - MAX_WAITING_CHECKS))
        while asked:
            asked.pop(0).callback(False)
        for each in storm[: MAX_CHECKS + MAX_WAITING_CHECKS]:
            self.failureResultOf(each, Refusal)
        many = [self.sessions.sign_in("wrong", HOME, 0.0) for _ in range(11)]
        self.assertEqual(self.failureResultOf(many.pop(), Refusal).value.status, 429)
        for each in many:
            each.addErrback(lambda _: None)

    def test_invite(self) -> None:
        """An invitation signs in with its role until its end; its ticket does not, nor does an expired invitation."""
        invitation = self.sessions.issue_guest_token(OPERATOR, "guest", "viewer", 0.0, 100.0)
        token = self.signed(invitation.text, 10.0)
        self.assertEqual((token.role, token.until), ("viewer", 100.0))
        self.assertNotEqual(token.text, invitation.text)
        self.assertEqual(self.sessions.authenticate(token.text, 50.0).name, "guest")
        self.assertEqual(self.refused(invitation.ticket, 10.0).status, 401)
        self.assertEqual(self.refused(invitation.text, 100.0).status, 401)
        long = self.sessions.issue_guest_token(OPERATOR, "guest", "viewer", 0.0, 10 * SESSION_S)
        self.assertEqual(self.signed(long.text, 1.0).until, SESSION_S + 1.0)

    def test_renew(self) -> None:
        """A valid token can be renewed within the same session, until thirty days after signing in."""
        token, now = self.signed(), 0.0
        while token.until < MAX_SESSION_S:
            now = token.until - 1.0
            token = self.sessions.renew_token(self.sessions.authenticate(token.text, now), now)
            self.assertEqual(token.until, min(now + SESSION_S, MAX_SESSION_S))
        user = self.sessions.authenticate(token.text, now)
        self.assertEqual(self.sessions.renew_token(user, now + 5.0).until, MAX_SESSION_S)
        self.sessions.revoke(user.token_id, user.until)
        self.assertEqual(self.sessions.authenticate(self.signed(now=now).text, now).role, "operator")
        self.assertEqual(self.sessions.authenticate(token.text, now), User())

    def test_renew_no_further_than_invited(self) -> None:
        """A guest cannot renew a token beyond the invitation; with a ticket, or as an unknown user, renewing fails."""
        invitation = self.sessions.issue_guest_token(OPERATOR, "guest", "viewer", 0.0, SESSION_S + 10.0)
        token = self.signed(invitation.text, 1.0)
        self.assertEqual(token.until, SESSION_S + 1.0)
        self.assertEqual(
            self.sessions.renew_token(self.sessions.authenticate(token.text, 9.0), 9.0).until, SESSION_S + 9.0
        )
        self.assertEqual(
            self.sessions.renew_token(self.sessions.authenticate(token.text, 99.0), 99.0).until, SESSION_S + 10.0
        )
        for text in (token.ticket, ""):
            refusal = self.assertRaises(Refusal, self.sessions.renew_token, self.sessions.authenticate(text, 9.0), 9.0)
            self.assertEqual((refusal.field, refusal.status), ("Authorization", 401))


OPERATOR = User("operator", "operator")


class FactoryTests(SynchronousTestCase):
    def made(self, **web: object) -> Any:
        """Return the sessions of a gateway for these settings."""
        settings = Settings.from_mapping({"node": {"name": "vaio", "team_key": "x" * 20}, "web": web}, "vaio.toml")
        entangled = SimpleNamespace(watch=lambda *what, **how: None, identity=Identity(bytes(32)))
        node, team = SimpleNamespace(entangled=entangled), SimpleNamespace(can_authenticate=lambda public: True)
        return make_sessions(settings, cast(Any, node), None, random.Random(1), cast(Any, team))

    def test_have_the_code_of_the_settings(self) -> None:
        """The access code is set in the settings; otherwise it is random and contains no ambiguous letters."""
        self.assertEqual(self.made(code="quiet-otter").code, "quiet-otter")
        self.assertRegex(self.made().code, r"^[a-hj-km-np-z]{4}-[a-hj-km-np-z]{4}$")
        self.assertNotEqual(draw_code(random.Random(1)), draw_code(random.Random(2)))

    def test_do_without_on_this_machine_alone(self) -> None:
        """A page without sign-in is permitted only on the loopback address; otherwise the setting is rejected."""
        self.assertIsInstance(self.made(sign_in=False), OpenSessions)
        self.assertIsInstance(self.made(sign_in=False, host="::1"), OpenSessions)
        for host in ("0.0.0.0", "192.168.0.2", "::"):
            error = self.assertRaises(BadSetting, self.made, sign_in=False, host=host)
            self.assertIn("vaio.toml: [web] sign_in", str(error))

    def test_refuse_a_password_that_is_no_hash(self) -> None:
        """A plain-text password in the settings is rejected; the error does not contain the password."""
        error = self.assertRaises(BadSetting, self.made, password="correct horse")
        self.assertIn("swarm password", str(error))
        self.assertNotIn("horse", str(error))
