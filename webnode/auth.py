"""Define the users of the page: sessions, their tokens and their roles."""

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

    The session is valid until ``until`` and can be renewed until ``limit`` (both unix seconds); a ticket cannot renew
    it. The session also ends when one of the sessions in ``parents`` ends. ``vouchers`` are the keys of the web nodes
    that vouch for the session.
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

    The ticket belongs to the same session and can only read, because URLs leak more easily than headers.  ``until`` is
    unix seconds.
    """

    text: str
    ticket: str
    role: Role
    until: float


class Sessions(Protocol):
    """The signed-in users; ``now`` is unix seconds."""

    code: str
    """The sign-in code of operators; empty if no sign-in is needed."""

    def sign_in(self, proof: str, source: str, now: float) -> Deferred[Token]:
        """Sign in with a code or password, from the address ``source``; fails with ``Refusal`` 401 or 429."""

    def authenticate(self, token: str, now: float) -> User:
        """Return the user of a token or ticket; for an invalid one a user with the role ``anyone``.  Never raises."""

    def issue_guest_token(self, user: User, name: str, role: Role, now: float, seconds: float) -> Token:
        """Return a token for a guest of ``user``, valid no longer than ``user`` can stay."""

    def issue_derived_token(self, user: User, name: str, role: Role, now: float, seconds: float) -> Token:
        """Return a token for ``user`` under another name, which ends with the session."""

    def renew_token(self, user: User, now: float) -> Token:
        """Return a later token for the same session; raises ``Refusal`` 401 for the role ``anyone`` or a ticket."""

    def issue_peer_tokens(self, user: User, nodes: Iterable[str], now: float) -> dict[str, Token]:
        """Return tokens for the same session at the web nodes ``nodes`` (uuids), each valid there for some minutes.

        Raises ``Refusal`` 401 for the role ``anyone`` and for a ticket.
        """

    def revoke(self, token_id: str, until: float = math.inf) -> None:
        """Revoke a session and all tokens derived from it; the last of them expires at ``until``."""


class OpenSessions:
    """Treats every user as an operator while ``can_serve``; for tests, and for pages of this machine only."""

    code = ""

    def __init__(self, can_serve: Callable[[], bool] = lambda: True) -> None:
        self._can_serve = can_serve

    def sign_in(self, proof: str, source: str, now: float) -> Deferred[Token]:
        """Sign in every user, for a day."""
        return succeed(self.issue_guest_token(User(), "visitor", "operator", now, 86400.0))

    def authenticate(self, token: str, now: float) -> User:
        """Return an operator."""
        return User("visitor", "operator") if self._can_serve() else User()

    def issue_guest_token(self, user: User, name: str, role: Role, now: float, seconds: float) -> Token:
        """Return a constant token."""
        return Token("open", "open", role, now + seconds)

    issue_derived_token = issue_guest_token

    def renew_token(self, user: User, now: float) -> Token:
        """Return a constant token."""
        return self.issue_guest_token(user, user.name, user.role, now, 86400.0)

    def issue_peer_tokens(self, user: User, nodes: Iterable[str], now: float) -> dict[str, Token]:
        """Return a constant token for each node."""
        return {node: self.renew_token(user, now) for node in nodes}

    def revoke(self, token_id: str, until: float = math.inf) -> None:
        """Do nothing."""
