"""Find paths to peers behind NAT.

A router with NAT accepts only datagrams that its inside requested.  Therefore two nodes behind such routers are
*introduced* by a third node with sessions to both: it sends each the other's external address, and both send INITs at
the same time, which open the routers for each other (hole punching).  If that fails, they retry from additional local
ports, and finally the third node *relays* (``relay``) while they retry periodically.

A peer that answers at once, or in the same private network, needs none of this.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background, until
from middleware.entangled.contact import Contact
from middleware.entangled.contact import unpacked as contact_in
from middleware.entangled.errors import Refused
from middleware.entangled.identity import node_id
from middleware.entangled.network.network import Address, is_relayed, relayed
from middleware.entangled.reach.acquaintance import Acquaintances
from middleware.entangled.reach.candidate import MAX_CANDIDATES, is_loopback, is_possible, packed, unpacked
from middleware.entangled.reach.carrier import MAX_CARRIERS, Carriers
from middleware.entangled.reach.introducer import ASKED_S, USUAL, Allowance, Introducer
from middleware.entangled.reach.known import Known
from middleware.entangled.reach.mirror import IMAGE, MIRROR, Mirror
from middleware.entangled.reach.outside import Outside
from middleware.entangled.reach.path import PathNetwork
from middleware.entangled.reach.relay import CARRIED, CARRY, Relay
from middleware.entangled.reach.upgrade import Upgrades
from middleware.entangled.reach.way import HELD_S, FreshPorts, Ways
from middleware.entangled.wire.endpoint import Endpoint
from middleware.entangled.wire.peer import Opening, Peer
from middleware.entangled.wire.session import Session

FRESH_AT = 0.5
"""The age in seconds from which a handshake is also tried from an additional local port."""
CARRIED_AT = 0.9
"""The age in seconds from which a handshake is also sent through relays: most direct paths are found by then, and a
request with the default timeout of 1.5 s can still be answered."""
WELL_S = 3.0
"""The seconds since the latest datagram of a peer within which its path is not changed."""
AT_ONCE = 1
WE_WAIT = {3: 0.15, 5: 0.7}
THEY_WAIT = {2: 0.15, 4: 0.7}
ORDERS = (2, 3, 4, 5, AT_ONCE)
"""The order in which the two peers send INITs: from their usual ports; or from additional ones, at the same time or
with a delay.  An INIT that arrives too early spoils the port of some routers.  The kind of the router is not known, so
all orders are tried."""
UPGRADING_S = 1.2
TICK = 1.0
OPENED_GAP = 2.0
"""The minimum seconds between two reopenings of sessions after changes of this node's address."""


@dataclass(slots=True)
class _Attempt:
    """The search for a path to one peer: the nodes asked, the ones that know it, and others that they named."""

    peer: Peer
    node_id: bytes
    opening: Opening | None = None
    asked: set[bytes] = field(default_factory=set)
    helpful: list[Contact] = field(default_factory=list)
    hinted: list[Contact] = field(default_factory=list)
    candidates: dict[Address, None] = field(default_factory=dict)


class Reach:
    """Finds and maintains paths to peers for one node, by introductions and relays.

    ``contacts`` returns the known contacts.
    """

    def __init__(
        self,
        own_id: bytes,
        endpoint: Endpoint,
        paths: PathNetwork,
        contacts: Callable[[], Iterable[Contact]],
        clock: IReactorTime,
        chores: Background,
    ) -> None:
        self._own_id = own_id
        self._endpoint = endpoint
        self._peers = endpoint.peers
        self._paths = paths
        self._clock = clock
        self._chores = chores
        self._known = Known(endpoint.peers)
        self._is_ticking = False
        self._opened_at = float("-inf")
        self.outside = Outside(endpoint, paths, contacts, self._open_again, clock, chores)
        self._carriers = Carriers(own_id, endpoint, paths, clock)
        self.acquaintances = Acquaintances(
            own_id, endpoint.peers, contacts, self.outside, self._carriers, clock, lambda: self._rng
        )
        self.ways = Ways(endpoint.peers, paths, self.outside, self._carriers, clock)
        self._ports = FreshPorts(paths, self.ways, clock)
        self.relay = Relay(self._known.direct_session, endpoint.send_inside, clock, endpoint.counters)
        self._allowance = Allowance(clock)
        self.introducer = Introducer(endpoint, self._known, self._carriers, self.relay, self._allowance, clock)
        self._upgrades = Upgrades(endpoint.peers)
        self.mirror = Mirror(endpoint.send_inside, paths, clock, lambda: self._rng, chores)
        endpoint.route_inside(CARRY, self.relay.on_carry)
        endpoint.route_inside(CARRIED, self._carriers.on_carried)
        endpoint.route_inside(MIRROR, self.mirror.on_mirror)
        endpoint.route_inside(IMAGE, self.mirror.on_image)
        # Run at most once per request, because each run would open another port.
        endpoint.expose("reach.introduce", self.introducer.answer_introduce, changes=True)
        endpoint.expose("reach.meet", self._answer_meet, changes=True)
        endpoint.expose("reach.seen", self.outside.answer_seen, changes=True)
        self._peers.is_far = self.outside.is_far
        self._peers.on_silence.add(lambda opening: chores.fork(self._find(opening)))
        self._peers.on_established.add(self._established)
        self._peers.on_moved.add(self.outside.tell)
        endpoint.on_seen.add(self.outside.saw)
        endpoint.on_let_go.add(self._let_go)
        paths.carry = self._carriers.carry

    @cached_property
    def _rng(self) -> random.Random:
        # Separate from the endpoint's generator, so that the endpoint's numbers stay the same; it only spreads load.
        return random.Random(int.from_bytes(self._own_id))

    def _let_go(self, public: bytes) -> None:
        """Delete the state of a peer that was silent for long and has no session."""
        self._known.forget(public)
        self.outside.forget(public)
        self.ways.forget(public)

    # -- finding a path ---------------------------------------------------------------------------------------------

    async def _find(self, opening: Opening) -> None:
        """Help an outgoing handshake that got no early answer."""
        attempt = _Attempt(opening.peer, node_id(opening.peer.public), opening)
        if not self._helpers(attempt):
            return
        since, now = opening.started_at, self._clock.seconds()
        self._peers.hold(opening, now + ASKED_S + CARRIED_AT)
        self._chores.later(max(0.0, since + CARRIED_AT - now), self._send_by_relay, opening)
        await self._ask_helpers(attempt)
        if not attempt.helpful and self._is_pending(opening):
            await self._ask_helpers(attempt)  # other helpers, or the ones that the first named
        if not self._is_pending(opening):
            return
        if not attempt.helpful:
            self._peers.hold(opening, 0.0)
            return
        self._peers.hold(opening, since + HELD_S)
        if not attempt.candidates or self._clock.seconds() > since + CARRIED_AT:
            self._send_by_relay(opening)
        await self._chores.sleep(max(0.0, since + FRESH_AT - self._clock.seconds()))
        await self._punch_from_new_port(attempt, AT_ONCE)

    async def _upgrade(self, peer: Peer, step: int) -> None:
        """Try a direct path to a relayed peer."""
        attempt = _Attempt(peer, node_id(peer.public))
        if peer.opening is None:
            await self._ask_helpers(attempt)
        candidates = list(attempt.candidates)
        session = peer.session
        if not candidates or session is None or not is_relayed(session.contact.address) or peer.opening is not None:
            return
        if self._start_punching(peer.public, candidates, 0, UPGRADING_S):
            attempt.opening = peer.opening
            await self._chores.sleep(FRESH_AT)
            await self._punch_from_new_port(attempt, ORDERS[step % len(ORDERS)])

    async def _ask_helpers(self, attempt: _Attempt) -> None:
        """Request introductions from some helpers, and send INITs to the addresses in the first answers."""
        helpers = self._helpers(attempt)
        attempt.asked |= {helper.public for helper in helpers}

        async def ask(helper: Contact) -> bool:
            found = await self._request_introduction(attempt, helper, self._own_candidates(helper), USUAL)
            self._punch_at(attempt, found)
            return bool(attempt.helpful)

        await until(lambda results: any(results), [ask(helper) for helper in helpers])

    def _helpers(self, attempt: _Attempt) -> list[Contact]:
        return self.acquaintances.helpers(attempt.node_id, attempt.hinted, attempt.asked)

    async def _punch_from_new_port(self, attempt: _Attempt, order: int) -> None:
        """Retry from an additional local port, because early INITs of the other side may have spoilt the usual one."""
        opening = attempt.opening
        if opening is None or not self._is_pending(opening) or not attempt.helpful:
            return
        helper = attempt.helpful[0]
        session = self._peers.direct_session(helper.public)
        port = self._open_port() if session is not None else 0
        if session is None or not port:
            return
        wait = WE_WAIT.get(order, 0.0)
        self._peers.hold(opening, max(opening.held_until, self._clock.seconds() + 2 * ASKED_S + wait + UPGRADING_S))
        seen = await self.mirror.look(session, port)
        if seen is None or not self._is_pending(opening):
            return
        own = [seen, self._paths.local(helper.address, port)]
        found = await self._request_introduction(attempt, helper, own, order)
        if wait:
            await self._chores.sleep(wait)
        self._assign_port(attempt.peer, found, port)
        self._punch_at(attempt, found)

    def _punch_at(self, attempt: _Attempt, found: list[Address]) -> None:
        if found and attempt.opening is not None:
            self.ways.introduced(attempt.peer.public)
            self._peers.knock_at(attempt.opening, found)

    async def _request_introduction(
        self, attempt: _Attempt, helper: Contact, own: list[Address], order: int
    ) -> list[Address]:
        """Request an introduction from ``helper``, which sends ``own`` to the peer; return the peer's addresses."""
        answer = await self._endpoint.ask(
            helper, "reach.introduce", attempt.node_id, packed(own), order, timeout=ASKED_S, changes=True
        )
        if not (isinstance(answer, list) and len(answer) == 3):
            return []
        fields, carriers, may_carry = answer
        found = [address for address in unpacked(fields) if self._is_usable(address)]
        attempt.helpful.append(helper)
        attempt.candidates.update(dict.fromkeys(found))
        if may_carry is True and not is_relayed(helper.address):
            self._carriers.note(attempt.node_id, helper.public)
        for each in carriers[:MAX_CARRIERS] if isinstance(carriers, list) else ():
            contact = contact_in(each)
            if contact is not None:
                attempt.hinted.append(contact)
        return found

    def _send_by_relay(self, opening: Opening) -> None:
        """Send a handshake through a relay too, if there is one."""
        peer_id = node_id(opening.peer.public)
        if self._is_pending(opening) and self._carriers.session(peer_id) is not None:
            self._peers.knock_at(opening, [relayed(peer_id)])

    def _start_punching(self, public: bytes, candidates: list[Address], port: int, seconds: float) -> bool:
        """Send INITs to the addresses of a peer from a local port; return whether that started."""
        try:
            peer = self._peers.peer(Contact(public, candidates[0]))
        except ValueError:
            return False
        if port:
            self._assign_port(peer, candidates, port)
        if peer.opening is None and not self._peers.open(peer, candidates[0], is_wanted=False):
            return False
        self.ways.introduced(public)
        opening = peer.opening
        if opening is not None:
            self._peers.hold(opening, max(opening.held_until, self._clock.seconds() + seconds))
            self._peers.knock_at(opening, candidates)
        return True

    def _assign_port(self, peer: Peer, addresses: Iterable[Address], port: int) -> None:
        """Assign a local port to these addresses of a peer, except one with a working session."""
        session, before = peer.session, self._clock.seconds() - WELL_S
        used = session.contact.address if session is not None and session.heard_at > before else None
        for address in addresses:
            if address != used:
                self._paths.lead(address, port)

    # -- requests of peers ------------------------------------------------------------------------------------------

    async def _answer_meet(self, peer: Contact, public: bytes, candidates: list[object], order: int) -> list[object]:
        """REACH.MEET: send INITs to the candidates of ``public``, introduced by ``peer``; return this node's."""
        if not self._allowance.may_meet(peer.public):
            raise Refused("too many introductions to nodes that do not answer")
        found = [address for address in unpacked(candidates) if self._is_usable(address)]
        wanted_id = node_id(public)
        if wanted_id == self._own_id:
            raise Refused("the peer to meet is this node itself")
        self._known.note(public)
        self._allowance.introduced(public, peer.public)
        if not is_relayed(peer.address):
            self._carriers.note(wanted_id, peer.public)
        self._upgrades.put_off(public, self._clock.seconds())
        port, own = 0, self._own_candidates(peer)
        session = self._peers.direct_session(peer.public)
        if order != USUAL and session is not None and (additional := self._open_port()):
            seen = await self.mirror.look(session, additional)
            if seen is not None:
                port, own = additional, [seen, self._paths.local(peer.address, additional)]
        if found:
            # The other peer gets our addresses later, through the introducer: both must send at the same time, because
            # an INIT that arrives too early may spoil the port of a router.
            wait = (self._endpoint.round_trip(peer) or 0.0) + THEY_WAIT.get(order, 0.0)
            self._chores.later(wait, self._start_punching, public, found, port, HELD_S)
        return [packed(own), bool(port)]

    # -- maintenance ------------------------------------------------------------------------------------------------

    def _open_again(self, teller: Contact) -> None:
        """Reopen the sessions through NAT mappings, and soon retry direct paths."""
        now = self._clock.seconds()
        if now - self._opened_at < OPENED_GAP:
            return
        self._opened_at = now
        self.ways.open_again(teller.public)
        self._upgrades.hurry(now)

    def _established(self, session: Session) -> None:
        public, now = session.contact.public, self._clock.seconds()
        self._known.note(public)
        self.ways.established(session)
        self._allowance.met(public)
        if is_relayed(session.contact.address):
            if self._peers.session(public) is session:
                self._upgrades.add(public, self._own_id > session.contact.node_id, now)
        else:
            self._upgrades.drop(public)
        self._schedule_tick()

    def _schedule_tick(self) -> None:
        """Schedule the next maintenance, if there is something to maintain."""
        if not self._is_ticking and (self._upgrades or self.ways.has_holes or self._ports):
            self._is_ticking = True
            self._chores.later(TICK, self._tick)

    def _tick(self) -> None:
        now = self._clock.seconds()
        self._ports.shut_unused(now)
        for peer, step in self._upgrades.due(now):
            self._chores.fork(self._upgrade(peer, step))
        self.outside.show(now)
        self._is_ticking = False
        self._schedule_tick()

    # -- helpers ----------------------------------------------------------------------------------------------------

    def _is_usable(self, address: Address) -> bool:
        return is_possible(address) and (not is_loopback(address.host) or is_loopback(self._paths.local(address).host))

    def _is_pending(self, opening: Opening) -> bool:
        return opening.peer.opening is opening

    def _own_candidates(self, helper: Contact) -> list[Address]:
        """Return this machine's addresses, first the source address of datagrams to ``helper``."""
        first = self._paths.local(helper.address)
        others = [Address(host, self._paths.address.port) for host in self._paths.hosts()]
        return list(dict.fromkeys([first, *others]))[: MAX_CANDIDATES - 1]

    def _open_port(self) -> int:
        """Open an additional local port and return it; 0 if there are too many."""
        port = self._ports.open()
        self._schedule_tick()
        return port
