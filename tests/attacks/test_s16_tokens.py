"""Attack S16: a member tries to become an operator of the page by tokens, invitations, TLS, failover or guessing."""

from __future__ import annotations

import base64
import hashlib
import os
import random
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any

from itsdangerous import Signer
from itsdangerous.encoding import base64_encode
from twisted.internet.defer import Deferred
from twisted.logger import capturedLogs, formatEvent
from twisted.trial.unittest import SynchronousTestCase

from middleware.admission.membership_file import MemoryMembership
from middleware.admission.operator import FIRST_NODE_ROLES
from middleware.config.settings import Settings
from swarmnode import page_access
from swarmnode.simulated_team import SimulatedTeam
from tests.webnode.memory import MemoryTeamControl
from webnode.app import create_app
from webnode.auth import OpenSessions, Token, User
from webnode.errors import Refusal
from webnode.failover import TeamFallbacks
from webnode.services import Services
from webnode.session import SignedSessions, make_sessions
from webnode.state import format_state
from webnode.token import Claim, TokenKey, encode_claim

CODE = "quiet-otter"
HOME = "10.0.0.9"
NOBODY = User()
IN_FORCE = 3.0


class TokenTeam(SimulatedTeam):
    """Three web nodes with the role gateway, and a viewer named eve, which runs arbitrary code."""

    def __init__(self) -> None:
        super().__init__(16, dogs=(), others=("pi", "nuc", "eve"))

    def _get_membership(self, name: str) -> MemoryMembership:
        if name not in self._memberships:
            roles = ("viewer",) if name == "eve" else FIRST_NODE_ROLES
            made = self.operator.create_membership(name, roles, self.clock.seconds(), self._member_rng, self._secret)
            self._memberships[name] = MemoryMembership(made)
        return self._memberships[name]


@dataclass
class Web:
    """The parts of a web node that manage sessions and failover."""

    sessions: SignedSessions
    fallbacks: TeamFallbacks
    node: Any
    settings: Settings


class PageCase(SynchronousTestCase):
    """A closed team of real nodes; each node in ``webs`` serves a page."""

    def setUp(self) -> None:
        self.team = TokenTeam()
        self.addCleanup(self.team.stop)
        self.webs = {name: self.web(name, port) for port, name in enumerate(("vaio", "pi", "nuc", "eve"), 8080)}
        self.vaio, self.pi, self.nuc, self.eve = self.webs.values()
        self.run_for(IN_FORCE)
        self.token = self.signed(self.vaio)

    def web(self, name: str, port: int) -> Web:
        """Return the web node with this name, which announces the address of its page to the team."""
        service = self.team.services[name]
        node, rng = service.assembly.node, random.Random(name)
        settings = replace(service.settings, web=replace(service.settings.web, code=CODE))
        followed = TeamFallbacks(node, self.team.clock.seconds)
        signed = make_sessions(settings, node, self.team.clock, rng, followed)
        assert isinstance(signed, SignedSessions)
        followed.publish([f"http://127.0.0.1:{port}"])
        return Web(signed, followed, node, settings)

    def now(self) -> float:
        return self.team.clock.seconds()

    def run_for(self, seconds: float) -> None:
        self.team.clock.advance(seconds)

    def signed(self, web: Web, proof: str = CODE, source: str = HOME) -> Token:
        return self.successResultOf(web.sessions.sign_in(proof, source, self.now()))

    def refused(self, web: Web, proof: str, source: str = HOME, later: float = 0.0) -> int:
        """Return the HTTP status with which a sign-in is rejected."""
        failure = self.failureResultOf(web.sessions.sign_in(proof, source, self.now() + later), Refusal)
        return int(failure.value.status)

    def role(self, web: Web, token: str) -> str:
        """Return the role that a token gives at a web node."""
        return web.sessions.authenticate(token, self.now()).role

    def passes(self, web: Web, token: str) -> dict[str, Token]:
        """Return the tokens that a visitor gets for the other web nodes, by the name of the web node."""
        user = web.sessions.authenticate(token, self.now())
        nodes = {each.node.uuid: name for name, each in self.webs.items()}
        pages = [page.node for page in web.fallbacks.list_pages() if not page.is_self]
        return {nodes[uuid]: token for uuid, token in web.sessions.issue_peer_tokens(user, pages, self.now()).items()}

    def tell(self, packed: bytes) -> None:
        """Publish a statement of the operator, and wait until all nodes have it."""
        self.successResultOf(Deferred.fromCoroutine(self.vaio.node.team.publish(packed)))
        self.run_for(IN_FORCE)

    def revoke(self, name: str) -> None:
        web = self.webs[name]
        self.tell(self.team.operator.revoke(web.node.entangled.identity.public, name, self.now()))

    def rotate(self) -> None:
        """Give all members except pi and eve a new secret that replaces the old secret immediately."""
        members = [self.webs[name].node.entangled.identity.public for name in ("vaio", "nuc")]
        self.tell(self.team.operator.rotate_secret(2, members, self.now(), 0.0, random.Random(2)))

    def secrets(self) -> list[bytes]:
        """Return every secret of the team."""
        found = [secret for web in self.webs.values() for _, secret, _ in web.node.team.membership.secrets]
        return list(dict.fromkeys(found))

    def minted(self, claim: Claim, audience: Web) -> list[str]:
        """Return operator tokens that eve can forge with her key and with the secrets of the team."""
        own = TokenKey(self.eve.node.entangled.identity)
        at = audience.node.entangled.identity.node_id
        found = [own.sign_token(claim), own.sign_token(claim, at)]
        # Sign as the web node, with every key that can be derived from the members' secrets.
        for secret in self.secrets():
            page = hashlib.blake2s(secret, person=b"page").hexdigest()
            for known in (secret, hashlib.blake2s(page.encode()).digest(), hashlib.blake2s(secret).digest()):
                found.append(old_token(known, claim.until, claim.limit))
                signer = Signer(known, key_derivation="none")
                found.append(signer.sign(base64_encode(encode_claim(claim))).decode())
        return found


def old_token(secret: bytes, until: int, limit: int) -> str:
    """Return an operator's token in the format of earlier versions, derived from the team's secret."""
    key = hashlib.blake2s(hashlib.blake2b(secret, digest_size=32).digest(), person=b"swarmweb").digest()
    payload = bytes((2, 1 << 1)) + until.to_bytes(5, "big") + limit.to_bytes(5, "big") + bytes(8) + b"eve"
    mac = hashlib.blake2s(payload, key=key, digest_size=16, person=b"swarmweb").digest()
    return base64.urlsafe_b64encode(payload + mac).decode().rstrip("=")


class MintTests(PageCase):
    def claim(self, seconds: float = 365 * 86_400.0) -> Claim:
        end = int(self.now() + seconds)
        return Claim("ab" * 8, "eve", "operator", end, limit=end)

    def test_mint_a_token(self) -> None:
        """No token that a viewer can forge is valid at any web node, as a session or as an invitation."""
        self.assertEqual(self.role(self.vaio, self.token.text), "operator")
        for web in (self.vaio, self.pi, self.nuc):
            for text in self.minted(self.claim(), web):
                self.assertEqual(web.sessions.authenticate(text, self.now()), NOBODY)
                self.assertIn(self.refused(web, text, f"10.0.{len(text)}.1"), (401, 429))

    def test_mint_after_revoke_and_rotate(self) -> None:
        """After the revocation of eve and a rotation, tokens forged with old and new secrets stay invalid."""
        self.revoke("eve")
        self.rotate()
        self.assertGreater(len(self.secrets()), 1)
        for text in self.minted(self.claim(), self.vaio):
            self.assertEqual(self.vaio.sessions.authenticate(text, self.now()), NOBODY)

    def test_serve_a_page_oneself(self) -> None:
        """A web node of eve accepts no code and no token, because it lacks the role gateway."""
        self.assertEqual(self.refused(self.eve, CODE), 403)
        self.assertEqual(
            self.role(self.eve, TokenKey(self.eve.node.entangled.identity).sign_token(self.claim())), "anyone"
        )

    def test_invite_beyond_oneself(self) -> None:
        """A guest cannot invite another guest for longer than the inviting guest's own invitation is valid."""
        user = self.vaio.sessions.authenticate(self.token.text, self.now())
        invited = self.signed(
            self.vaio, self.vaio.sessions.issue_guest_token(user, "guest", "operator", self.now(), 3600.0).text
        )
        guest = self.vaio.sessions.authenticate(invited.text, self.now())
        further = self.vaio.sessions.issue_guest_token(guest, "friend", "operator", self.now(), 365 * 86_400.0)
        self.assertLessEqual(further.until, self.now() + 3600.0)


class StandingTests(PageCase):
    def test_revoked_gateway(self) -> None:
        """Tokens of a revoked gateway, and tokens derived from them, become invalid immediately, without a restart."""
        signed = self.signed(self.pi)
        given = self.passes(self.pi, signed.text)
        self.assertEqual(self.role(self.vaio, given["vaio"].text), "operator")
        user = self.vaio.sessions.authenticate(given["vaio"].text, self.now())
        renewed = self.vaio.sessions.renew_token(user, self.now())
        invited = self.vaio.sessions.issue_guest_token(user, "guest", "operator", self.now(), 60.0)
        further = self.passes(self.vaio, renewed.text)["nuc"]
        made = (given["vaio"], renewed, invited)
        self.assertEqual([self.role(self.vaio, each.text) for each in made], ["operator"] * 3)
        self.assertEqual(self.role(self.nuc, further.text), "operator")
        self.revoke("pi")
        for each in made:
            for text in (each.text, each.ticket):
                self.assertEqual(self.vaio.sessions.authenticate(text, self.now()), NOBODY)
        self.assertEqual(self.role(self.nuc, further.text), "anyone")
        self.assertEqual(self.refused(self.vaio, invited.text), 401)
        self.assertEqual(self.role(self.vaio, self.token.text), "operator")
        self.assertNotIn("pi", self.passes(self.vaio, self.token.text))
        self.assertFalse(self.vaio.fallbacks.is_allowed_origin("http://127.0.0.1:8081"))
        self.rotate()
        self.assertEqual(self.role(self.vaio, made[0].text), "anyone")

    def test_revoked_gateway_serves_nobody(self) -> None:
        """A gateway that learns of its revocation, or that it is now a viewer, accepts no visitors."""
        for name, web in (("pi", self.pi), ("nuc", self.nuc)):
            signed = self.signed(web)
            self.assertEqual(self.role(web, signed.text), "operator")
            if name == "pi":
                self.revoke(name)
                # The gateway may lose its peers before the revocation arrives; it reacts as soon as a peer sends the
                # revocation.
                public = web.node.entangled.identity.public
                web.node.team._gossip.add(self.team.operator.revoke(public, name, self.now()))
            else:
                public = web.node.entangled.identity.public
                self.tell(self.team.operator.grant(public, name, ("viewer",), self.now()))
            self.assertEqual((self.role(web, signed.text), self.role(web, signed.ticket)), ("anyone", "anyone"), name)
            self.assertEqual(self.refused(web, CODE), 403)

    def test_role_taken_away(self) -> None:
        """Tokens of a former gateway that is now a viewer are invalid at other nodes."""
        given = self.passes(self.nuc, self.signed(self.nuc).text)["vaio"]
        self.assertEqual(self.role(self.vaio, given.text), "operator")
        public = self.nuc.node.entangled.identity.public
        self.tell(self.team.operator.grant(public, "nuc", ("device", "viewer"), self.now()))
        self.assertEqual(self.role(self.vaio, given.text), "anyone")


class FailoverTests(PageCase):
    def test_advertise_a_page(self) -> None:
        """The page of a viewer is not listed, its origin is not allowed, and no token is issued for it."""
        told = {page.node for page in self.pi.fallbacks.list_pages()}
        self.assertIn(self.vaio.node.uuid, told)
        for web in (self.vaio, self.pi, self.nuc):
            self.assertNotIn(self.eve.node.uuid, [page.node for page in web.fallbacks.list_pages()])
            self.assertFalse(web.fallbacks.is_allowed_origin("http://127.0.0.1:8083"))
            self.assertNotIn("eve", self.passes(web, self.signed(web).text))
        user = self.vaio.sessions.authenticate(self.token.text, self.now())
        self.assertEqual(self.vaio.sessions.issue_peer_tokens(user, [], self.now()), {})

    def test_use_a_token_elsewhere(self) -> None:
        """A token for one web node is invalid at all other web nodes."""
        given = self.passes(self.vaio, self.token.text)
        self.assertEqual(sorted(given), ["nuc", "pi"])
        for name, token in given.items():
            for web_name, web in self.webs.items():
                wanted = ("operator", "viewer") if web_name == name else ("anyone", "anyone")
                self.assertEqual((self.role(web, token.text), self.role(web, token.ticket)), wanted, (name, web_name))
        for web in (self.pi, self.nuc):
            self.assertEqual((self.role(web, self.token.text), self.role(web, self.token.ticket)), ("anyone",) * 2)

    def test_wait_with_a_token(self) -> None:
        """A failover token is valid for minutes; only the web node that accepts it can renew the session."""
        given = self.passes(self.vaio, self.token.text)["pi"]
        self.assertLessEqual(given.until - self.now(), 900.0)
        roles = [self.pi.sessions.authenticate(given.text, given.until + late).role for late in (-1.0, 1.0)]
        self.assertEqual(roles, ["operator", "anyone"])

    def test_sign_out_everywhere(self) -> None:
        """A sign-out at one web node also ends the sessions that the visitor opened at other web nodes by failover."""
        given = self.passes(self.vaio, self.token.text)["pi"]
        moved = self.pi.sessions.renew_token(self.pi.sessions.authenticate(given.text, self.now()), self.now())
        self.assertEqual(self.role(self.pi, moved.text), "operator")
        user = self.vaio.sessions.authenticate(self.token.text, self.now())
        self.vaio.sessions.revoke(user.token_id, user.limit)
        self.run_for(IN_FORCE)
        self.assertEqual([self.role(self.pi, each.text) for each in (given, moved)], ["anyone"] * 2)


class GuessTests(PageCase):
    def test_guess_from_many_addresses(self) -> None:
        """Of ten thousand guesses in an hour, each from a different address, few are checked."""
        looked = 0
        for number in range(10_000):
            source = f"10.{number // 250}.{number % 250}.1"
            looked += self.refused(self.vaio, f"guess{number}", source, 0.36 * number) == 401
        self.assertLess(looked, 250)

    def test_lock_out_nobody(self) -> None:
        """During an attack sessions are renewed, and invitations, loopback and known addresses can sign in."""
        for number in range(1000):
            self.refused(self.vaio, f"guess{number}", f"10.{number // 250}.{number % 250}.1")
        now = self.now()
        user = self.vaio.sessions.authenticate(self.token.text, now)
        self.assertEqual(self.vaio.sessions.renew_token(user, now).role, "operator")
        self.assertEqual(self.refused(self.vaio, CODE, "192.168.7.7"), 429)
        self.assertEqual(self.signed(self.vaio, CODE, "127.0.0.1").role, "operator")
        self.assertEqual(self.signed(self.vaio, CODE, HOME).role, "operator")
        invited = self.vaio.sessions.issue_guest_token(user, "guest", "viewer", now, 60.0)
        self.assertEqual(self.signed(self.vaio, invited.text, "192.168.7.8").role, "viewer")


class LogTests(SynchronousTestCase):
    def test_read_the_log(self) -> None:
        """The log contains the address of the page, but neither the code nor a link with the code."""
        self.patch(os, "environ", {**os.environ, "XDG_RUNTIME_DIR": self.mktemp()})
        with capturedLogs() as said:
            page_access.announce_page("s16", "127.0.0.1", lambda: 8080, CODE)
        words = "\n".join(formatEvent(each) + str(each) for each in said)
        self.assertIn("http://127.0.0.1:8080/", words)
        self.assertNotIn(CODE, words)


class RebindingTests(SynchronousTestCase):
    def test_rebind_a_local_name(self) -> None:
        """A Host header with an unknown local name is rejected; the node's own and configured names are accepted."""
        services, state = Services(MemoryTeamControl(), OpenSessions()), format_state([], [], {}, node="vaio")
        client = create_app(lambda: state, services, hosts=("vaio", "vaio.local", "robots.lan")).test_client()

        def status(host: str) -> int:
            return client.get("/api/v1/node", headers={"Host": host}).status_code

        for host in ("evil.local", "evil.lan", "evil.local:8080", "evil.internal", "evil.home.arpa", "evil"):
            self.assertEqual(status(host), 403, host)
        for host in ("vaio.local:8080", "VAIO", "robots.lan", "localhost:8080", "127.0.0.1:8080", "[::1]:8080"):
            self.assertEqual(status(host), 200, host)


class TlsTests(PageCase):
    if find_spec("OpenSSL") is None or find_spec("cryptography") is None:
        skip = "TLS IS NOT TESTED: missing OpenSSL or cryptography (pip install 'swarm-node[tls]')"

    def test_sign_a_leaf(self) -> None:
        """No key that can be derived from the team's secrets is the TLS authority of a web node.

        No two nodes share a key.
        """
        from webnode.certificate import make_authority
        from webnode.tls import make_tls_port

        def signer(web: Web) -> Any:
            rng = random.Random(web.settings.node.name)
            return make_tls_port(web.settings, web.node.store, self.team.clock, self.now, rng, list).signer

        signers = [signer(web) for web in (self.vaio, self.pi)]
        self.assertNotEqual(signers[0].pem, signers[1].pem)
        self.assertEqual(signer(self.vaio).pem, signers[0].pem)
        for secret in [*self.secrets(), hashlib.blake2s(b"").digest()]:
            page = hashlib.blake2s(secret, person=b"page").hexdigest()
            for known in (secret, hashlib.blake2s(page.encode()).digest()):
                mine = make_authority(known, "").key.private_numbers()
                self.assertNotIn(mine, [each.key.private_numbers() for each in signers])
