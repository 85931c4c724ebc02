"""The guard: which requests a page on a LAN may answer, and the headers that keep a browser strict.  Pure.

The page has no cookies, so a foreign site gains nothing but what a visitor's browser reaches for it: it is stopped
at three doors.  ``Host`` must name this machine in a way that nobody outside can register (against rebinding of
names), ``Origin`` must be the page's own, and a request that changes something must be of a kind that a foreign form
cannot send.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Collection

MAX_BODY = 64 * 1024
LOCAL_ENDS = (".localhost", ".local", ".lan", ".internal", ".home.arpa")
HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}


def is_local_host(host: str, names: Collection[str] = ()) -> bool:
    """Whether a ``Host`` header names a machine by address, by a name of the local network, or by one of ``names``."""
    name = host.rsplit("]", 1)[0].lstrip("[") if host.startswith("[") else host.rsplit(":", 1)[0]
    name = name.rstrip(".").lower()
    if name in names or name.endswith(LOCAL_ENDS) or (name and all(c.isalnum() or c in "-_" for c in name)):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def is_own_origin(origin: str | None, host: str) -> bool:
    """Whether ``Origin`` is absent (no browser) or is that of the page itself."""
    return origin is None or origin.split("://", 1)[-1].lower() == host.lower()
