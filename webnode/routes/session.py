"""Routes of the session: signing in and out, and inviting others."""

from __future__ import annotations

from twisted.internet.defer import Deferred

from webnode.board import Token
from webnode.errors import Refusal
from webnode.field import Json
from webnode.route import API, Ask, Field, Route
from webnode.session import SIGNED_S

INVITED_S = 86400.0
MAX_INVITED_S = 366 * 86400.0


def sign_in(ask: Ask) -> Deferred[Json]:
    """Sign in with one of the two."""
    code, password = ask.given["code"], ask.given["password"]
    if bool(code) == bool(password):
        problem = "code and password are both there" if code else "it is missing or empty"
        raise Refusal("code", problem, 'give {"code": "..."} or {"password": "..."}')
    return ask.board.sessions.sign_in(code or password, ask.source, ask.now).addCallback(_told)


def session(ask: Ask) -> Json:
    """Who asks."""
    return {"name": ask.who.name, "role": ask.who.role}


def sign_out(ask: Ask) -> Json:
    """Let in nobody with this token any more."""
    if ask.who.token_id:
        # What was renewed elsewhere, a moment ago, ends with it.
        until = min(ask.who.limit, max(ask.who.until, ask.now + SIGNED_S))
        ask.board.sessions.revoke(ask.who.token_id, until)
    return {}


def renew(ask: Ask) -> Json:
    """Another token for who asks."""
    return _told(ask.board.sessions.renewed(ask.who, ask.now))


def invite(ask: Ask) -> Json:
    """A token for somebody else."""
    given = ask.given
    return _told(ask.board.sessions.token(given["name"], given["role"], ask.now, given["seconds"]))


def _told(token: Token) -> dict[str, Json]:
    return {"token": token.text, "ticket": token.ticket, "role": token.role, "until": token.until}


ROUTES = (
    Route(
        "POST",
        f"{API}/session",
        "Sign in, with the code that is printed at start (`swarm web` tells it, too), an invitation, or the password",
        "anyone",
        sign_in,
        (
            Field("code", "text", "the code, or an invitation's token", is_required=False, default=""),
            Field("password", "text", "the password", is_required=False, default=""),
        ),
        gives="token, ticket, role, until (unix seconds)",
        # A password takes a small device a while.
        limit_s=4.5,
    ),
    Route("GET", f"{API}/session", "Who asks: anyone, until signed in", "anyone", session, gives="name, role"),
    Route(
        "PUT",
        f"{API}/session",
        "Go on being signed in: another token for the session of the one that is sent, which stays good for its time",
        "viewer",
        renew,
        gives="token, ticket, role, until (unix seconds)",
    ),
    Route("DELETE", f"{API}/session", "Sign out, at every web node of the team", "anyone", sign_out),
    Route(
        "POST",
        f"{API}/invitations",
        "A token for somebody else, who signs in with it as a code, or for a program, which uses it as it is",
        "operator",
        invite,
        (
            Field("role", "choice", "what it lets do", choices=("viewer", "phone", "operator")),
            Field("name", "text", "who it is for", most=40, is_required=False, default="guest"),
            Field(
                "seconds",
                "number",
                "for how long",
                least=1,
                most=MAX_INVITED_S,
                default=INVITED_S,
                is_required=False,
                unit="s",
            ),
        ),
        gives="token, ticket, role, until (unix seconds)",
    ),
)
