"""Nat: a router that translates addresses, in memory, for the switchboard.

The kinds are those that RFC 4787 tells apart by how they map and what they let in, and two that are met besides:

| kind    | mapping                           | lets in                              |
|---------|-----------------------------------|--------------------------------------|
| `full`  | one port for each inner address   | everybody                            |
| `addr`  | the same                          | hosts that were written to           |
| `port`  | the same                          | hosts and ports that were written to |
| `leaky` | the same, until a port is burnt   | the same                             |
| `sym`   | a port of its own for each target | the same                             |
| `noudp` | none                              | nothing                              |

A *leaky* router takes what nobody inside asked for to be for itself and remembers it: whoever inside then writes to
that stranger gets another port, since the usual one is taken (a Linux box with MASQUERADE and no firewall).
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
    """A port of the router that stands for an inner address; ``heard`` has when each target was last written to."""

    inner: Address
    port: int
    heard: dict[Address, float]


class Nat:
    """One router.  ``host`` is its address outside, ``lifetime`` how many seconds a mapping lives without traffic."""

    def __init__(self, kind: NatKind, host: str, rng: random.Random, lifetime: float = 30.0) -> None:
        self.kind = kind
        self.host = host
        self.lifetime = lifetime
        self._rng = rng
        self._mappings: dict[int, _Mapping] = {}
        self._burnt: dict[tuple[int, Address], float] = {}
        self._moved = 0

    def out(self, inner: Address, to: Address, now: float) -> Address | None:
        """The address outside from which a datagram of ``inner`` goes to ``to``; None where it does not get out."""
        if self.kind == "noudp":
            return None
        self._expire(now)
        mapping = self._mapped(inner, to)
        if mapping is None:
            mapping = _Mapping(inner, self._free_port(inner, to), {})
            self._mappings[mapping.port] = mapping
        mapping.heard[to] = now
        return Address(self.host, mapping.port)

    def into(self, source: Address, port: int, now: float) -> Address | None:
        """The inner address to which a datagram of ``source`` to a port of this router goes; None where to nobody."""
        self._expire(now)
        mapping = self._mappings.get(port)
        if mapping is None or not self._lets_in(mapping, source):
            if self.kind == "leaky":
                self._burnt[port, source] = now
            return None
        mapping.heard[source] = now
        return mapping.inner

    def rebind(self) -> None:
        """Forget every mapping, as after a restart; the next ones get other ports."""
        self._mappings.clear()
        self._burnt.clear()
        self._moved = self._rng.randrange(1, 10_000)

    def _mapped(self, inner: Address, to: Address) -> _Mapping | None:
        mine = [mapping for mapping in self._mappings.values() if mapping.inner == inner]
        if self.kind == "sym":
            return next((mapping for mapping in mine if to in mapping.heard), None)
        if self.kind == "leaky":
            at = next((mapping for mapping in mine if to in mapping.heard), None)
            return at or next((mapping for mapping in mine if (mapping.port, to) not in self._burnt), None)
        return next(iter(mine), None)

    def _free_port(self, inner: Address, to: Address) -> int:
        port = inner.port + self._moved
        while (
            port in self._mappings
            or (port, to) in self._burnt
            or (self.kind == "sym" and port == inner.port + self._moved)
            or port > 65535
        ):
            port = self._rng.randrange(_FIRST_PORT, _LAST_PORT)
        return port

    def _lets_in(self, mapping: _Mapping, source: Address) -> bool:
        if self.kind == "full":
            return True
        if self.kind == "addr":
            return any(to.host == source.host for to in mapping.heard)
        return source in mapping.heard

    def _expire(self, now: float) -> None:
        old = now - self.lifetime
        for port, mapping in list(self._mappings.items()):
            for to in [to for to, at in mapping.heard.items() if at < old]:
                del mapping.heard[to]
            if not mapping.heard:
                del self._mappings[port]
        for burnt in [burnt for burnt, at in self._burnt.items() if at < old]:
            del self._burnt[burnt]
