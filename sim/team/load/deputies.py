"""Deputies: what bids for the agent of each place and claims in its name, whichever kind its node is.

A swarm node has these rooms; beside a bare node of the library they are the same ones, wired in the same way.  So an
auction among ten thousand can be measured with what surrounds it in a team, or without.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import cached_property, partial
from typing import Any
from weakref import WeakKeyDictionary

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.python.failure import Failure

from middleware.consensus.bidding.auction import Auction
from middleware.consensus.bidding.auctions import Bidding, Dissemination, Surroundings
from middleware.consensus.bidding.party import OnSummary
from middleware.consensus.bidding.scale import team_size
from middleware.consensus.lease.lessee import Lessee
from middleware.consensus.strategy import strategy_for
from middleware.entangled.contact import Contact
from middleware.entangled.errors import Refused
from middleware.entangled.node import EntangledNode
from middleware.entangled.wire.endpoint import Endpoint
from middleware.node import LEASE_VERBS, SwarmNode
from middleware.tasks.councils import Councils
from middleware.tasks.task import Task
from sim.team.team import Node, Team, core

MARK, HEAD = b"bid.", 64
"""What the name of a method that carries bids begins with, and in how many bytes of a message it stands."""


class Tally:
    """A ``dissemination.Wire`` over ``endpoint`` that counts what passes; ``sent`` and ``received`` are datagrams.

    Nodes beat, ping and answer all the time, often in step, so what an auction costs does not show in what is sent in
    all.
    """

    def __init__(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint
        self.sent = self.received = self.bytes = 0
        # A question goes out as often as it takes; how often only the asker below knows.
        asker = endpoint._asker
        asker._send = self._counted(asker._send)

    @property
    def handled(self) -> int:
        """Datagrams sent and received."""
        return self.sent + self.received

    def ask(
        self, contact: Contact, method: str, *arguments: object, timeout: float | None = None, changes: bool = False
    ) -> Deferred[Any]:
        """Ask a peer; its answer is one more datagram."""
        asked = self._endpoint.ask(contact, method, *arguments, timeout=timeout, changes=changes)
        return asked.addCallbacks(self._answered, self._refused)

    def tell(self, contact: Contact, method: str, *arguments: object) -> None:
        """Tell a peer."""
        self._endpoint.tell(contact, method, *arguments)

    def asked(self, is_answered: bool = True) -> None:
        """Take note of a question, which comes as often as it arrives, and of its answer."""
        self.received += 1
        self.sent += is_answered

    def _answered(self, answer: Any) -> Any:
        self.received += 1
        return answer

    def _refused(self, failure: Failure) -> Failure:
        self.received += failure.check(Refused) is not None
        return failure

    def _counted(self, send: Callable[..., None]) -> Callable[..., None]:
        def counted(session: Any, message: bytes) -> None:
            if MARK in message[:HEAD]:
                self.sent += 1
                self.bytes += len(message)
            send(session, message)

        return counted


class Rooms:
    """The rooms beside a bare node that let it bid, carry bids, and sit in councils."""

    def __init__(self, node: EntangledNode, tally: Tally, clock: IReactorTime, rng: random.Random) -> None:
        self._node = node
        self._tally = tally
        self._clock = clock
        self._rng = rng
        self._born_at = clock.seconds()
        self._ends: list[Callable[[], None]] = []
        for verb in LEASE_VERBS:
            answer = partial(self._answer_lease, f"lease.{verb}")
            node.endpoint.expose(f"lease.{verb}", answer, changes=True, idempotent=True)

    @cached_property
    def councils(self) -> Councils:
        """The councils of tasks, as ``SwarmNode.councils``; nobody writes down where one moves to."""
        seen = self._node.store, self._clock, self._rng, self._born_at
        return Councils(self._node, *seen, moved=lambda task: None, may_sit=lambda public: True)

    @cached_property
    def dissemination(self) -> Dissemination:
        """How bids travel through the node, as ``SwarmNode.dissemination``."""
        node = self._node

        def size() -> int:
            return team_size(node.identity.node_id, node.overlay.contacts(), node.overlay.is_large)

        around = Surroundings(lambda: node.contact, node.overlay.contacts, size, strategy_for)
        dissemination = Dissemination(node.identity, self._tally, around, self._clock, self._rng)
        self._ends.append(dissemination.stop)
        return dissemination

    def stop(self) -> None:
        """The node is gone."""
        for end in self._ends:
            end()

    def _answer_lease(self, method: str, peer: Contact, *arguments: Any) -> object:
        return self.councils.desk.answer(method, peer, arguments)


class Deputy:
    """One place's agent, as far as bidding and claiming goes, for one life of its ``node``; ``tally`` counts."""

    def __init__(self, place: int, node: Node, clock: IReactorTime, rng: random.Random) -> None:
        self.place = place
        self.node = node
        bare = core(node)
        self.uuid = bare.identity.node_id.hex()
        self.tally = Tally(bare.endpoint)
        self._rooms: Rooms | SwarmNode = node if isinstance(node, SwarmNode) else Rooms(node, self.tally, clock, rng)
        # As a swarm node exposes them, and counted; each of them may run again, so each that comes is answered.
        expose = bare.endpoint.expose
        expose("bid.offer", self._answer_offer, changes=True, idempotent=True)
        expose("bid.announce", self._answer_announcement, changes=True, idempotent=True)
        expose("bid.cry", self._take_cry, changes=True)

    def bidding(self, auction: Auction, on_summary: OnSummary) -> Bidding:
        """Take part in ``auction``."""
        return self._dissemination.enter(auction, on_summary)

    def lessee(self, task: Task, changed: Callable[[], None]) -> Lessee:
        """The claimant of the right to act on ``task``."""
        return self._rooms.councils.lessee(task, changed, 0)

    async def pinned(self, task: Task) -> Task:
        """A new ``task`` with its council."""
        return await self._rooms.councils.pinned(task)

    def stop(self) -> None:
        """Its node is gone; a swarm node has stopped its rooms itself."""
        if isinstance(self._rooms, Rooms):
            self._rooms.stop()

    @cached_property
    def _dissemination(self) -> Dissemination:
        dissemination = self._rooms.dissemination
        dissemination._wire = self.tally
        return dissemination

    def _answer_offer(
        self, peer: Contact, auction: list[object], bids: list[object], age_ms: int, is_shared: bool
    ) -> list[object] | None:
        self.tally.asked()
        return self._dissemination.answer_offer(peer, auction, bids, age_ms, is_shared)

    def _answer_announcement(self, peer: Contact, auction: list[object], announcement: list[object]) -> None:
        self.tally.asked()
        self._dissemination.answer_announcement(peer, auction, announcement)

    def _take_cry(self, peer: Contact, auction: list[object], bids: list[object]) -> None:
        self.tally.asked(is_answered=False)
        self._dissemination.take_cry(peer, auction, bids)


class Deputies:
    """Made once a team (``deputies_of``): bare nodes are given the rooms in which bids are carried as they are born."""

    def __init__(self, team: Team) -> None:
        self._clock = team.clock
        self._rng = team.generator
        self._present: dict[int, Deputy] = {}
        self._lives = 0
        team.attend(self._born, self._died)

    def of(self, place: int) -> Deputy | None:
        """The deputy of a place; None where its node does not live."""
        return self._present.get(place)

    def present(self) -> list[Deputy]:
        """Those whose nodes live, by place."""
        return [self._present[place] for place in sorted(self._present)]

    def lives(self, deputy: Deputy) -> bool:
        """Whether its node goes on."""
        return self._present.get(deputy.place) is deputy

    def _born(self, place: int, node: Node) -> None:
        self._lives += 1
        dice = self._rng(f"rooms/{place}/{self._lives}")
        self._present[place] = Deputy(place, node, self._clock, dice)

    def _died(self, place: int, node: Node) -> None:
        deputy = self._present.get(place)
        if deputy is not None and deputy.node is node:
            del self._present[place]
            deputy.stop()


_KNOWN: WeakKeyDictionary[Team, Deputies] = WeakKeyDictionary()


def deputies_of(team: Team) -> Deputies:
    """The deputies of ``team``, the same for all workloads: a node has one place for bids only."""
    known = _KNOWN.get(team)
    if known is None:
        known = _KNOWN[team] = Deputies(team)
    return known
