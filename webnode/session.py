"""Sign users in to the page, by the code printed at start, a password or an invitation."""

from __future__ import annotations

import hmac
import math
import random
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred, DeferredSemaphore, fail, succeed
from twisted.internet.threads import deferToThreadPool

from middleware.config.settings import Settings
from middleware.errors import BadSetting
from middleware.node import SwarmNode
from webnode.auth import OpenSessions, Role, Sessions, Token, User
from webnode.errors import Refusal
from webnode.failover import TeamFallbacks, is_loopback
from webnode.password import draw_code, parse_hash, verify_password
from webnode.revocation import Revocations, TeamRevocations
from webnode.sign_in_delay import MAX_SOURCES, SignInDelays, get_network
from webnode.token import MAX_PARENTS, MAX_VOUCHERS, SESSION_BYTES, Claim, TokenKey

SESSION_S = 12 * 3600.0
"""Validity of a session in seconds, unless the page renews it."""
MAX_SESSION_S = 30 * 86400.0
"""Maximum duration of a session in seconds, with renewals."""
PEER_TOKEN_S = 600.0
"""Validity in seconds of a token for another web node, at which the page renews it."""
FREE_EVERYWHERE, LONGEST_EVERYWHERE_S, FORGOTTEN_EVERYWHERE_S = 100, 60.0, 3600.0
"""Failed attempts of all addresses together: 100 are free, then one per minute is allowed, until an hour passes without
a failure.  The pause is short, because it delays every address that has not signed in before."""
ALL_SOURCES = "everywhere"
MAX_CHECKS, MAX_WAITING_CHECKS = 2, 1
"""Number of passwords checked at the same time, and of passwords that wait.  Each check occupies one of the page's four
workers, and guesses must not occupy all of them."""

ANONYMOUS = User()
NO_GATEWAY = Refusal(
    "node",
    "this node lacks the role gateway in its team, so it cannot sign users in",
    "sign in at another web node, or ask the operator to run: swarm promote NAME --role gateway",
    403,
)
Check = Callable[[str, str], Deferred[bool]]
"""Verifies a password against a hash on a worker thread."""


class SignedSessions:
    """Sessions that are signed tokens, each valid at one web node.

    ``code`` signs in operators, and so does the password with the hash ``password`` if that is not empty.  The token of
    a valid session also works as a code, for the same role and until the same time: this is an invitation.  ``key``
    signs for this web node.  ``can_authenticate`` returns whether the node with a public key is a gateway of the team
    now; a session is valid while all its vouchers are, this node included.  ``revocations`` are the sessions that were
    ended; a session lasts ``session_s``, and for the same time after each renewal.
    """

    def __init__(
        self,
        key: TokenKey,
        can_authenticate: Callable[[bytes], bool],
        code: str,
        password: str,
        rng: random.Random,
        check: Check,
        revocations: Revocations | None = None,
        session_s: float = SESSION_S,
    ) -> None:
        self.code = code
        self.key = key
        self._can_authenticate = can_authenticate
        self._password = password
        self._rng = rng
        self._check = check
        self._attempts = SignInAttempts()
        self._revocations = Revocations() if revocations is None else revocations
        self.session_s = session_s
        self._gate = DeferredSemaphore(MAX_CHECKS)

    def sign_in(self, proof: str, source: str, now: float) -> Deferred[Token]:
        """Sign in with a code, a password or an invitation; fails with ``Refusal`` 401, 403, 429 or 503."""
        if not self._can_authenticate(self.key.public):
            return fail(NO_GATEWAY)
        # A signature cannot be guessed, so invitations need no rate limit.
        invited = self.authenticate(proof.strip(), now)
        if invited.role != "anyone" and not invited.is_ticket:
            return succeed(self._begin(invited.name, invited.role, now, invited.until, invited))
        wait = self._attempts.get_wait(source, now)
        if wait > 0.0:
            return fail(Refusal("code", "there were too many wrong attempts", f"wait {math.ceil(wait)} s", 429))
        self._attempts.count_attempt(source, now)
        if hmac.compare_digest(_normalize_code(proof), _normalize_code(self.code)):
            return succeed(self._begin_operator(source, now))
        if not self._password:
            return fail(_make_wrong_code())
        if len(self._gate.waiting) >= MAX_WAITING_CHECKS:
            return fail(Refusal("code", "there are too many simultaneous sign-ins", "try again in a few seconds", 503))

        def finish(is_right: bool) -> Token:
            if not is_right:
                raise _make_wrong_code()
            return self._begin_operator(source, now)

        return self._gate.run(self._check, self._password, proof).addCallback(finish)

    def authenticate(self, token: str, now: float) -> User:
        """Return the user of a token or ticket."""
        claim = self.key.read_claim(token)
        if (
            claim is None
            or now >= claim.until
            or any(self._revocations.is_revoked(each) for each in (claim.id, *claim.parents))
        ):
            return ANONYMOUS
        if not all(self._can_authenticate(public) for public in (self.key.public, *claim.vouchers)):
            return ANONYMOUS
        limit = max(claim.until, claim.limit)
        user = User(claim.name, claim.role, claim.id, claim.until, limit, claim.is_ticket)
        return replace(user, parents=claim.parents, vouchers=claim.vouchers)

    def issue_guest_token(self, user: User, name: str, role: Role, now: float, seconds: float) -> Token:
        """Return a token for a guest of ``user``, valid no longer than ``user`` can stay."""
        end = min(now + seconds, user.limit)
        claim = Claim(self._draw_id(), name, role, int(end), limit=int(end), vouchers=self._list_vouchers(user))
        return self._sign(claim)

    def issue_derived_token(self, user: User, name: str, role: Role, now: float, seconds: float) -> Token:
        """Return a token for ``user`` under another name, which ends with the session."""
        token = Claim(
            self._draw_id(), name, role, int(min(now + seconds, user.limit)), vouchers=self._list_vouchers(user)
        )
        return self._sign(replace(token, limit=token.until, parents=_list_session_ids(user)))

    def renew_token(self, user: User, now: float) -> Token:
        """Return another token for the same session; revoking either token ends the session."""
        _require_session(user)
        return self._make_session_token(user, now + self.session_s, user.limit)

    def issue_peer_tokens(self, user: User, nodes: Iterable[str], now: float) -> dict[str, Token]:
        """Return tokens for the same session at other web nodes, by uuid, valid only there for ``PEER_TOKEN_S``."""
        _require_session(user)
        until = min(now + PEER_TOKEN_S, user.limit)
        return {
            node: self._make_session_token(user, until, user.limit, bytes.fromhex(node))
            for node in dict.fromkeys(nodes)
        }

    def revoke(self, token_id: str, until: float = math.inf) -> None:
        """Revoke a session at all web nodes of the team."""
        self._revocations.revoke(token_id, until)

    def _begin_operator(self, source: str, now: float) -> Token:
        self._attempts.record_success(source, now)
        return self._begin("operator", "operator", now, now + MAX_SESSION_S)

    def _begin(self, name: str, role: Role, now: float, limit: float, invited: User = ANONYMOUS) -> Token:
        """Start a session, which ends together with the invitation from which it was made."""
        user = User(name, role, self._draw_id(), parents=_list_session_ids(invited), vouchers=invited.vouchers)
        return self._make_session_token(user, now + self.session_s, limit)

    def _make_session_token(self, user: User, until: float, limit: float, audience: bytes = b"") -> Token:
        claim = Claim(user.token_id, user.name, user.role, int(min(until, limit)), limit=int(limit))
        return self._sign(replace(claim, parents=user.parents, vouchers=self._list_vouchers(user)), audience)

    def _sign(self, claim: Claim, audience: bytes = b"") -> Token:
        text, ticket = (self.key.sign_token(each, audience) for each in (claim, claim.ticket))
        return Token(text, ticket, claim.role, float(claim.until))

    def _list_vouchers(self, user: User) -> tuple[bytes, ...]:
        """Return the other web nodes that vouch for ``user``; raises ``Refusal`` if there are too many."""
        others = tuple(each for each in user.vouchers if each != self.key.public)
        if len(others) > MAX_VOUCHERS:
            raise Refusal("Authorization", "the session used too many web nodes", "sign in at this node", 401)
        return others

    def _draw_id(self) -> str:
        return self._rng.randbytes(SESSION_BYTES).hex()


class SignInAttempts:
    """Limits attempts to sign in with a code or password, per address and for all addresses together.

    The common limit does not apply to this machine and to networks from which a user has signed in before.
    """

    def __init__(self) -> None:
        self._by_source = SignInDelays()
        self._overall = SignInDelays(FREE_EVERYWHERE, LONGEST_EVERYWHERE_S, FORGOTTEN_EVERYWHERE_S)
        self._known: OrderedDict[str, None] = OrderedDict()

    def get_wait(self, source: str, now: float) -> float:
        """Return the seconds until ``source`` may try again; 0 if it may now."""
        wait = self._by_source.get_wait(source, now)
        return wait if self._is_known(source) else max(wait, self._overall.get_wait(ALL_SOURCES, now))

    def count_attempt(self, source: str, now: float) -> None:
        """Count an attempt."""
        self._by_source.count_attempt(source, now)
        if not self._is_known(source):
            self._overall.count_attempt(ALL_SOURCES, now)

    def record_success(self, source: str, now: float) -> None:
        """Record that the last attempt of ``source`` succeeded."""
        self._by_source.forget(source)
        if not self._is_known(source):
            self._overall.uncount_attempt(ALL_SOURCES)
        self._known[get_network(source)] = None
        self._known.move_to_end(get_network(source))
        if len(self._known) > MAX_SOURCES:
            self._known.popitem(last=False)

    def _is_known(self, source: str) -> bool:
        return get_network(source) in self._known or is_loopback(source)


def make_sessions(
    settings: Settings, node: SwarmNode, reactor: Any, rng: random.Random, team: TeamFallbacks
) -> Sessions:
    """Return the sessions for these settings; raises ``BadSetting`` if they would admit every client of the network."""
    web, origin = settings.web, settings.origin
    key = TokenKey(node.entangled.identity)
    if not web.sign_in:
        if not is_loopback(web.host):
            problem = f"is false, but the page at {web.host} is open to other machines"
            raise BadSetting(origin, "[web] sign_in", problem, "set host = '127.0.0.1', or remove sign_in")
        return OpenSessions(lambda: team.can_authenticate(key.public))
    if web.password:
        try:
            parse_hash(web.password)
        except ValueError as error:
            raise BadSetting(
                origin, "[web] password", f"is not a valid hash ({error})", "create one with: swarm password"
            ) from error

    def check(text: str, password: str) -> Deferred[Any]:
        return deferToThreadPool(reactor, reactor.getThreadPool(), verify_password, text, password)

    code = web.code or draw_code(rng)
    return SignedSessions(key, team.can_authenticate, code, web.password, rng, check, TeamRevocations(node))


def _make_wrong_code() -> Refusal:
    return Refusal("code", "wrong code", "see the node's output at its start, or run: swarm web", 401)


def _normalize_code(code: str) -> bytes:
    """Normalize a code: capitals, spaces and hyphens do not matter."""
    return "".join(c for c in code.lower() if not c.isspace() and c != "-").encode()


def _list_session_ids(user: User) -> tuple[str, ...]:
    """Return the ids of the sessions whose end also ends all sessions and tokens that ``user`` starts."""
    return tuple(each for each in (user.token_id, *user.parents) if each)[:MAX_PARENTS]


def _require_session(user: User) -> None:
    if user.role == "anyone" or user.is_ticket:
        problem = "a ticket is not enough" if user.is_ticket else "not signed in"
        raise Refusal("Authorization", problem, "send the token, as 'Bearer TOKEN', or sign in", 401)
