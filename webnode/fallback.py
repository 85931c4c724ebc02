"""Fallback: the other web nodes of the team, to which a page goes when its own is lost.

Each web node says in its device record at which URLs it serves the page.  Any member can say so of itself; in a closed
team a page follows those alone that have the role ``gateway`` at this moment, as certified by the operator.  What a URL
may be is checked all the same.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from math import inf
from urllib.parse import urlsplit

from middleware.admission.roles import GATEWAY
from middleware.directory.presence import Device, devices_of
from middleware.entangled.record import Record
from middleware.node import SwarmNode
from webnode.guard import is_local_name

REMEMBERED_S = 3600.0
"""How long a page may come from a web node that is gone: it still runs in the visitor's browser."""
MAX_URL = 100
MAX_URLS = 4
MAX_GONE = 256
"""Pages that are gone and remembered, the newest."""
PORTS = {"http": 80, "https": 443}
ANY = ("0.0.0.0", "::", "")


@dataclass(frozen=True)
class Page:
    """A URL at which a node of the team serves the page; ``node`` is the node's uuid."""

    node: str
    url: str
    is_secure: bool = False
    is_self: bool = False


class Fallbacks:
    """The web nodes of the team; this one knows those that it was made with, and hears of no others."""

    def __init__(self, *pages: Page) -> None:
        self.pages = list(pages)

    def here(self) -> list[Page]:
        """Where the page is served now."""
        return self.pages

    def serves(self, urls: Iterable[str]) -> None:
        """Tell the team that this node serves the page at ``urls``, too; call it when the port is open."""
        self.pages += [Page("here", url, url.startswith("https:"), True) for url in urls]

    def lets_in(self, origin: str) -> bool:
        """Whether a page that came from ``origin`` may ask here: it is, or was a short while ago, one of the team's."""
        return origin in [page.url for page in self.pages]


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
    if parts.scheme not in PORTS or not is_bare or not is_local_name(f"[{host}]" if ":" in host else host):
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


@dataclass(frozen=True)
class _Served:
    """A page that was heard of, by the node with the key ``public``; ``end`` is when it is forgotten."""

    public: bytes
    page: Page
    end: float = inf


class TeamFallbacks(Fallbacks):
    """The web nodes of a running team; ``clock`` counts seconds.

    Those that count are gateways: in a closed team whoever has that role now, in an open one, where everybody may do
    everything, whoever serves the page or did within the hour.
    """

    def __init__(self, node: SwarmNode, clock: Callable[[], float]) -> None:
        self._node = node
        self._clock = clock
        self._own = node.entangled.identity.public
        self._served: list[_Served] = []
        self._watch = node.watch_devices(self._follow, keep=True)

    def serves(self, urls: Iterable[str]) -> None:
        """Tell the team that this node serves the page at ``urls``, too; call it when the port is open."""
        pages = [*self._node.presence.device.pages, *urls]
        self._node.presence.change(pages=tuple(dict.fromkeys(pages))[:MAX_URLS])
        self._follow(self._watch.records)

    def here(self) -> list[Page]:
        """Where gateways serve the page now, this node's own first."""
        here = [each for each in self._served if each.end == inf]
        may = {public for public in {each.public for each in here} if self.may_vouch(public) or public == self._own}
        return [each.page for each in here if each.public in may]

    def may_vouch(self, public: bytes) -> bool:
        """Whether the node with that key may let people in, at this moment."""
        if self._node.team is not None:
            return GATEWAY in self._node.team.door.roles_of(public)
        now = self._clock()
        return public == self._own or any(each.public == public and each.end > now for each in self._served)

    def lets_in(self, origin: str) -> bool:
        """Whether a gateway serves the page at ``origin``, or did within the hour.

        A page that was opened at ``localhost`` comes from the port of one, and from this machine.
        """
        asked, now = origin_of(origin), self._clock()
        if not asked:
            return False
        here = urlsplit(asked)

        def is_there(url: str) -> bool:
            known = urlsplit(origin_of(url))
            is_port = (known.scheme, known.port) == (here.scheme, here.port)
            return is_port and (known.hostname == here.hostname or is_loopback(here.hostname or ""))

        found = {each.public for each in self._served if each.end > now and is_there(each.page.url)}
        return any(public == self._own or self.may_vouch(public) for public in found)

    def _follow(self, records: list[Record]) -> None:
        devices = [(device, record.owner) for device, record in devices_of(records) if device.uuid != self._node.uuid]
        own = self._node.presence.device
        here = [
            _Served(public, page)
            for device, public in [(Device(self._node.uuid, own.name, pages=own.pages), self._own), *devices]
            for page in pages_of([device], self._node.uuid)
        ]
        now, known = self._clock(), {(each.public, each.page.url) for each in here}
        gone = [
            replace(each, end=min(each.end, now + REMEMBERED_S))
            for each in self._served
            if each.end > now and (each.public, each.page.url) not in known
        ]
        self._served = here + sorted(gone, key=lambda each: -each.end)[:MAX_GONE]
