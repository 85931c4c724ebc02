"""Find paths to peers behind NAT.

A router with NAT accepts datagrams only from addresses to which an inner node has sent.  Therefore two nodes behind
such routers are *introduced* by a third node, the introducer, which has sessions with both nodes.  The introducer sends
each node the external address of the other node.  Then both nodes send INITs at the same time, so each router accepts
the INITs of the other side (hole punching).  If this fails, the nodes retry from additional local ports.  If that also
fails, the introducer *relays* their datagrams (``relay``) and the nodes continue to retry periodically.

None of this is used for a peer that answers immediately or is in the same private network.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background, gather_until
from middleware.entangled.contact import Contact
from middleware.entangled.contact import parse_contact as contact_in
from middleware.entangled.errors import Refused
from middleware.entangled.identity import derive_node_id
from middleware.entangled.nat.address_query import ADDRESS_REPLY, ADDRESS_REQUEST, AddressQuery
from middleware.entangled.nat.candidate import (
    MAX_CANDIDATES,
    is_loopback,
    is_possible,
    pack_candidates,
    parse_candidates,
)
from middleware.entangled.nat.external_address import ExternalAddresses
from middleware.entangled.nat.introducer import REQUEST_TIMEOUT_S, USUAL_PORTS, Introducer, IntroductionLimits
from middleware.entangled.nat.introducer_selector import IntroducerSelector
from middleware.entangled.nat.known_peers import KnownPeers
from middleware.entangled.nat.path_tracker import EXTENSION_S, AdditionalPorts, PathTracker
from middleware.entangled.nat.relay import RELAY_REQUEST, RELAYED_DATAGRAM, Relay
from middleware.entangled.nat.relay_client import MAX_RELAYS, RelayClient
from middleware.entangled.nat.relayed_network import RelayedNetwork
from middleware.entangled.nat.upgrade import PathUpgrades
from middleware.entangled.network.network import Address, is_relayed, relayed_address
from middleware.entangled.wire.endpoint import Endpoint
from middleware.entangled.wire.peer import OutgoingHandshake, Peer
from middleware.entangled.wire.session import Session

NEW_PORT_AFTER_S = 0.5
"""From this age in seconds, a handshake is also tried from an additional local port."""
RELAY_AFTER_S = 0.9
"""From this age in seconds, a handshake is also sent through relays.  By then most direct paths have been found, and a
request with the default timeout of 1.5 s can still be answered."""
PATH_WORKS_S = 3.0
"""The path to a peer is not changed for this number of seconds after the latest datagram of the peer."""
SIMULTANEOUS = 1
OWN_DELAYS_S = {3: 0.15, 5: 0.7}
PEER_DELAYS_S = {2: 0.15, 4: 0.7}
ORDERS = (2, 3, 4, 5, SIMULTANEOUS)
"""The orders in which two peers send INITs from additional ports: at the same time, or one peer with a delay.  With
some routers, an INIT that arrives too early makes the port unusable.  The kind of the router is not known, so all
orders are tried."""
UPGRADE_S = 1.2
MAINTENANCE_S = 1.0
REOPEN_INTERVAL_S = 2.0
"""The minimum seconds between two reopenings of sessions after changes of this node's address."""


@dataclass(slots=True)
class _Attempt:
    """The search for a path to one peer.

    It records which nodes were asked, which of these nodes know the peer, and which further nodes were suggested.
    """

    peer: Peer
    node_id: bytes
    handshake: OutgoingHandshake | None = None
    asked: set[bytes] = field(default_factory=set)
    introducers: list[Contact] = field(default_factory=list)
    suggested: list[Contact] = field(default_factory=list)
    candidates: dict[Address, None] = field(default_factory=dict)


class NatTraversal:
    """Finds and maintains paths to peers for one node, by introductions and relays.

    ``contacts`` returns the known contacts.
    """

    def __init__(
        self,
        own_id: bytes,
        endpoint: Endpoint,
        network: RelayedNetwork,
        contacts: Callable[[], Iterable[Contact]],
        clock: IReactorTime,
        background: Background,
    ) -> None:
        self._own_id = own_id
        self._endpoint = endpoint
        self._peers = endpoint.peers
        self._network = network
        self._clock = clock
        self._background = background
        self._known = KnownPeers(endpoint.peers)
        self._is_maintenance_scheduled = False
        self._reopened_at = float("-inf")
        self.external = ExternalAddresses(endpoint, network, contacts, self._reopen, clock, background)
        self._relays = RelayClient(own_id, endpoint, network, clock)
        self.selector = IntroducerSelector(
            own_id, endpoint.peers, contacts, self.external, self._relays, clock, lambda: self._rng
        )
        self.paths = PathTracker(endpoint.peers, network, self.external, self._relays, clock)
        self._additional_ports = AdditionalPorts(network, self.paths, clock)
        self.relay = Relay(self._known.find_direct_session, endpoint.send_sealed, clock, endpoint.counters)
        self._limits = IntroductionLimits(clock)
        self.introducer = Introducer(endpoint, self._known, self._relays, self.relay, self._limits, clock)
        self._upgrades = PathUpgrades(endpoint.peers)
        self.query = AddressQuery(endpoint.send_sealed, network, clock, lambda: self._rng, background)
        endpoint.route_message(RELAY_REQUEST, self.relay.on_request)
        endpoint.route_message(RELAYED_DATAGRAM, self._relays.on_relayed)
        endpoint.route_message(ADDRESS_REQUEST, self.query.on_request)
        endpoint.route_message(ADDRESS_REPLY, self.query.on_reply)
        # Run at most once per request, because each run would open another port.
        endpoint.expose("reach.introduce", self.introducer.answer_introduce, changes=True)
        endpoint.expose("reach.meet", self._answer_meet, changes=True)
        endpoint.expose("reach.seen", self.external.answer_seen, changes=True)
        self._peers.is_far = self.external.is_far
        self._peers.on_slow_handshake.add(lambda opening: background.fork(self._find_path(opening)))
        self._peers.on_established.add(self._on_session)
        self._peers.on_moved.add(self.external.report_change)
        endpoint.on_seen.add(self.external.record)
        endpoint.on_forgotten.add(self._forget)
        network.send_relayed = self._relays.send

    @cached_property
    def _rng(self) -> random.Random:
        # This generator is separate from the endpoint's generator, whose random numbers thus stay the same; it only
        # distributes load.
        return random.Random(int.from_bytes(self._own_id))

    def _forget(self, public: bytes) -> None:
        """Delete the state of a peer that was silent for a long time and has no session."""
        self._known.forget(public)
        self.external.forget(public)
        self.paths.forget(public)

    # -- finding a path ---------------------------------------------------------------------------------------------

    async def _find_path(self, opening: OutgoingHandshake) -> None:
        """Help an outgoing handshake that got no early answer."""
        attempt = _Attempt(opening.peer, derive_node_id(opening.peer.public), opening)
        if not self._select_introducers(attempt):
            return
        since, now = opening.started_at, self._clock.seconds()
        self._peers.extend(opening, now + REQUEST_TIMEOUT_S + RELAY_AFTER_S)
        self._background.later(max(0.0, since + RELAY_AFTER_S - now), self._send_by_relay, opening)
        await self._ask_introducers(attempt)
        if not attempt.introducers and self._is_pending(opening):
            await self._ask_introducers(attempt)  # ask more introducers, or the nodes that the first ones suggested
        if not self._is_pending(opening):
            return
        if not attempt.introducers:
            self._peers.extend(opening, 0.0)
            return
        self._peers.extend(opening, since + EXTENSION_S)
        if not attempt.candidates or self._clock.seconds() > since + RELAY_AFTER_S:
            self._send_by_relay(opening)
        await self._background.sleep(max(0.0, since + NEW_PORT_AFTER_S - self._clock.seconds()))
        await self._punch_from_new_port(attempt, SIMULTANEOUS)

    async def _upgrade(self, peer: Peer, step: int) -> None:
        """Try a direct path to a relayed peer."""
        attempt = _Attempt(peer, derive_node_id(peer.public))
        if peer.handshake is None:
            await self._ask_introducers(attempt)
        candidates = list(attempt.candidates)
        session = peer.session
        if not candidates or session is None or not is_relayed(session.contact.address) or peer.handshake is not None:
            return
        if self._start_punching(peer.public, candidates, 0, UPGRADE_S):
            attempt.handshake = peer.handshake
            await self._background.sleep(NEW_PORT_AFTER_S)
            await self._punch_from_new_port(attempt, ORDERS[step % len(ORDERS)])

    async def _ask_introducers(self, attempt: _Attempt) -> None:
        """Request introductions from several peers, and send INITs to the addresses in the first answers."""
        helpers = self._select_introducers(attempt)
        attempt.asked |= {helper.public for helper in helpers}

        async def ask(helper: Contact) -> bool:
            found = await self._request_introduction(attempt, helper, self._own_candidates(helper), USUAL_PORTS)
            self._punch(attempt, found)
            return bool(attempt.introducers)

        await gather_until(lambda results: any(results), [ask(helper) for helper in helpers])

    def _select_introducers(self, attempt: _Attempt) -> list[Contact]:
        return self.selector.select(attempt.node_id, attempt.suggested, attempt.asked)

    async def _punch_from_new_port(self, attempt: _Attempt, order: int) -> None:
        """Retry from an additional local port, because early INITs may have made the usual port unusable."""
        opening = attempt.handshake
        if opening is None or not self._is_pending(opening) or not attempt.introducers:
            return
        helper = attempt.introducers[0]
        session = self._peers.find_direct_session(helper.public)
        port = self._open_port() if session is not None else 0
        if session is None or not port:
            return
        wait = OWN_DELAYS_S.get(order, 0.0)
        self._peers.extend(
            opening, max(opening.held_until, self._clock.seconds() + 2 * REQUEST_TIMEOUT_S + wait + UPGRADE_S)
        )
        seen = await self.query.ask(session, port)
        if seen is None or not self._is_pending(opening):
            return
        own = [seen, self._network.source_address(helper.address, port)]
        found = await self._request_introduction(attempt, helper, own, order)
        if wait:
            await self._background.sleep(wait)
        self._assign_port(attempt.peer, found, port)
        self._punch(attempt, found)

    def _punch(self, attempt: _Attempt, found: list[Address]) -> None:
        if found and attempt.handshake is not None:
            self.paths.record_introduction(attempt.peer.public)
            self._peers.punch(attempt.handshake, found)

    async def _request_introduction(
        self, attempt: _Attempt, helper: Contact, own: list[Address], order: int
    ) -> list[Address]:
        """Request an introduction from ``helper``, which sends ``own`` to the peer; return the peer's addresses."""
        answer = await self._endpoint.ask(
            helper,
            "reach.introduce",
            attempt.node_id,
            pack_candidates(own),
            order,
            timeout=REQUEST_TIMEOUT_S,
            changes=True,
        )
        if not (isinstance(answer, list) and len(answer) == 3):
            return []
        fields, relays, may_carry = answer
        found = [address for address in parse_candidates(fields) if self._is_usable(address)]
        attempt.introducers.append(helper)
        attempt.candidates.update(dict.fromkeys(found))
        if may_carry is True and not is_relayed(helper.address):
            self._relays.add_relay(attempt.node_id, helper.public)
        for each in relays[:MAX_RELAYS] if isinstance(relays, list) else ():
            contact = contact_in(each)
            if contact is not None:
                attempt.suggested.append(contact)
        return found

    def _send_by_relay(self, opening: OutgoingHandshake) -> None:
        """Send the INIT of a handshake also through a relay, if there is one."""
        peer_id = derive_node_id(opening.peer.public)
        if self._is_pending(opening) and self._relays.find_session(peer_id) is not None:
            self._peers.punch(opening, [relayed_address(peer_id)])

    def _start_punching(self, public: bytes, candidates: list[Address], port: int, seconds: float) -> bool:
        """Start to send INITs from a local port to the addresses of a peer; return False if that is not possible."""
        try:
            peer = self._peers.get_or_create(Contact(public, candidates[0]))
        except ValueError:
            return False
        if port:
            self._assign_port(peer, candidates, port)
        if peer.handshake is None and not self._peers.open(peer, candidates[0], is_wanted=False):
            return False
        self.paths.record_introduction(public)
        opening = peer.handshake
        if opening is not None:
            self._peers.extend(opening, max(opening.held_until, self._clock.seconds() + seconds))
            self._peers.punch(opening, candidates)
        return True

    def _assign_port(self, peer: Peer, addresses: Iterable[Address], port: int) -> None:
        """Assign a local port to these addresses of a peer, except one with a working session."""
        session, before = peer.session, self._clock.seconds() - PATH_WORKS_S
        used = session.contact.address if session is not None and session.last_received_at > before else None
        for address in addresses:
            if address != used:
                self._network.assign_port(address, port)

    # -- requests of peers ------------------------------------------------------------------------------------------

    async def _answer_meet(self, peer: Contact, public: bytes, candidates: list[object], order: int) -> list[object]:
        """Answer REACH.MEET: send INITs to the candidates of ``public``; return this node's candidates.

        The introducer is ``peer``.
        """
        if not self._limits.may_meet(peer.public):
            raise Refused("the peer requested too many introductions to nodes that do not answer; try again later")
        found = [address for address in parse_candidates(candidates) if self._is_usable(address)]
        wanted_id = derive_node_id(public)
        if wanted_id == self._own_id:
            raise Refused("the peer to meet is this node itself")
        self._known.add(public)
        self._limits.record_introducer(public, peer.public)
        if not is_relayed(peer.address):
            self._relays.add_relay(wanted_id, peer.public)
        self._upgrades.delay(public, self._clock.seconds())
        port, own = 0, self._own_candidates(peer)
        session = self._peers.find_direct_session(peer.public)
        if order != USUAL_PORTS and session is not None and (additional := self._open_port()):
            seen = await self.query.ask(session, additional)
            if seen is not None:
                port, own = additional, [seen, self._network.source_address(peer.address, additional)]
        if found:
            # The other peer gets this node's addresses later, through the introducer.  Both peers must send at the same
            # time, because an INIT that arrives too early may make the port of a router unusable.
            wait = (self._endpoint.round_trip(peer) or 0.0) + PEER_DELAYS_S.get(order, 0.0)
            self._background.later(wait, self._start_punching, public, found, port, EXTENSION_S)
        return [pack_candidates(own), bool(port)]

    # -- maintenance ------------------------------------------------------------------------------------------------

    def _reopen(self, reporter: Contact) -> None:
        """Reopen the sessions through NAT mappings, and soon retry direct paths."""
        now = self._clock.seconds()
        if now - self._reopened_at < REOPEN_INTERVAL_S:
            return
        self._reopened_at = now
        self.paths.reopen(reporter.public)
        self._upgrades.retry_now(now)

    def _on_session(self, session: Session) -> None:
        public, now = session.contact.public, self._clock.seconds()
        self._known.add(public)
        self.paths.record_session(session)
        self._limits.refund(public)
        if is_relayed(session.contact.address):
            if self._peers.find_session(public) is session:
                self._upgrades.add(public, self._own_id > session.contact.node_id, now)
        else:
            self._upgrades.drop(public)
        self._schedule_maintenance()

    def _schedule_maintenance(self) -> None:
        """Schedule the next maintenance, if there is something to maintain."""
        if not self._is_maintenance_scheduled and (
            self._upgrades or self.paths.has_nat_mappings or self._additional_ports
        ):
            self._is_maintenance_scheduled = True
            self._background.later(MAINTENANCE_S, self._maintain)

    def _maintain(self) -> None:
        now = self._clock.seconds()
        self._additional_ports.close_unused(now)
        for peer, step in self._upgrades.due(now):
            self._background.fork(self._upgrade(peer, step))
        self.external.keep_mapping_open(now)
        self._is_maintenance_scheduled = False
        self._schedule_maintenance()

    # -- helpers ----------------------------------------------------------------------------------------------------

    def _is_usable(self, address: Address) -> bool:
        return is_possible(address) and (
            not is_loopback(address.host) or is_loopback(self._network.source_address(address).host)
        )

    def _is_pending(self, opening: OutgoingHandshake) -> bool:
        return opening.peer.handshake is opening

    def _own_candidates(self, helper: Contact) -> list[Address]:
        """Return this machine's addresses, first the source address of datagrams to ``helper``."""
        first = self._network.source_address(helper.address)
        others = [Address(host, self._network.address.port) for host in self._network.local_hosts()]
        return list(dict.fromkeys([first, *others]))[: MAX_CANDIDATES - 1]

    def _open_port(self) -> int:
        """Open an additional local port and return it; 0 if there are too many."""
        port = self._additional_ports.open()
        self._schedule_maintenance()
        return port
