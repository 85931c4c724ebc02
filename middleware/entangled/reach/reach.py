"""Reach: paths to peers that do not answer where others see them.

Routers that translate addresses let in only what was asked for from inside.  So two nodes behind such routers are
*introduced* by a third that both speak with: it tells each where it sees the other, and both knock at the same time;
their INITs open the routers for each other.  Where that is not enough, they knock again from fresh local ports, and in
the end the third *carries* for them (``relay``), while they try again now and then.

A peer that answers at once, and one in this node's own network, never sees any of this.
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
"""Seconds after its beginning from which a handshake is tried from a fresh local port, too."""
CARRIED_AT = 0.9
"""Seconds after its beginning from which a handshake goes by those who carry, too: most direct ways are found by then,
and what is asked with the usual patience of 1.5 s is answered yet."""
WELL_S = 3.0
"""Seconds since a peer was heard for which its way is left alone."""
AT_ONCE = 1
WE_WAIT = {3: 0.15, 5: 0.7}
THEY_WAIT = {2: 0.15, 4: 0.7}
ORDERS = (2, 3, 4, 5, AT_ONCE)
"""In which order two knock: at their usual ports; or at fresh ones, at the same time or one some seconds after the
other.  A knock that comes too early spoils some routers' ports, and does no harm to others; nobody knows which."""
UPGRADING_S = 1.2
TICK = 1.0
OPENED_GAP = 2.0
"""Seconds at least between two times at which sessions are opened anew since this node's address changed."""


@dataclass(slots=True)
class _Attempt:
    """What is done to find one peer: who was asked, who knows it, and which others they named."""

    peer: Peer
    node_id: bytes
    opening: Opening | None = None
    asked: set[bytes] = field(default_factory=set)
    helpful: list[Contact] = field(default_factory=list)
    hinted: list[Contact] = field(default_factory=list)
    candidates: dict[Address, None] = field(default_factory=dict)


class Reach:
    """Finds ways to peers, by introductions and by those who carry, and keeps them up, for one node.

    ``contacts`` gives the peers that are known.
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
        # Run once for each question, however often it is repeated: each run would open another port.
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
        # Dice of its own: they only spread the load, and the endpoint's shall fall as they would without it.
        return random.Random(int.from_bytes(self._own_id))

    def _let_go(self, public: bytes) -> None:
        """Forget a peer that was silent for long, and with which there is no session."""
        self._known.forget(public)
        self.outside.forget(public)
        self.ways.forget(public)

    # -- finding a way ----------------------------------------------------------------------------------------------

    async def _find(self, opening: Opening) -> None:
        """Help a handshake of ours that was not answered at first."""
        attempt = _Attempt(opening.peer, node_id(opening.peer.public), opening)
        if not self._helpers(attempt):
            return
        since, now = opening.started_at, self._clock.seconds()
        self._peers.hold(opening, now + ASKED_S + CARRIED_AT)
        self._chores.later(max(0.0, since + CARRIED_AT - now), self._have_carried, opening)
        await self._ask_around(attempt)
        if not attempt.helpful and self._is_pending(opening):
            await self._ask_around(attempt)  # others, or those that the first ones named
        if not self._is_pending(opening):
            return
        if not attempt.helpful:
            self._peers.hold(opening, 0.0)
            return
        self._peers.hold(opening, since + HELD_S)
        if not attempt.candidates or self._clock.seconds() > since + CARRIED_AT:
            self._have_carried(opening)
        await self._chores.sleep(max(0.0, since + FRESH_AT - self._clock.seconds()))
        await self._knock_afresh(attempt, AT_ONCE)

    async def _upgrade(self, peer: Peer, step: int) -> None:
        """Try the direct way to a peer to whom others carry."""
        attempt = _Attempt(peer, node_id(peer.public))
        if peer.opening is None:
            await self._ask_around(attempt)
        candidates = list(attempt.candidates)
        session = peer.session
        if not candidates or session is None or not is_relayed(session.contact.address) or peer.opening is not None:
            return
        if self._knock(peer.public, candidates, 0, UPGRADING_S):
            attempt.opening = peer.opening
            await self._chores.sleep(FRESH_AT)
            await self._knock_afresh(attempt, ORDERS[step % len(ORDERS)])

    async def _ask_around(self, attempt: _Attempt) -> None:
        """Ask some helpers for an introduction, and knock where the first of them say."""
        helpers = self._helpers(attempt)
        attempt.asked |= {helper.public for helper in helpers}

        async def ask(helper: Contact) -> bool:
            found = await self._introduced(attempt, helper, self._own(helper), USUAL)
            self._knock_further(attempt, found)
            return bool(attempt.helpful)

        await until(lambda results: any(results), [ask(helper) for helper in helpers])

    def _helpers(self, attempt: _Attempt) -> list[Contact]:
        return self.acquaintances.helpers(attempt.node_id, attempt.hinted, attempt.asked)

    async def _knock_afresh(self, attempt: _Attempt, order: int) -> None:
        """Try again from a fresh local port: early knocks of the other side may have spoilt the first one."""
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
        found = await self._introduced(attempt, helper, own, order)
        if wait:
            await self._chores.sleep(wait)
        self._lead(attempt.peer, found, port)
        self._knock_further(attempt, found)

    def _knock_further(self, attempt: _Attempt, found: list[Address]) -> None:
        if found and attempt.opening is not None:
            self.ways.introduced(attempt.peer.public)
            self._peers.knock_at(attempt.opening, found)

    async def _introduced(self, attempt: _Attempt, helper: Contact, own: list[Address], order: int) -> list[Address]:
        """The addresses of the peer, as ``helper`` tells them after it told ours to the peer."""
        answer = await self._endpoint.ask(
            helper, "reach.introduce", attempt.node_id, packed(own), order, timeout=ASKED_S, changes=True
        )
        if not (isinstance(answer, list) and len(answer) == 3):
            return []
        fields, carriers, may_carry = answer
        found = [address for address in unpacked(fields) if self._is_worth(address)]
        attempt.helpful.append(helper)
        attempt.candidates.update(dict.fromkeys(found))
        if may_carry is True and not is_relayed(helper.address):
            self._carriers.note(attempt.node_id, helper.public)
        for each in carriers[:MAX_CARRIERS] if isinstance(carriers, list) else ():
            contact = contact_in(each)
            if contact is not None:
                attempt.hinted.append(contact)
        return found

    def _have_carried(self, opening: Opening) -> None:
        """Let those who carry to the peer carry a handshake, too."""
        peer_id = node_id(opening.peer.public)
        if self._is_pending(opening) and self._carriers.session(peer_id) is not None:
            self._peers.knock_at(opening, [relayed(peer_id)])

    def _knock(self, public: bytes, candidates: list[Address], port: int, seconds: float) -> bool:
        """Knock at the addresses of a peer by one of our ports; whether that could be begun."""
        try:
            peer = self._peers.peer(Contact(public, candidates[0]))
        except ValueError:
            return False
        if port:
            self._lead(peer, candidates, port)
        if peer.opening is None and not self._peers.open(peer, candidates[0], is_wanted=False):
            return False
        self.ways.introduced(public)
        opening = peer.opening
        if opening is not None:
            self._peers.hold(opening, max(opening.held_until, self._clock.seconds() + seconds))
            self._peers.knock_at(opening, candidates)
        return True

    def _lead(self, peer: Peer, addresses: Iterable[Address], port: int) -> None:
        """Write to these addresses of a peer by a port of ours, but for one by which it is well reached already."""
        session, before = peer.session, self._clock.seconds() - WELL_S
        used = session.contact.address if session is not None and session.heard_at > before else None
        for address in addresses:
            if address != used:
                self._paths.lead(address, port)

    # -- what others ask --------------------------------------------------------------------------------------------

    async def _answer_meet(self, peer: Contact, public: bytes, candidates: list[object], order: int) -> list[object]:
        """REACH.MEET: knock at the candidates of ``public``, whom ``peer`` introduces; gives the own ones."""
        if not self._allowance.may_meet(peer.public):
            raise Refused("too many introductions to who does not answer")
        found = [address for address in unpacked(candidates) if self._is_worth(address)]
        stranger = node_id(public)
        if stranger == self._own_id:
            raise Refused("that is this node itself")
        self._known.note(public)
        self._allowance.introduced(public, peer.public)
        if not is_relayed(peer.address):
            self._carriers.note(stranger, peer.public)
        self._upgrades.put_off(public, self._clock.seconds())
        port, own = 0, self._own(peer)
        session = self._peers.direct_session(peer.public)
        if order != USUAL and session is not None and (further := self._open_port()):
            seen = await self.mirror.look(session, further)
            if seen is not None:
                port, own = further, [seen, self._paths.local(peer.address, further)]
        if found:
            # The one who is to meet us hears of it later than who introduces us: both shall knock at the same time, for
            # a knock that comes too early may spoil the port that it comes to.
            wait = (self._endpoint.round_trip(peer) or 0.0) + THEY_WAIT.get(order, 0.0)
            self._chores.later(wait, self._knock, public, found, port, HELD_S)
        return [packed(own), bool(port)]

    # -- upkeep -----------------------------------------------------------------------------------------------------

    def _open_again(self, teller: Contact) -> None:
        """Open the ways through the own router anew, and try soon to do without those who carry."""
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
        self._wake()

    def _wake(self) -> None:
        """Go on with the upkeep as long as there is something to keep up."""
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
        self._wake()

    # -- small things -----------------------------------------------------------------------------------------------

    def _is_worth(self, address: Address) -> bool:
        return is_possible(address) and (not is_loopback(address.host) or is_loopback(self._paths.local(address).host))

    def _is_pending(self, opening: Opening) -> bool:
        return opening.peer.opening is opening

    def _own(self, helper: Contact) -> list[Address]:
        """The own addresses, as this machine knows them; first the one from which it writes to ``helper``."""
        first = self._paths.local(helper.address)
        others = [Address(host, self._paths.address.port) for host in self._paths.hosts()]
        return list(dict.fromkeys([first, *others]))[: MAX_CANDIDATES - 1]

    def _open_port(self) -> int:
        """A fresh local port; 0 where there are too many."""
        port = self._ports.open()
        self._wake()
        return port
