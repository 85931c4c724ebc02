"""Keep the URLs of the team's other web nodes, to which a page switches when its own node fails.

Each web node publishes its URLs in its device record.  Any member can publish such URLs; in a closed team a page uses
only URLs of nodes that currently have the role ``gateway``, certified by the operator.  The URLs are validated in any
case.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from math import inf
from urllib.parse import urlsplit

from middleware.admission.roles import GATEWAY
from middleware.directory.presence import Device, parse_devices
from middleware.entangled.record import Record
from middleware.node import SwarmNode
from webnode.request_guard import is_local_name

ORIGIN_KEPT_S = 3600.0
"""Seconds for which the origin of a web node that left is still accepted: its page may still run in a browser."""
MAX_URL = 100
MAX_URLS = 4
MAX_GONE = 256
"""Maximum number of pages of departed web nodes that are kept, the newest."""
PORTS = {"http": 80, "https": 443}
ANY_HOSTS = ("0.0.0.0", "::", "")


@dataclass(frozen=True)
class Page:
    """A URL at which a node of the team serves the page; ``node`` is the node's uuid."""

    node: str
    url: str
    is_secure: bool = False
    is_self: bool = False


class Fallbacks:
    """A fixed list of the team's web nodes."""

    def __init__(self, *pages: Page) -> None:
        self.pages = list(pages)

    def list_pages(self) -> list[Page]:
        """Return the pages that are served now."""
        return self.pages

    def publish(self, urls: Iterable[str]) -> None:
        """Publish that this node also serves the page at ``urls``; call it when the port is open."""
        self.pages += [Page("here", url, url.startswith("https:"), True) for url in urls]

    def is_allowed_origin(self, origin: str) -> bool:
        """Return whether ``origin`` is, or recently was, the origin of a page of the team."""
        return origin in [page.url for page in self.pages]


def get_origin(url: str) -> str:
    """Return the origin of the page at ``url`` as browsers write it; "" if the URL is not valid for a page of a team.

    ``localhost`` and all loopback addresses become 127.0.0.1.
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
    """Return whether ``host`` is a loopback name or address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def find_pages(devices: Iterable[Device], own: str = "") -> list[Page]:
    """Return the pages that ``devices`` serve, in their order; ``own`` is the uuid of this node."""
    return [
        Page(device.uuid, url, url.startswith("https:"), device.uuid == own)
        for device in devices
        for url in device.pages[:MAX_URLS]
        if get_origin(url)
    ]


def make_urls(host: str, port: int, names: Iterable[str], is_secure: bool = False) -> list[str]:
    """Return the URLs of a page at ``host`` and ``port``; ``names`` replace a wildcard host."""
    hosts = [name for name in names if name] if host in ANY_HOSTS else [host]
    scheme = "https" if is_secure else "http"
    return [f"{scheme}://{f'[{name}]' if ':' in name else name}:{port}" for name in hosts][:MAX_URLS]


@dataclass(frozen=True)
class _Served:
    """A page published by the node with the key ``public``; ``end`` is the time when it is forgotten."""

    public: bytes
    page: Page
    end: float = inf


class TeamFallbacks(Fallbacks):
    """The web nodes of a running team; ``clock`` counts seconds.

    Only gateways are listed.  In a closed team these are the nodes that have this role now; in an open team every node
    that serves the page or has served it within the last hour.
    """

    def __init__(self, node: SwarmNode, clock: Callable[[], float]) -> None:
        self._node = node
        self._clock = clock
        self._own = node.entangled.identity.public
        self._served: list[_Served] = []
        self._watch = node.watch_devices(self._on_records, keep=True)

    def publish(self, urls: Iterable[str]) -> None:
        """Publish that this node also serves the page at ``urls``; call it when the port is open."""
        pages = [*self._node.presence.device.pages, *urls]
        self._node.presence.change(pages=tuple(dict.fromkeys(pages))[:MAX_URLS])
        self._on_records(self._watch.records)

    def list_pages(self) -> list[Page]:
        """Return the pages that gateways serve now, this node's pages first."""
        current = [each for each in self._served if each.end == inf]
        gateways = {
            public
            for public in {each.public for each in current}
            if self.can_authenticate(public) or public == self._own
        }
        return [each.page for each in current if each.public in gateways]

    def can_authenticate(self, public: bytes) -> bool:
        """Return whether the node with the key ``public`` may currently authenticate users."""
        if self._node.team is not None:
            return GATEWAY in self._node.team.admission.roles_of(public)
        now = self._clock()
        return public == self._own or any(each.public == public and each.end > now for each in self._served)

    def is_allowed_origin(self, origin: str) -> bool:
        """Return whether ``origin`` belongs to a page of a gateway, now or within the last hour.

        A loopback origin is accepted if its scheme and port match, because its page comes from this machine.
        """
        wanted, now = get_origin(origin), self._clock()
        if not wanted:
            return False
        current = urlsplit(wanted)

        def is_match(url: str) -> bool:
            known = urlsplit(get_origin(url))
            is_port = (known.scheme, known.port) == (current.scheme, current.port)
            return is_port and (known.hostname == current.hostname or is_loopback(current.hostname or ""))

        found = {each.public for each in self._served if each.end > now and is_match(each.page.url)}
        return any(public == self._own or self.can_authenticate(public) for public in found)

    def _on_records(self, records: list[Record]) -> None:
        devices = [
            (device, record.owner) for device, record in parse_devices(records) if device.uuid != self._node.uuid
        ]
        own = self._node.presence.device
        current = [
            _Served(public, page)
            for device, public in [(Device(self._node.uuid, own.name, pages=own.pages), self._own), *devices]
            for page in find_pages([device], self._node.uuid)
        ]
        now, known = self._clock(), {(each.public, each.page.url) for each in current}
        departed = [
            replace(each, end=min(each.end, now + ORIGIN_KEPT_S))
            for each in self._served
            if each.end > now and (each.public, each.page.url) not in known
        ]
        self._served = current + sorted(departed, key=lambda each: -each.end)[:MAX_GONE]
