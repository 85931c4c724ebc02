"""Provide nodes at sites behind routers, and one public bootstrap node, in virtual time."""

from __future__ import annotations

import random
from typing import Any

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.clock import HeapClock
from middleware.entangled.contact import Contact
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.identity import Identity
from middleware.entangled.network.nat_router import NatKind, NatRouter
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import LinkConditions, Switchboard, SwitchboardNetwork
from middleware.entangled.node import EntangledNode

TEAM = b"t" * 32
LINK = LinkConditions(delay_s=0.015)
"""The delay of one crossing of a site's uplink; a round trip between two sites takes 60 ms."""


class Sites:
    """A network of sites.

    ``conditions`` applies to the uplink of each site. ``nets`` contains the address prefixes of the public and the
    private networks.
    """

    def __init__(
        self,
        seed: int = 1,
        conditions: LinkConditions = LINK,
        lifetime: float = 30.0,
        nets: tuple[str, str] = ("203.0.113", "192.168"),
    ) -> None:
        self.seed = seed
        self.conditions = conditions
        self.lifetime = lifetime
        self.clock = HeapClock()
        self.switchboard = Switchboard(self.clock, random.Random(f"{seed}/board"))
        self.nodes: dict[str, EntangledNode] = {}
        self.networks: dict[str, SwitchboardNetwork] = {}
        self.routers: dict[str, NatRouter] = {}
        self.outside, self.inside = nets
        self.public = Address(f"{self.outside}.1", 7000)
        self.node("pub", self.public)

    def site(self, name: str, kind: str) -> None:
        """Create a site behind a router of this NAT type; for "none" the site is in the public network."""
        if kind != "none":
            host, rng = f"{self.outside}.{10 + len(self.routers)}", random.Random(f"{self.seed}/{name}")
            nat: NatKind = kind  # type: ignore[assignment]
            self.routers[name] = self.switchboard.add_router(NatRouter(nat, host, rng, self.lifetime), self.conditions)

    def node(self, name: str, address: Address, site: str = "") -> EntangledNode:
        """Create and start a node at a site or in the public network; the node joins through the public node."""
        identity = Identity(random.Random(f"{self.seed}/{name}").randbytes(32))
        network = self.switchboard.make_network(*address, home=self.routers.get(site))
        rng = random.Random(f"{self.seed}/{name}/dice")
        node = EntangledNode(identity, TEAM, network, MemoryStore(), self.clock, rng)
        node.rpc("echo")(lambda peer, value: value)
        node.start()
        node.join([self.public] if address != self.public else []).addErrback(lambda failure: None)
        self.nodes[name], self.networks[name] = node, network
        return node

    def at(self, site: str, kind: str, host: int = 2) -> EntangledNode:
        """Create the node ``host`` at the site ``site``, which is created if necessary.

        The node joins within half a second.
        """
        if site not in self.routers:
            self.site(site, kind)
        name = f"{site}{host}"
        if site in self.routers:
            return self.node(name, Address(f"{self.inside}.{ord(site) % 200}.{host}", 7000), site)
        address = Address(f"{self.outside}.{100 + len(self.nodes)}", 7000)
        for other in self.networks.values():
            self.switchboard.set_conditions(address, other.address, self.conditions)
        return self.node(name, address)

    def met_at(self, of: EntangledNode) -> Contact:
        """Return the contact of a node as the public node observes it."""
        peer = self.nodes["pub"].endpoint.peers.get(of.identity.public)
        assert peer is not None and peer.session is not None
        return peer.session.contact

    def way(self, a: EntangledNode, b: EntangledNode) -> str:
        """Return the kind of the current path from ``a`` to ``b``."""
        kind = a.nat.paths.find_path(b.contact).kind
        return kind if kind in ("none", "carried") else "direct"

    def call(self, a: EntangledNode, contact: Contact, timeout: float | None = None) -> tuple[Any, float]:
        """Call ``contact`` from ``a``; return the reply and the seconds until it arrived."""
        began, ended = self.clock.seconds(), [float("nan")]
        outcome: Deferred[Any] = a.call(contact, "echo", 7, timeout=timeout)
        outcome.addBoth(self._note, ended)
        got: list[Any] = []
        outcome.addBoth(got.append)
        while not got and self.clock.seconds() < began + 30.0:
            self.clock.advance(0.01)
        return (got[0] if got else None), ended[0] - began

    def _note(self, result: Any, ended: list[float]) -> Any:
        ended[0] = self.clock.seconds()
        return result

    def run(self, seconds: float) -> None:
        """Advance the clock."""
        self.clock.advance(seconds)

    def stop(self) -> None:
        """Stop every node."""
        for node in self.nodes.values():
            node.stop_silently()


class SitesCase(SynchronousTestCase):
    """A test case with sites, which checks that no node leaves a timer after its stop."""

    def sites(
        self,
        seed: int = 1,
        conditions: LinkConditions = LINK,
        lifetime: float = 30.0,
        nets: tuple[str, str] = ("203.0.113", "192.168"),
    ) -> Sites:
        """Create sites that are stopped after the test."""
        sites = Sites(seed, conditions, lifetime, nets)
        self.addCleanup(self._end, sites)
        return sites

    def _end(self, sites: Sites) -> None:
        sites.stop()
        left = [call for call in sites.clock.getDelayedCalls() if not _is_delivery(call)]
        self.assertEqual(left, [], "a node left a timer behind")


def _is_delivery(call: object) -> bool:
    """Return whether a call is the delivery of a datagram, which cannot be cancelled."""
    return getattr(getattr(call, "_function", None), "__self__", None).__class__ is Switchboard
