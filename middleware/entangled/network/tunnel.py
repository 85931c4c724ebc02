"""Carry datagrams as WebSocket messages over TLS, for networks where a firewall blocks UDP.

A serving node has a tunnel per client, a dialling node one per configured URL.  Both are identified by virtual
addresses, ``~wss-`` and 12 hexadecimal digits, which are meaningless to other nodes.  A URL is dialled when a datagram
is sent to its address, and closed after a time without traffic, so the sender controls its lifetime.  A tunnel
authenticates no peer: the wire protocol inside does, and TLS is used only because other traffic on port 443 may be
blocked.
"""

from __future__ import annotations

import random
import ssl
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from ipaddress import ip_address

from twisted.internet.interfaces import IDelayedCall, IReactorTime
from twisted.logger import Logger

from middleware.entangled.background import cancel
from middleware.entangled.network.bundle import MOST, Bundle
from middleware.entangled.network.carrier import Carrier
from middleware.entangled.network.layer import Layer, Proxied, Tls, client_context, server_context
from middleware.entangled.network.link import Link
from middleware.entangled.network.network import Address, Receiver
from middleware.entangled.network.selfsigned import selfsigned
from middleware.entangled.network.url import VIRTUAL, Proxy, Url
from middleware.entangled.network.websocket import MAX_PAYLOAD, WebSocket

LOOK_S = 1.0
HEAD_S = 8.0
"""The time in seconds from the connection to the end of the TLS and WebSocket handshakes."""
DIALLED_S = 12.0
"""The same for the dialling side, possibly through a proxy."""
UNANSWERED_S = 10.0
"""The time in seconds without an answer after which a client is no member: the wire protocol answers only members."""
UNUSED_S = 60.0
"""The time in seconds without traffic after which the dialling side closes a tunnel."""
MAX_LINKS = 256
MAX_BEGUN = 64
"""The maximum number of connections that are not open yet; beyond it the oldest is closed."""
MAX_OF_HOST = 32
"""The maximum number of connections of one address to which the node has sent nothing.  Because a team behind one NAT
shares an address, all its connections together may be as many as this number of tunnels has."""
FIRST_HOLD_S, LAST_HOLD_S = 0.5, 10.0
"""The delay in seconds before a URL that failed is dialled again: first and longest."""


@dataclass(slots=True, eq=False)
class _Target:
    """A URL that may be dialled."""

    url: Url
    hold_s: float = FIRST_HOLD_S
    hold_until: float = float("-inf")
    last_failure: str = ""


class TunnelNetwork:
    """Tunnels to ``urls``, and from clients if ``is_served``.

    With ``is_plain`` it is served without TLS, for a reverse proxy on the same machine, which sends the client's
    address in ``X-Forwarded-For``.  ``proxy_for`` returns the HTTP proxy for a URL.  ``counters`` counts datagrams:
    sent, received, unsent (no such tunnel), dropped (no room); and links: opened, lost, refused (no valid handshake, or
    not in time), crowded.
    """

    _log = Logger()

    def __init__(
        self,
        carrier: Carrier,
        clock: IReactorTime,
        rng: random.Random,
        urls: Sequence[Url] = (),
        is_served: bool = False,
        is_plain: bool = False,
        proxy_for: Callable[[Url], Proxy | None] = lambda url: None,
    ) -> None:
        self.counters: Counter[str] = Counter()
        self._carrier = carrier
        self._clock = clock
        self._rng = rng
        self._targets = {url.address: _Target(url) for url in urls}
        self._is_served = is_served
        self._is_plain = is_plain
        self._proxy_for = proxy_for
        self._bundles: dict[Address, Bundle] = {}
        self._tokens: dict[bytes, Bundle] = {}
        self._ending: set[Link] = set()
        self._receiver: Receiver | None = None
        self._timer: IDelayedCall | None = None

    @property
    def address(self) -> Address:
        """The address of this end; no datagram can be sent to it."""
        return Address(VIRTUAL + "0" * 12, 1)

    @property
    def detours(self) -> list[Address]:
        """The addresses of the URLs that may be dialled."""
        return list(self._targets)

    @property
    def peers(self) -> list[Address]:
        """The addresses of open tunnels."""
        return [address for address, bundle in self._bundles.items() if bundle.is_open]

    def listen(self, receiver: Receiver) -> None:
        """Start serving, if configured, and pass each datagram to ``receiver``; raises ``PortInUse``."""
        if self._receiver is None and self._is_served:
            self._carrier.listen(self._accept)
        self._receiver = receiver

    def send(self, datagram: bytes, to: Address) -> None:
        """Send a datagram; if its tunnel is being opened the datagram is queued, or lost."""
        bundle = self._bundles.get(to) or self._begin(to)
        if bundle is None or self._receiver is None or len(datagram) > MAX_PAYLOAD:
            self.counters["unsent"] += 1
            return
        now = self._clock.seconds()
        self.counters["sent" if bundle.send(datagram, now) else "dropped"] += 1
        self._adjust_links(bundle, now)

    def close(self) -> None:
        """Close all tunnels; may be called twice."""
        self._receiver = None
        self._carrier.close()
        for link in self._links:
            link.end("the node stops")
        for link in list(self._ending):
            link.forget()
        self._ending.clear()
        cancel(self._timer)
        self._timer = None

    # -- called by the links ----------------------------------------------------------------------------------------

    def link_open(self, link: Link) -> bool:
        """Register a link that is open, unless there are too many from its address."""
        if self._is_plain and link.address not in self._targets:
            host = _address_block(link.socket.forwarded) or link.host
            if link.socket.forwarded and self._is_crowded(host):
                self.counters["crowded"] += 1
                return False
            link.host = host
        self.counters["opened"] += 1
        now = self._clock.seconds()
        link.begun_at = now
        bundle = self._bundles[link.address]
        if link.address not in self._targets:
            self._join(link, bundle, now)
        elif sum(each.is_open for each in bundle.links) == 1:
            bundle.carried_at = now
            self._log.info("tunnel to {url} opened", url=str(self._targets[link.address].url))
        return True

    def link_said(self, link: Link, datagram: bytes) -> None:
        """Pass a datagram to the receiver."""
        if self._receiver is not None:
            self.counters["received"] += 1
            bundle = self._bundles.get(link.address)
            if bundle is not None:
                bundle.carried_at = self._clock.seconds()
            self._receiver(datagram, link.address)

    def link_over(self, link: Link, why: str) -> None:
        """Forget a link, and delay the next attempt if it was dialled."""
        now = self._clock.seconds()
        bundle = self._bundles.get(link.address)
        if bundle is not None:
            bundle.remove(link, now)
            if not bundle.links:
                del self._bundles[link.address]
                if self._tokens.get(bundle.token) is bundle:
                    del self._tokens[bundle.token]
        if self._receiver is not None:
            self._ending.add(link)
        self.counters["lost" if link.socket.is_open else "refused"] += 1
        target = self._targets.get(link.address)
        if target is None or (bundle is not None and bundle.links):
            return
        if link.socket.is_open and now - link.begun_at > LAST_HOLD_S:
            target.hold_s = FIRST_HOLD_S
        # Measured from the attempt: an attempt that took long to fail has waited already.
        target.hold_until = link.begun_at + target.hold_s * (0.75 + self._rng.random() / 2)
        target.hold_s = min(2 * target.hold_s, LAST_HOLD_S)
        if link.socket.is_open or target.last_failure != why:
            target.last_failure = why
            self._log.info("tunnel to {url} is not available: {why}", url=str(target.url), why=why)

    # -- private ----------------------------------------------------------------------------------------------------

    @cached_property
    def _client_context(self) -> ssl.SSLContext:
        return client_context()

    @cached_property
    def _server_context(self) -> ssl.SSLContext:
        return server_context(selfsigned(self._rng.randbytes(32), self._rng.randbytes(8)))

    @property
    def _links(self) -> list[Link]:
        return [link for bundle in self._bundles.values() for link in bundle.links]

    def _begin(self, to: Address) -> Bundle | None:
        """Open a tunnel to a URL with one connection; return None if it may not be dialled now."""
        target, now = self._targets.get(to), self._clock.seconds()
        if target is None or self._receiver is None or now < target.hold_until:
            return None
        bundle = Bundle(to, self._carrier.strain, now)
        bundle.token = self._rng.randbytes(16)
        self._dial(target, bundle)
        return self._bundles.get(to)

    def _adjust_links(self, bundle: Bundle, now: float) -> None:
        """Adjust the number of connections of a dialled tunnel to its loss."""
        target = self._targets.get(bundle.address)
        if target is None or len(bundle.links) == bundle.wanted(now) == 1:
            return
        for link in bundle.dead(now):
            is_still = link.is_open and bundle.wanted(now) > 1
            link.end("the connection stalled" if is_still else "one connection is enough", is_rude=is_still)
        while bundle.links and len(bundle.links) < bundle.wanted(now) and now >= bundle.hold_until:
            self._dial(target, bundle)

    def _join(self, link: Link, bundle: Bundle, now: float) -> None:
        """Add an accepted connection to the tunnel that it names; if there are too many, close the most stalled."""
        token = link.socket.token
        if not token:
            return
        whole = self._tokens.setdefault(token, bundle)
        if whole is bundle:
            bundle.token = token
            return
        del self._bundles[bundle.address]
        link.address = whole.address
        whole.add(link)
        if len(whole.links) > MOST:
            whole.stillest(now).end("replaced by a newer connection of the same tunnel", is_rude=True)

    def _dial(self, target: _Target, bundle: Bundle) -> None:
        url, proxy = target.url, self._proxy_for(target.url)
        layers: list[Layer] = []
        where = Address(url.host, url.port)
        if proxy is not None:
            host = f"[{url.host}]" if ":" in url.host else url.host
            layers.append(Proxied(f"{host}:{url.port}", proxy.login))
            where = Address(proxy.host, proxy.port)
        if url.is_tls:
            layers.append(Tls(self._client_context, url.host))
        socket = WebSocket(url, bundle.token)
        link = self._register(Link(self, self._clock, bundle.address, url.host, layers, socket), bundle)
        self._carrier.dial(where, link, lambda why: link.end(why, is_rude=True))

    def _accept(self, host: str) -> Link | None:
        """Return a link for a client at ``host``; None if there is no room for it."""
        place = _address_block(host)
        # All clients of a reverse proxy share its address: they are counted when the proxy sends theirs.
        if self._receiver is None or (not self._is_plain and self._is_crowded(place)):
            self.counters["crowded"] += 1
            return None
        served = [link for link in self._links if link.address not in self._targets]
        begun = [link for link in served if not link.is_open]
        unproved = [link for link in served if link.is_open and not self._bundles[link.address].is_answered]
        if len(begun) >= MAX_BEGUN:
            begun[0].end("replaced by a newer connection", is_rude=True)
        elif len(served) >= MAX_LINKS:
            further = [link for link in served if link is not self._bundles[link.address].links[0]]
            if not (begun or unproved or further):
                self.counters["crowded"] += 1
                return None
            (begun or unproved or further)[0].end("replaced by a newer connection", is_rude=True)
        address = Address(VIRTUAL + self._rng.randbytes(6).hex(), 1)
        layers = [] if self._is_plain else [Tls(self._server_context, is_server=True)]
        bundle = Bundle(address, self._carrier.strain, self._clock.seconds())
        return self._register(Link(self, self._clock, address, place, layers, WebSocket()), bundle)

    def _register(self, link: Link, bundle: Bundle) -> Link:
        self._bundles[link.address] = bundle
        bundle.add(link)
        if self._timer is None:
            self._timer = self._clock.callLater(LOOK_S, self._check_links)
        return link

    def _is_crowded(self, host: str) -> bool:
        """Return whether there are too many connections of one address for another one."""
        there = [self._bundles[link.address] for link in self._links if link.host == host]
        return len(there) >= MOST * MAX_OF_HOST or sum(not each.is_answered for each in there) >= MAX_OF_HOST

    def _check_links(self) -> None:
        now = self._clock.seconds()
        self._timer = None
        self._ending = {link for link in self._ending if link.is_closing}
        for link in self._links:
            bundle = self._bundles.get(link.address)
            if bundle is None or link.is_over:
                continue
            is_ours, age = link.address in self._targets, now - link.begun_at
            if not link.is_open:
                if age > (DIALLED_S if is_ours else HEAD_S):
                    link.end("the handshake timed out", is_rude=True)
            elif is_ours and now - bundle.carried_at > UNUSED_S:
                link.end("the tunnel is idle")
            elif not is_ours and not bundle.is_answered and age > UNANSWERED_S:
                link.end("the client is not a member of this team")
            else:
                link.look(now)
        for bundle in list(self._bundles.values()):
            self._adjust_links(bundle, now)
        if self._bundles or self._ending:
            self._timer = self._clock.callLater(LOOK_S, self._check_links)


def _address_block(host: str) -> str:
    """Return the unit of rate limits: an IPv4 address, or the /64 prefix of an IPv6 address; "" for any other text."""
    try:
        ip = ip_address(host)
    except ValueError:
        return ""
    if ip.version == 4:
        return str(ip)
    return str(ip.ipv4_mapped) if ip.ipv4_mapped is not None else ip.exploded[:19]
