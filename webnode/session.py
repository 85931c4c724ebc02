"""Session: who has signed in to the page, by the code that was printed at start or by a password."""

from __future__ import annotations

import hmac
import ipaddress
import math
import random
from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred, DeferredSemaphore, fail, succeed
from twisted.internet.threads import deferToThreadPool

from middleware.errors import BadSetting
from webnode.board import OpenSessions, Role, Sessions, Token, Visitor
from webnode.delay import Delays
from webnode.errors import Refusal
from webnode.ground import Ground
from webnode.password import is_password, read
from webnode.revocation import ID_BYTES, MemoryRevocations, Revocations, TeamRevocations
from webnode.seal import Claim, Seal

SIGNED_S = 12 * 3600.0
"""How long one is signed in, unless the page has it renewed."""
MAX_SIGNED_S = 30 * 86400.0
"""How long a session lasts at most, however often it is renewed."""
LETTERS = "abcdefghjkmnpqrstuvwxyz"
"""Of these is a code that the node makes: none looks like another, or like a digit."""
AT_ONCE, WAITING = 2, 1
"""Passwords that are checked at the same time, and those that may wait for it: each holds one of the page's four
workers, and whoever guesses must not hold them all."""

Check = Callable[[str, str], Deferred[bool]]
"""Whether a hash is that of a password, worked out beside the reactor's thread."""


class SignedSessions:
    """Sessions that are sealed tokens, and so are valid at every web node of the team.

    ``code`` lets in operators; so does the password whose hash is ``password``, where there is one.  A token of a
    visitor who is let in can be given as a code, too, and is good for the same role until the same moment: that is an
    invitation.  ``revoked`` are the sessions that were ended; one holds for ``signed_s``, and as long again when it is
    renewed.
    """

    def __init__(
        self,
        secret: bytes,
        code: str,
        password: str,
        rng: random.Random,
        check: Check,
        revoked: Revocations | None = None,
        signed_s: float = SIGNED_S,
    ) -> None:
        self.code = code
        self._seal = Seal(secret)
        self._password = password
        self._rng = rng
        self._check = check
        self._delays = Delays()
        self._revoked = MemoryRevocations() if revoked is None else revoked
        self.signed_s = signed_s
        self._gate = DeferredSemaphore(AT_ONCE)

    def sign_in(self, proof: str, source: str, now: float) -> Deferred[Token]:
        """Sign in with a code, a password or an invitation; fails with ``Refusal`` 401, 429 or 503."""
        wait = self._delays.wait(source, now)
        if wait > 0.0:
            return fail(Refusal("code", "too many wrong ones came from here", f"wait {math.ceil(wait)} s", 429))
        self._delays.tried(source, now)
        invited = self._claim(proof.strip(), now)
        if invited is not None and not invited.is_ticket:
            return succeed(self._held(source, invited.name, invited.role, now, invited.until))
        if hmac.compare_digest(_plain(proof), _plain(self.code)):
            return succeed(self._held(source, "operator", "operator", now, now + MAX_SIGNED_S))
        if not self._password:
            return fail(_wrong())
        if len(self._gate.waiting) >= WAITING:
            return fail(Refusal("code", "too many sign in at once", "try again in a few seconds", 503))

        def judged(is_right: bool) -> Token:
            if not is_right:
                raise _wrong()
            return self._held(source, "operator", "operator", now, now + MAX_SIGNED_S)

        return self._gate.run(self._check, self._password, proof).addCallback(judged)

    def visitor(self, token: str, now: float) -> Visitor:
        """Who shows this token or ticket; on any thread."""
        claim = self._claim(token, now)
        if claim is None:
            return Visitor()
        return Visitor(claim.name, claim.role, claim.id, claim.until, max(claim.until, claim.limit), claim.is_ticket)

    def token(self, name: str, role: Role, now: float, seconds: float) -> Token:
        """A token for somebody who need not sign in."""
        return self._sealed(self._fresh_id(), name, role, now + seconds, now + seconds)

    def renewed(self, who: Visitor, now: float) -> Token:
        """Another token for the same session; one that is revoked ends both."""
        if who.role == "anyone" or who.is_ticket:
            problem = "a ticket is not enough" if who.is_ticket else "nobody is signed in"
            raise Refusal("Authorization", problem, "send the token, as 'Bearer TOKEN', or sign in", 401)
        return self._sealed(who.token_id, who.name, who.role, now + self.signed_s, who.limit)

    def revoke(self, token_id: str, until: float = math.inf) -> None:
        """Let in nobody with this token any more, at any web node of the team."""
        self._revoked.add(token_id, until)

    def _claim(self, token: str, now: float) -> Claim | None:
        claim = self._seal.claim(token)
        return claim if claim is not None and now < claim.until and not self._revoked.has(claim.id) else None

    def _held(self, source: str, name: str, role: Role, now: float, limit: float) -> Token:
        self._delays.held(source)
        return self._sealed(self._fresh_id(), name, role, now + self.signed_s, limit)

    def _fresh_id(self) -> str:
        return self._rng.randbytes(ID_BYTES).hex()

    def _sealed(self, token_id: str, name: str, role: Role, until: float, limit: float) -> Token:
        claim = Claim(token_id, name, role, int(min(until, limit)), limit=int(limit))
        return Token(self._seal.text(claim), self._seal.text(claim.ticket), role, float(claim.until))


def sessions(ground: Ground) -> Sessions:
    """Who may come in; raises ``BadSetting`` where the settings would let in everybody of the network."""
    web, origin = ground.settings.web, ground.settings.origin
    if not web.sign_in:
        if not _is_loopback(web.host):
            problem = f"is false, and {web.host} serves more than this machine"
            raise BadSetting(origin, "[web] sign_in", problem, "set host = '127.0.0.1', or leave sign_in out")
        return OpenSessions()
    if web.password:
        try:
            read(web.password)
        except ValueError as error:
            raise BadSetting(
                origin, "[web] password", f"is no hash of a password ({error})", "make one by: swarm password"
            ) from error
    secret = ground.settings.node.team_secret

    def check(text: str, password: str) -> Deferred[Any]:
        return deferToThreadPool(ground.reactor, ground.reactor.getThreadPool(), is_password, text, password)

    revoked = TeamRevocations(ground.node)
    return SignedSessions(secret, web.code or made(ground.rng), web.password, ground.rng, check, revoked)


def made(rng: random.Random) -> str:
    """A code to sign in with."""
    letters = "".join(rng.choice(LETTERS) for _ in range(8))
    return f"{letters[:4]}-{letters[4:]}"


def _wrong() -> Refusal:
    return Refusal("code", "it is not the code of this page", "look where the node was started, or ask: swarm web", 401)


def _plain(code: str) -> bytes:
    """A code as it is compared: people write it in capitals, and with spaces."""
    return "".join(c for c in code.lower() if not c.isspace() and c != "-").encode()


def _is_loopback(host: str) -> bool:
    return ipaddress.ip_address(host).is_loopback
