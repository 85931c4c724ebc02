"""Check which requests a page on a LAN may answer, and set strict security headers.  Pure.

The page uses no cookies, so another site can only send requests through a user's browser.  Three checks stop such
requests: ``Host`` must be an address or a name of this machine (against DNS rebinding), ``Origin`` must be the page's
own or belong to another web node of the team, and a request that changes something must be of a kind that an HTML form
cannot send.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Collection

from webnode.errors import Refusal

MAX_BODY = 64 * 1024
LOCAL_SUFFIXES = (".localhost", ".local", ".lan", ".internal", ".home.arpa")
HEADERS = {
    # A page that has lost its node connects to other web nodes, whose addresses this node may not know.
    "Content-Security-Policy": (
        "default-src 'self'; connect-src 'self' http: https:; "
        "object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
SHARED_HEADERS = {
    "Vary": "Origin",
    "Cross-Origin-Resource-Policy": "cross-origin",
    "Access-Control-Allow-Methods": "GET, POST, PUT, DELETE",
    "Access-Control-Allow-Headers": "Authorization, Content-Type, Idempotency-Key, Last-Event-ID, X-Swarm",
    "Access-Control-Expose-Headers": "X-Age, X-Seq",
    "Access-Control-Max-Age": "600",
}
"""CORS headers that allow requests from the page of another web node."""

IsAllowedOrigin = Callable[[str], bool]


def is_local_name(host: str) -> bool:
    """Return whether a ``Host`` header can name a machine of the local network: an address or a local name."""
    name = _get_hostname(host)
    is_plain = bool(name) and all(c.isalnum() or c in "-_" for c in name)
    return is_plain or name.endswith(LOCAL_SUFFIXES) or _is_address(name)


def is_own_host(host: str, names: Collection[str] = ()) -> bool:
    """Return whether a ``Host`` header names this machine: by address, as localhost, or by one of ``names``.

    Other local names are not accepted: any machine of a LAN can register a name such as evil.local and then let it
    resolve to this machine's address (DNS rebinding).
    """
    name = _get_hostname(host)
    return name == "localhost" or name.endswith(".localhost") or _is_address(name) or name in names


def _get_hostname(host: str) -> str:
    name = host.rsplit("]", 1)[0].lstrip("[") if host.startswith("[") else host.rsplit(":", 1)[0]
    return name.rstrip(".").lower()


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def is_own_origin(origin: str | None, host: str) -> bool:
    """Return whether ``Origin`` is absent (not sent by a browser) or the page's own."""
    return origin is None or origin.split("://", 1)[-1].lower() == host.lower()


def find_refusal(
    method: str,
    host: str,
    origin: str | None,
    has_csrf_header: bool,
    names: Collection[str],
    is_allowed_origin: IsAllowedOrigin,
) -> Refusal | None:
    """Return why a request is rejected, or None.

    ``has_csrf_header`` is whether the request carries a header or content type that an HTML form cannot send.
    ``is_allowed_origin`` accepts the origins of the team's other web nodes.
    """
    if not is_own_host(host, names):
        return Refusal(
            "Host", "the name is not a name of this node", "use the node's address, or add the name to [web] names", 403
        )
    if method in ("GET", "HEAD"):
        return None
    if not is_own_origin(origin, host) and not is_allowed_origin(origin or ""):
        return Refusal("Origin", "the request comes from another site", "use the node's own page", 403)
    if method != "OPTIONS" and not has_csrf_header:
        return Refusal("X-Swarm", "the header is missing", "send 'X-Swarm: 1' or JSON with its content type", 403)
    return None


def make_headers(host: str, origin: str | None, is_allowed_origin: IsAllowedOrigin) -> dict[str, str]:
    """Return the security headers of a response to ``origin``."""
    if origin is None or is_own_origin(origin, host) or not is_allowed_origin(origin):
        return HEADERS
    return {**HEADERS, **SHARED_HEADERS, "Access-Control-Allow-Origin": origin}


def choose_token(authorization: str, ticket: str) -> str:
    """Return the token of the Authorization header, otherwise the ticket of the query, otherwise an empty string."""
    kind, _, token = authorization.partition(" ")
    return token.strip() if kind.lower() == "bearer" and token.strip() else ticket
