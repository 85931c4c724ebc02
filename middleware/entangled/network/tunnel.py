"""Carry datagrams as WebSocket messages over TLS, for networks where a firewall blocks UDP.

A serving node has one tunnel per client, and a dialling node has one tunnel per configured URL.  Both kinds of tunnels
are identified by virtual addresses, ``~wss-`` and 12 hexadecimal digits, which are meaningless to other nodes.  A URL
is dialled when a datagram is sent to its address, and the tunnel is closed after a time without traffic, so the sender
controls the lifetime of the tunnel.  The tunnel does not authenticate peers, because the wire protocol inside it does.
TLS is used only because other traffic on port 443 may be blocked.
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
from middleware.entangled.network.layer import (
    ProxyLayer,
    StreamLayer,
    TlsLayer,
    make_client_context,
    make_server_context,
)
from middleware.entangled.network.network import Address, Receiver
from middleware.entangled.network.selfsigned import make_certificate
from middleware.entangled.network.stream_transport import StreamTransport
from middleware.entangled.network.tunnel_connection import TunnelConnection
from middleware.entangled.network.tunnel_connections import MAX_CONNECTIONS, TunnelConnections
from middleware.entangled.network.url import VIRTUAL_PREFIX, Proxy, Url
from middleware.entangled.network.websocket import MAX_PAYLOAD_BYTES, WebSocket

CHECK_INTERVAL_S = 1.0
ACCEPT_TIMEOUT_S = 8.0
"""The time in seconds from the connection to the end of the TLS and WebSocket handshakes."""
DIAL_TIMEOUT_S = 12.0
"""The same time in seconds for the dialling side; it is longer, because the connection may go through a proxy."""
UNANSWERED_TIMEOUT_S = 10.0
"""If this node has sent no answer to a client within this time in seconds, the client is considered a non-member,
because the wire protocol answers only members."""
IDLE_TIMEOUT_S = 60.0
"""The time in seconds without traffic after which the dialling side closes a tunnel."""
MAX_TOTAL_CONNECTIONS = 256
MAX_HANDSHAKES = 64
"""The maximum number of connections that are not open yet; if there are more, the oldest is closed."""
MAX_PER_HOST = 32
"""The maximum number of connections from one address to which the node has sent nothing.  A team behind one NAT shares
an address; therefore the limit of all connections from one address is the number that this many tunnels need."""
MIN_REDIAL_S, MAX_REDIAL_S = 0.5, 10.0
"""The first and the longest delay in seconds before a URL that failed is dialled again."""


@dataclass(slots=True, eq=False)
class _Target:
    """A URL that may be dialled."""

    url: Url
    redial_delay_s: float = MIN_REDIAL_S
    redial_at: float = float("-inf")
    last_failure: str = ""


class TunnelNetwork:
    """Tunnels to ``urls``, and from clients if ``is_served``.

    With ``is_plain`` tunnels are served without TLS, for a reverse proxy on the same machine that sends the client's
    address in ``X-Forwarded-For``.  ``proxy_for`` returns the HTTP proxy for a URL.  ``counters`` counts datagrams:
    sent, received, unsent (no such tunnel), dropped (the queue was full).  It also counts connections: opened, lost,
    refused (no valid handshake in time), crowded (too many connections).
    """

    _log = Logger()

    def __init__(
        self,
        transport: StreamTransport,
        clock: IReactorTime,
        rng: random.Random,
        urls: Sequence[Url] = (),
        is_served: bool = False,
        is_plain: bool = False,
        proxy_for: Callable[[Url], Proxy | None] = lambda url: None,
    ) -> None:
        self.counters: Counter[str] = Counter()
        self._transport = transport
        self._clock = clock
        self._rng = rng
        self._targets = {url.address: _Target(url) for url in urls}
        self._is_served = is_served
        self._is_plain = is_plain
        self._proxy_for = proxy_for
        self._tunnels: dict[Address, TunnelConnections] = {}
        self._tunnels_by_token: dict[bytes, TunnelConnections] = {}
        self._closing: set[TunnelConnection] = set()
        self._receiver: Receiver | None = None
        self._timer: IDelayedCall | None = None

    @property
    def address(self) -> Address:
        """The address of this end; no datagram can be sent to this address."""
        return Address(VIRTUAL_PREFIX + "0" * 12, 1)

    @property
    def alternate_paths(self) -> list[Address]:
        """The addresses of the URLs that may be dialled."""
        return list(self._targets)

    @property
    def peers(self) -> list[Address]:
        """The addresses of open tunnels."""
        return [address for address, tunnel in self._tunnels.items() if tunnel.is_open]

    def listen(self, receiver: Receiver) -> None:
        """Start serving, if configured, and pass each datagram to ``receiver``; raises ``PortInUse``."""
        if self._receiver is None and self._is_served:
            self._transport.listen(self._accept)
        self._receiver = receiver

    def send(self, datagram: bytes, to: Address) -> None:
        """Send a datagram; while its tunnel is being opened, the datagram is queued, or lost if the queue is full."""
        tunnel = self._tunnels.get(to) or self._open_tunnel(to)
        if tunnel is None or self._receiver is None or len(datagram) > MAX_PAYLOAD_BYTES:
            self.counters["unsent"] += 1
            return
        now = self._clock.seconds()
        self.counters["sent" if tunnel.send(datagram, now) else "dropped"] += 1
        self._adjust_connections(tunnel, now)

    def close(self) -> None:
        """Close all tunnels; may be called twice."""
        self._receiver = None
        self._transport.close()
        for connection in self._connections:
            connection.close("the node is stopping")
        for connection in list(self._closing):
            connection.cancel_close()
        self._closing.clear()
        cancel(self._timer)
        self._timer = None

    # -- called by the connections ----------------------------------------------------------------------------------

    def on_connection_open(self, connection: TunnelConnection) -> bool:
        """Register a connection that has opened; return False if there are too many connections from its address."""
        if self._is_plain and connection.address not in self._targets:
            host = _address_block(connection.socket.forwarded) or connection.host
            if connection.socket.forwarded and self._is_crowded(host):
                self.counters["crowded"] += 1
                return False
            connection.host = host
        self.counters["opened"] += 1
        now = self._clock.seconds()
        connection.started_at = now
        tunnel = self._tunnels[connection.address]
        if connection.address not in self._targets:
            self._group_connection(connection, tunnel, now)
        elif sum(each.is_open for each in tunnel.connections) == 1:
            tunnel.active_at = now
            self._log.info("tunnel to {url} opened", url=str(self._targets[connection.address].url))
        return True

    def on_connection_datagram(self, connection: TunnelConnection, datagram: bytes) -> None:
        """Pass a datagram to the receiver."""
        if self._receiver is not None:
            self.counters["received"] += 1
            tunnel = self._tunnels.get(connection.address)
            if tunnel is not None:
                tunnel.active_at = self._clock.seconds()
            self._receiver(datagram, connection.address)

    def on_connection_closed(self, connection: TunnelConnection, why: str) -> None:
        """Forget a connection; if this node dialled it, delay the next attempt."""
        now = self._clock.seconds()
        tunnel = self._tunnels.get(connection.address)
        if tunnel is not None:
            tunnel.remove(connection, now)
            if not tunnel.connections:
                del self._tunnels[connection.address]
                if self._tunnels_by_token.get(tunnel.token) is tunnel:
                    del self._tunnels_by_token[tunnel.token]
        if self._receiver is not None:
            self._closing.add(connection)
        self.counters["lost" if connection.socket.is_open else "refused"] += 1
        target = self._targets.get(connection.address)
        if target is None or (tunnel is not None and tunnel.connections):
            return
        if connection.socket.is_open and now - connection.started_at > MAX_REDIAL_S:
            target.redial_delay_s = MIN_REDIAL_S
        # The delay is measured from the start of the attempt, because an attempt that fails late has already waited.
        target.redial_at = connection.started_at + target.redial_delay_s * (0.75 + self._rng.random() / 2)
        target.redial_delay_s = min(2 * target.redial_delay_s, MAX_REDIAL_S)
        if connection.socket.is_open or target.last_failure != why:
            target.last_failure = why
            self._log.info("tunnel to {url} is not available: {why}", url=str(target.url), why=why)

    # -- private ----------------------------------------------------------------------------------------------------

    @cached_property
    def _client_context(self) -> ssl.SSLContext:
        return make_client_context()

    @cached_property
    def _server_context(self) -> ssl.SSLContext:
        return make_server_context(make_certificate(self._rng.randbytes(32), self._rng.randbytes(8)))

    @property
    def _connections(self) -> list[TunnelConnection]:
        return [connection for tunnel in self._tunnels.values() for connection in tunnel.connections]

    def _open_tunnel(self, to: Address) -> TunnelConnections | None:
        """Open a tunnel to a URL with one connection; return None if the URL may not be dialled now."""
        target, now = self._targets.get(to), self._clock.seconds()
        if target is None or self._receiver is None or now < target.redial_at:
            return None
        tunnel = TunnelConnections(to, self._transport.read_state, now)
        tunnel.token = self._rng.randbytes(16)
        self._dial(target, tunnel)
        return self._tunnels.get(to)

    def _adjust_connections(self, tunnel: TunnelConnections, now: float) -> None:
        """Adjust the number of connections of a dialled tunnel to the loss on its path."""
        target = self._targets.get(tunnel.address)
        if target is None or len(tunnel.connections) == tunnel.target_count(now) == 1:
            return
        for connection in tunnel.find_surplus(now):
            is_still = connection.is_open and tunnel.target_count(now) > 1
            connection.close("the connection stalled" if is_still else "one connection is enough", is_rude=is_still)
        while tunnel.connections and len(tunnel.connections) < tunnel.target_count(now) and now >= tunnel.hold_until:
            self._dial(target, tunnel)

    def _group_connection(self, connection: TunnelConnection, tunnel: TunnelConnections, now: float) -> None:
        """Add an accepted connection to the tunnel of its token; if there are too many, close the most stalled one."""
        token = connection.socket.token
        if not token:
            return
        whole = self._tunnels_by_token.setdefault(token, tunnel)
        if whole is tunnel:
            tunnel.token = token
            return
        del self._tunnels[tunnel.address]
        connection.address = whole.address
        whole.add(connection)
        if len(whole.connections) > MAX_CONNECTIONS:
            whole.find_most_stalled(now).close("replaced by a newer connection of the same tunnel", is_rude=True)

    def _dial(self, target: _Target, tunnel: TunnelConnections) -> None:
        url, proxy = target.url, self._proxy_for(target.url)
        layers: list[StreamLayer] = []
        where = Address(url.host, url.port)
        if proxy is not None:
            host = f"[{url.host}]" if ":" in url.host else url.host
            layers.append(ProxyLayer(f"{host}:{url.port}", proxy.login))
            where = Address(proxy.host, proxy.port)
        if url.is_tls:
            layers.append(TlsLayer(self._client_context, url.host))
        socket = WebSocket(url, tunnel.token)
        connection = self._register(
            TunnelConnection(self, self._clock, tunnel.address, url.host, layers, socket), tunnel
        )
        self._transport.dial(where, connection, lambda why: connection.close(why, is_rude=True))

    def _accept(self, host: str) -> TunnelConnection | None:
        """Return a connection for a client at ``host``; None if there are too many."""
        place = _address_block(host)
        # All clients of a reverse proxy share the address of the proxy. So each client is counted only when the proxy
        # has sent the address of the client.
        if self._receiver is None or (not self._is_plain and self._is_crowded(place)):
            self.counters["crowded"] += 1
            return None
        served = [connection for connection in self._connections if connection.address not in self._targets]
        begun = [connection for connection in served if not connection.is_open]
        unproved = [
            connection
            for connection in served
            if connection.is_open and not self._tunnels[connection.address].is_answered
        ]
        if len(begun) >= MAX_HANDSHAKES:
            begun[0].close("replaced by a newer connection", is_rude=True)
        elif len(served) >= MAX_TOTAL_CONNECTIONS:
            further = [
                connection
                for connection in served
                if connection is not self._tunnels[connection.address].connections[0]
            ]
            if not (begun or unproved or further):
                self.counters["crowded"] += 1
                return None
            (begun or unproved or further)[0].close("replaced by a newer connection", is_rude=True)
        address = Address(VIRTUAL_PREFIX + self._rng.randbytes(6).hex(), 1)
        layers = [] if self._is_plain else [TlsLayer(self._server_context, is_server=True)]
        tunnel = TunnelConnections(address, self._transport.read_state, self._clock.seconds())
        return self._register(TunnelConnection(self, self._clock, address, place, layers, WebSocket()), tunnel)

    def _register(self, connection: TunnelConnection, tunnel: TunnelConnections) -> TunnelConnection:
        self._tunnels[connection.address] = tunnel
        tunnel.add(connection)
        if self._timer is None:
            self._timer = self._clock.callLater(CHECK_INTERVAL_S, self._check_connections)
        return connection

    def _is_crowded(self, host: str) -> bool:
        """Return whether one address already has the maximum number of connections."""
        there = [self._tunnels[connection.address] for connection in self._connections if connection.host == host]
        return (
            len(there) >= MAX_CONNECTIONS * MAX_PER_HOST or sum(not each.is_answered for each in there) >= MAX_PER_HOST
        )

    def _check_connections(self) -> None:
        now = self._clock.seconds()
        self._timer = None
        self._closing = {connection for connection in self._closing if connection.is_closing}
        for connection in self._connections:
            tunnel = self._tunnels.get(connection.address)
            if tunnel is None or connection.is_closed:
                continue
            is_ours, age = connection.address in self._targets, now - connection.started_at
            if not connection.is_open:
                if age > (DIAL_TIMEOUT_S if is_ours else ACCEPT_TIMEOUT_S):
                    connection.close("the handshake timed out", is_rude=True)
            elif is_ours and now - tunnel.active_at > IDLE_TIMEOUT_S:
                connection.close("the tunnel is idle")
            elif not is_ours and not tunnel.is_answered and age > UNANSWERED_TIMEOUT_S:
                connection.close("the client is not a member of this team")
            else:
                connection.check(now)
        for tunnel in list(self._tunnels.values()):
            self._adjust_connections(tunnel, now)
        if self._tunnels or self._closing:
            self._timer = self._clock.callLater(CHECK_INTERVAL_S, self._check_connections)


def _address_block(host: str) -> str:
    """Return the unit of rate limits: an IPv4 address or the /64 prefix of an IPv6 address; "" for any other string."""
    try:
        ip = ip_address(host)
    except ValueError:
        return ""
    if ip.version == 4:
        return str(ip)
    return str(ip.ipv4_mapped) if ip.ipv4_mapped is not None else ip.exploded[:19]
