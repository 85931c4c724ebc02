"""Simulate a router with network address translation on a switchboard.

The kinds differ in their mapping and filtering, in the terms of RFC 4787; two further kinds are also common:

| kind    | mapping                                | accepts from                   |
|---------|----------------------------------------|--------------------------------|
| `full`  | one port per inner address             | every address                  |
| `addr`  | the same                               | hosts that received a datagram |
| `port`  | the same                               | addresses that received one    |
| `leaky` | the same, unless the port is occupied  | the same                       |
| `sym`   | one port per inner address and target  | the same                       |
| `noudp` | none                                   | no address                     |

A *leaky* router treats an unsolicited datagram as addressed to the router itself and remembers the sender.  An inner
node that then sends to this sender gets a different port, because its usual port is occupied.  An example is a Linux
router with MASQUERADE and without a firewall.
"""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import Literal

from middleware.entangled.network.network import Address

NatKind = Literal["full", "addr", "port", "leaky", "sym", "noudp"]
_FIRST_PORT, _LAST_PORT = 20_000, 60_000


@dataclass(slots=True)
class _Mapping:
    """A port of the router for an inner address; ``last_sent_at`` maps targets to the time of the last datagram."""

    inner: Address
    port: int
    last_sent_at: dict[Address, float]


class NatRouter:
    """A router.  ``host`` is its external address; a mapping without traffic expires after ``lifetime`` seconds."""

    def __init__(self, kind: NatKind, host: str, rng: random.Random, lifetime: float = 30.0) -> None:
        self.kind = kind
        self.host = host
        self.lifetime = lifetime
        self._rng = rng
        self._mappings: dict[int, _Mapping] = {}
        self._occupied: dict[tuple[int, Address], float] = {}
        self._port_offset = 0

    def translate_outgoing(self, inner: Address, to: Address, now: float) -> Address | None:
        """Return the external source address of a datagram from ``inner`` to ``to``; None if it is blocked."""
        if self.kind == "noudp":
            return None
        self._expire(now)
        mapping = self._find_mapping(inner, to)
        if mapping is None:
            mapping = _Mapping(inner, self._free_port(inner, to), {})
            self._mappings[mapping.port] = mapping
        mapping.last_sent_at[to] = now
        return Address(self.host, mapping.port)

    def translate_incoming(self, source: Address, port: int, now: float) -> Address | None:
        """Return the inner destination of a datagram from ``source`` to a port of this router; None if blocked."""
        self._expire(now)
        mapping = self._mappings.get(port)
        if mapping is None or not self._accepts(mapping, source):
            if self.kind == "leaky":
                self._occupied[port, source] = now
            return None
        mapping.last_sent_at[source] = now
        return mapping.inner

    def rebind(self) -> None:
        """Forget every mapping, as after a restart; new mappings get different ports."""
        self._mappings.clear()
        self._occupied.clear()
        self._port_offset = self._rng.randrange(1, 10_000)

    def _find_mapping(self, inner: Address, to: Address) -> _Mapping | None:
        own = [mapping for mapping in self._mappings.values() if mapping.inner == inner]
        if self.kind == "sym":
            return next((mapping for mapping in own if to in mapping.last_sent_at), None)
        if self.kind == "leaky":
            at = next((mapping for mapping in own if to in mapping.last_sent_at), None)
            return at or next((mapping for mapping in own if (mapping.port, to) not in self._occupied), None)
        return next(iter(own), None)

    def _free_port(self, inner: Address, to: Address) -> int:
        port = inner.port + self._port_offset
        while (
            port in self._mappings
            or (port, to) in self._occupied
            or (self.kind == "sym" and port == inner.port + self._port_offset)
            or port > 65535
        ):
            port = self._rng.randrange(_FIRST_PORT, _LAST_PORT)
        return port

    def _accepts(self, mapping: _Mapping, source: Address) -> bool:
        if self.kind == "full":
            return True
        if self.kind == "addr":
            return any(to.host == source.host for to in mapping.last_sent_at)
        return source in mapping.last_sent_at

    def _expire(self, now: float) -> None:
        old = now - self.lifetime
        for port, mapping in list(self._mappings.items()):
            for to in [to for to, at in mapping.last_sent_at.items() if at < old]:
                del mapping.last_sent_at[to]
            if not mapping.last_sent_at:
                del self._mappings[port]
        for burnt in [burnt for burnt, at in self._occupied.items() if at < old]:
            del self._occupied[burnt]
