"""Visitor: who asks the page, and who may: sessions, their tokens and their roles."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal, Protocol

from twisted.internet.defer import Deferred, succeed

Role = Literal["anyone", "viewer", "operator", "phone"]


@dataclass(frozen=True)
class Visitor:
    """Who asks; ``token_id`` names what it signed in with, and is no secret.

    It is let in ``until`` then (unix seconds), which it may have put off, no further than to ``limit``, unless it shows
    a ticket.  It ends with the sessions ``parents``, too; ``vouchers`` are the keys of the web nodes that vouch for it.
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
    """What a visitor who signed in shows: ``text`` in a header, ``ticket`` in the query of a GET.

    The ticket stands for the same session and lets look only, as a URL is seen by more than a header.  ``until`` is
    unix seconds.
    """

    text: str
    ticket: str
    role: Role
    until: float


class Sessions(Protocol):
    """Who has signed in; ``now`` is unix seconds."""

    code: str
    """What operators sign in with; empty where nobody needs to."""

    def sign_in(self, proof: str, source: str, now: float) -> Deferred[Token]:
        """Sign in with a code or password, from the address ``source``; fails with ``Refusal`` 401 or 429."""

    def visitor(self, token: str, now: float) -> Visitor:
        """Who shows this token or ticket; never raises, and changes nothing.  Without one: anyone."""

    def token(self, who: Visitor, name: str, role: Role, now: float, seconds: float) -> Token:
        """A token for somebody whom ``who`` brings in, for no longer than ``who`` can stay."""

    def derived(self, who: Visitor, name: str, role: Role, now: float, seconds: float) -> Token:
        """A token for ``who`` under another name, which ends with the session."""

    def renewed(self, who: Visitor, now: float) -> Token:
        """Another token for the same session, good for longer; raises ``Refusal`` 401 for anyone and for a ticket."""

    def passes(self, who: Visitor, nodes: Iterable[str], now: float) -> dict[str, Token]:
        """Tokens for the same session at the web nodes with the uuids ``nodes``, each good there alone, for minutes.

        Raises ``Refusal`` 401 for anyone and for a ticket.
        """

    def revoke(self, token_id: str, until: float = math.inf) -> None:
        """Let in nobody with this token any more, nor with one that was made of it; it runs out ``until`` then."""


class OpenSessions:
    """Everybody is an operator while ``may_serve``: for a page of this machine alone, and for tests."""

    code = ""

    def __init__(self, may_serve: Callable[[], bool] = lambda: True) -> None:
        self._may_serve = may_serve

    def sign_in(self, proof: str, source: str, now: float) -> Deferred[Token]:
        """Let in whoever asks, for a day."""
        return succeed(self.token(Visitor(), "visitor", "operator", now, 86400.0))

    def visitor(self, token: str, now: float) -> Visitor:
        """Return an operator."""
        return Visitor("visitor", "operator") if self._may_serve() else Visitor()

    def token(self, who: Visitor, name: str, role: Role, now: float, seconds: float) -> Token:
        """Return one that says nothing."""
        return Token("open", "open", role, now + seconds)

    derived = token

    def renewed(self, who: Visitor, now: float) -> Token:
        """Return one that says nothing."""
        return self.token(who, who.name, who.role, now, 86400.0)

    def passes(self, who: Visitor, nodes: Iterable[str], now: float) -> dict[str, Token]:
        """Return one that says nothing for each."""
        return {node: self.renewed(who, now) for node in nodes}

    def revoke(self, token_id: str, until: float = math.inf) -> None:
        """Do nothing."""
