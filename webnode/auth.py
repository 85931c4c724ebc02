"""Define the visitors of the page: sessions, their tokens and their roles."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal, Protocol

from twisted.internet.defer import Deferred, succeed

Role = Literal["anyone", "viewer", "operator", "phone"]


@dataclass(frozen=True)
class User:
    """The sender of a request; ``token_id`` names its session and is not secret.

    The session is valid ``until`` (unix seconds) and can be renewed up to ``limit``, but not with a ticket.  It ends
    with the sessions ``parents``; ``vouchers`` are the keys of the web nodes that vouch for it.
    """

    name: str = ""
    role: Role = "anyone"
    token_id: str = ""
    until: float = math.inf
    limit: float = math.inf
    is_ticket: bool = False
    parents: tuple[str, ...] = ()
    vouchers: tuple[bytes, ...] = ()


@dataclass(frozen=True)
class Token:
    """The credentials of a session: ``text`` for a header, ``ticket`` for the query of a GET.

    The ticket belongs to the same session and only reads, as URLs leak more easily than headers.  ``until`` is unix
    seconds.
    """

    text: str
    ticket: str
    role: Role
    until: float


class Sessions(Protocol):
    """The signed-in visitors; ``now`` is unix seconds."""

    code: str
    """The sign-in code of operators; empty if none is needed."""

    def sign_in(self, proof: str, source: str, now: float) -> Deferred[Token]:
        """Sign in with a code or password, from the address ``source``; fails with ``Refusal`` 401 or 429."""

    def authenticate(self, token: str, now: float) -> User:
        """Return the visitor of a token or ticket, without one a visitor ``anyone``; never raises."""

    def issue_guest_token(self, who: User, name: str, role: Role, now: float, seconds: float) -> Token:
        """Return a token for a guest of ``who``, valid no longer than ``who`` can stay."""

    def issue_derived_token(self, who: User, name: str, role: Role, now: float, seconds: float) -> Token:
        """Return a token for ``who`` under another name, which ends with the session."""

    def renew_token(self, who: User, now: float) -> Token:
        """Return a later token for the same session; raises ``Refusal`` 401 for anyone and for a ticket."""

    def issue_peer_tokens(self, who: User, nodes: Iterable[str], now: float) -> dict[str, Token]:
        """Return tokens for the same session at the web nodes ``nodes`` (uuids), each valid there for some minutes.

        Raises ``Refusal`` 401 for anyone and for a ticket.
        """

    def revoke(self, token_id: str, until: float = math.inf) -> None:
        """Revoke a session and all tokens derived from it; the last of them expires at ``until``."""


class OpenSessions:
    """Treat every visitor as an operator while ``may_serve``: for a page of this machine only, and for tests."""

    code = ""

    def __init__(self, may_serve: Callable[[], bool] = lambda: True) -> None:
        self._can_serve = may_serve

    def sign_in(self, proof: str, source: str, now: float) -> Deferred[Token]:
        """Sign in every visitor, for a day."""
        return succeed(self.issue_guest_token(User(), "visitor", "operator", now, 86400.0))

    def authenticate(self, token: str, now: float) -> User:
        """Return an operator."""
        return User("visitor", "operator") if self._can_serve() else User()

    def issue_guest_token(self, who: User, name: str, role: Role, now: float, seconds: float) -> Token:
        """Return a constant token."""
        return Token("open", "open", role, now + seconds)

    issue_derived_token = issue_guest_token

    def renew_token(self, who: User, now: float) -> Token:
        """Return a constant token."""
        return self.issue_guest_token(who, who.name, who.role, now, 86400.0)

    def issue_peer_tokens(self, who: User, nodes: Iterable[str], now: float) -> dict[str, Token]:
        """Return a constant token for each node."""
        return {node: self.renew_token(who, now) for node in nodes}

    def revoke(self, token_id: str, until: float = math.inf) -> None:
        """Do nothing."""
