"""Fallback: the other web nodes of the team, to which a page goes when its own is lost.

Each web node says in its device record at which URLs it serves the page.  The record is signed, so that only the team
can name one; what a URL may be is checked all the same, as a page follows it.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Iterable
from math import inf
from urllib.parse import urlsplit

from middleware.entangled.record import Record
from middleware.node import SwarmNode
from middleware.presence import Device, devices_of
from webnode.board import Fallbacks, Page
from webnode.ground import Ground
from webnode.guard import is_local_host

REMEMBERED_S = 3600.0
"""How long a page may come from a web node that is gone: it still runs in the visitor's browser."""
MAX_URL = 100
MAX_URLS = 4
PORTS = {"http": 80, "https": 443}
ANY = ("0.0.0.0", "::", "")


def origin_of(url: str) -> str:
    """The origin of the page at ``url`` as browsers name it, or "" where no page of a team can be there.

    ``localhost`` and the addresses that mean the same become one.
    """
    if not 0 < len(url) <= MAX_URL or not url.isascii() or not url.isprintable():
        return ""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port
    except ValueError:
        return ""
    is_bare = parts.path in ("", "/") and not (parts.query or parts.fragment or "@" in parts.netloc)
    if parts.scheme not in PORTS or not is_bare or not is_local_host(f"[{host}]" if ":" in host else host):
        return ""
    host = "127.0.0.1" if is_loopback(host) else f"[{host}]" if ":" in host else host
    return f"{parts.scheme}://{host}:{PORTS[parts.scheme] if port is None else port}"


def is_loopback(host: str) -> bool:
    """Whether ``host`` means the machine that asks."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def pages_of(devices: Iterable[Device], own: str = "") -> list[Page]:
    """Where ``devices`` serve the page, in their order; ``own`` is the uuid of the node that asks."""
    return [
        Page(device.uuid, url, url.startswith("https:"), device.uuid == own)
        for device in devices
        for url in device.pages[:MAX_URLS]
        if origin_of(url)
    ]


def urls_at(host: str, port: int, names: Iterable[str], is_secure: bool = False) -> list[str]:
    """The URLs of a page that is served at ``host`` and ``port``; ``names`` are the machine's, for any host."""
    hosts = [name for name in names if name] if host in ANY else [host]
    scheme = "https" if is_secure else "http"
    return [f"{scheme}://{f'[{name}]' if ':' in name else name}:{port}" for name in hosts][:MAX_URLS]


class TeamFallbacks:
    """The web nodes of a running team; ``clock`` counts seconds and may be asked on any thread."""

    def __init__(self, node: SwarmNode, clock: Callable[[], float]) -> None:
        self._node = node
        self._clock = clock
        self._ends: dict[str, float] = {}
        self._here: list[Page] = []
        self._watch = node.watch_devices(self._follow, keep=True)

    def serves(self, urls: Iterable[str]) -> None:
        """Tell the team that this node serves the page there too; call it when the port is open."""
        pages = [*self._node.presence.device.pages, *urls]
        self._node.presence.change(pages=tuple(dict.fromkeys(pages))[:MAX_URLS])
        self._follow(self._watch.records)

    def here(self) -> list[Page]:
        """Where the page is served now, this node's own first."""
        return self._here

    def lets_in(self, origin: str) -> bool:
        """Whether a web node of the team is at ``origin``, or was within the hour.

        A page that was opened at ``localhost`` comes from the port of one, and from this machine.
        """
        asked, now = origin_of(origin), self._clock()
        if not asked:
            return False
        ends = self._ends
        if ends.get(asked, 0.0) > now:
            return True
        here = urlsplit(asked)
        ports = {(parts.scheme, parts.port) for known, end in ends.items() if end > now for parts in [urlsplit(known)]}
        return is_loopback(here.hostname or "") and (here.scheme, here.port) in ports

    def _follow(self, records: list[Record]) -> None:
        others = [device for device, _ in devices_of(records) if device.uuid != self._node.uuid]
        own = self._node.presence.device
        pages = pages_of([Device(self._node.uuid, own.name, pages=own.pages), *others], self._node.uuid)
        now = self._clock()
        kept = {known: min(end, now + REMEMBERED_S) for known, end in self._ends.items() if end > now}
        # A new table each time: whoever looks on another thread has the old one in hand.
        self._ends = {**kept, **{origin_of(page.url): inf for page in pages}}
        self._here = pages


def fallbacks(ground: Ground) -> Fallbacks:
    """The web nodes of the team."""
    return TeamFallbacks(ground.node, ground.reactor.seconds)
