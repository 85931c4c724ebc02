"""The guard: which requests a page on a LAN may answer, and the headers that keep a browser strict.  Pure.

The page has no cookies, so a foreign site gains nothing but what a visitor's browser reaches for it: it is stopped
at three doors.  ``Host`` must be an address or a name of this machine (against rebinding of names), ``Origin`` must be
the page's own or that of another web node of the team, and a request that changes something must be of a kind that a
foreign form cannot send.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Collection

from webnode.errors import Refusal

MAX_BODY = 64 * 1024
LOCAL_ENDS = (".localhost", ".local", ".lan", ".internal", ".home.arpa")
HEADERS = {
    # A page that has lost its node goes on with another of the team, whose address this one need not have known.
    "Content-Security-Policy": (
        "default-src 'self'; connect-src 'self' http: https:; "
        "object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
SHARED = {
    "Vary": "Origin",
    "Cross-Origin-Resource-Policy": "cross-origin",
    "Access-Control-Allow-Methods": "GET, POST, PUT, DELETE",
    "Access-Control-Allow-Headers": "Authorization, Content-Type, Idempotency-Key, Last-Event-ID, X-Swarm",
    "Access-Control-Expose-Headers": "X-Age, X-Seq",
    "Access-Control-Max-Age": "600",
}
"""What lets a page of another web node ask here."""

LetsIn = Callable[[str], bool]


def is_local_name(host: str) -> bool:
    """Whether a ``Host`` header can name a machine of the local network: an address, or a name from no outside."""
    name = _name_of(host)
    is_plain = bool(name) and all(c.isalnum() or c in "-_" for c in name)
    return is_plain or name.endswith(LOCAL_ENDS) or _is_address(name)


def is_own_host(host: str, names: Collection[str] = ()) -> bool:
    """Whether a ``Host`` header names this machine: by address, as localhost, or by one of ``names``.

    Any machine of a LAN can have itself called by a name such as evil.local, and have it mean this machine a moment
    later; an address it cannot.
    """
    name = _name_of(host)
    return name == "localhost" or name.endswith(".localhost") or _is_address(name) or name in names


def _name_of(host: str) -> str:
    name = host.rsplit("]", 1)[0].lstrip("[") if host.startswith("[") else host.rsplit(":", 1)[0]
    return name.rstrip(".").lower()


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def is_own_origin(origin: str | None, host: str) -> bool:
    """Whether ``Origin`` is absent (no browser) or is that of the page itself."""
    return origin is None or origin.split("://", 1)[-1].lower() == host.lower()


def refusal(
    method: str, host: str, origin: str | None, is_marked: bool, names: Collection[str], lets_in: LetsIn
) -> Refusal | None:
    """Why a request is not let in, or None.

    ``is_marked``: it carries what no form of a foreign site can send.  ``lets_in`` knows the team's other web nodes.
    """
    if not is_own_host(host, names):
        return Refusal(
            "Host", "this name is not one of the node's", "use its address, or add the name to [web] names", 403
        )
    if method in ("GET", "HEAD"):
        return None
    if not is_own_origin(origin, host) and not lets_in(origin or ""):
        return Refusal("Origin", "another site asked for this", "use the node's own page", 403)
    if method != "OPTIONS" and not is_marked:
        return Refusal("X-Swarm", "the header is missing", "send 'X-Swarm: 1' or JSON with its content type", 403)
    return None


def headers(host: str, origin: str | None, lets_in: LetsIn) -> dict[str, str]:
    """The headers of an answer to ``origin``."""
    if origin is None or is_own_origin(origin, host) or not lets_in(origin):
        return HEADERS
    return {**HEADERS, **SHARED, "Access-Control-Allow-Origin": origin}


def token_of(authorization: str, ticket: str) -> str:
    """What a visitor shows: the token of the header, or else the ticket of the query, or nothing."""
    kind, _, token = authorization.partition(" ")
    return token.strip() if kind.lower() == "bearer" and token.strip() else ticket
