"""Bid and claim leases for the agent of each place, for both kinds of nodes.

A swarm node contains the services for bidding and leases; a bare node of the library gets the same services, connected
in the same way. An auction among ten thousand nodes can therefore be measured with complete swarm nodes or with bare
nodes.
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
from middleware.consensus.bidding.auction_service import AuctionService, Bidding, Environment
from middleware.consensus.bidding.participant import OnSummary
from middleware.consensus.bidding.path_choice import estimate_team_size
from middleware.consensus.lease.lease_client import LeaseClient
from middleware.consensus.strategy import load_strategy
from middleware.entangled.contact import Contact
from middleware.entangled.errors import Refused
from middleware.entangled.node import EntangledNode
from middleware.entangled.wire.endpoint import Endpoint
from middleware.node import LEASE_VERBS, SwarmNode
from middleware.tasks.council_manager import CouncilManager
from middleware.tasks.task import Task
from sim.team.team import Node, Team, get_entangled

BID_PREFIX, SEARCHED_BYTES = b"bid.", 64
"""The prefix of the methods for bids, and the number of bytes of a message that are searched for this prefix."""


class CountingEndpoint:
    """A ``RequestSender`` over ``endpoint`` that counts the datagrams of bidding, ``sent`` and ``received``.

    Nodes also send heartbeats, pings and answers, often at the same times, so the total traffic does not show the cost
    of an auction.
    """

    def __init__(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint
        self.sent = self.received = self.bytes = 0
        # Only the endpoint's request table counts the retransmissions.
        requester = endpoint._requester
        requester._send = self._make_counting_send(requester._send)

    @property
    def handled_count(self) -> int:
        """The number of datagrams sent and received."""
        return self.sent + self.received

    def ask(
        self, contact: Contact, method: str, *arguments: object, timeout: float | None = None, changes: bool = False
    ) -> Deferred[Any]:
        """Send a request; its answer is counted as a datagram."""
        asked = self._endpoint.ask(contact, method, *arguments, timeout=timeout, changes=changes)
        return asked.addCallbacks(self._count_answer, self._count_refusal)

    def notify(self, contact: Contact, method: str, *arguments: object) -> None:
        """Send a notification."""
        self._endpoint.notify(contact, method, *arguments)

    def count_request(self, is_answered: bool = True) -> None:
        """Count a received request, each time it arrives, and its answer."""
        self.received += 1
        self.sent += is_answered

    def _count_answer(self, answer: Any) -> Any:
        self.received += 1
        return answer

    def _count_refusal(self, failure: Failure) -> Failure:
        self.received += failure.check(Refused) is not None
        return failure

    def _make_counting_send(self, send: Callable[..., None]) -> Callable[..., None]:
        def counted(session: Any, message: bytes) -> None:
            if BID_PREFIX in message[:SEARCHED_BYTES]:
                self.sent += 1
                self.bytes += len(message)
            send(session, message)

        return counted


class BiddingServices:
    """The services that let a bare node bid, relay bids, and be a council member."""

    def __init__(self, node: EntangledNode, tally: CountingEndpoint, clock: IReactorTime, rng: random.Random) -> None:
        self._node = node
        self._counter = tally
        self._clock = clock
        self._rng = rng
        self._born_at = clock.seconds()
        self._stop_calls: list[Callable[[], None]] = []
        for verb in LEASE_VERBS:
            answer = partial(self._answer_lease, f"lease.{verb}")
            node.endpoint.expose(f"lease.{verb}", answer, changes=True, idempotent=True)

    @cached_property
    def council_manager(self) -> CouncilManager:
        """The councils of tasks, like ``SwarmNode.council_manager``; a reconfiguration is not recorded."""
        seen = self._node.store, self._clock, self._rng, self._born_at
        return CouncilManager(self._node, *seen, on_change=lambda task: None, may_be_member=lambda public: True)

    @cached_property
    def auction_service(self) -> AuctionService:
        """The auctions of the node, like ``SwarmNode.auction_service``."""
        node = self._node

        def size() -> int:
            return estimate_team_size(node.identity.node_id, node.overlay.contacts(), node.overlay.is_large)

        around = Environment(lambda: node.contact, node.overlay.contacts, size, load_strategy)
        auctions = AuctionService(node.identity, self._counter, around, self._clock, self._rng)
        self._stop_calls.append(auctions.stop)
        return auctions

    def stop(self) -> None:
        """Stop the services after the node's end."""
        for end in self._stop_calls:
            end()

    def _answer_lease(self, method: str, peer: Contact, *arguments: Any) -> object:
        return self.council_manager.lease_service.answer(method, peer, arguments)


class BiddingAgent:
    """The bidding and claiming part of the agent at one place, for one ``node``; ``counter`` counts datagrams."""

    def __init__(self, place: int, node: Node, clock: IReactorTime, rng: random.Random) -> None:
        self.place = place
        self.node = node
        bare = get_entangled(node)
        self.uuid = bare.identity.node_id.hex()
        self.counter = CountingEndpoint(bare.endpoint)
        self._services: BiddingServices | SwarmNode = (
            node if isinstance(node, SwarmNode) else BiddingServices(node, self.counter, clock, rng)
        )
        # The methods are exposed as in a swarm node, but counted; all are idempotent, so each arrival is answered.
        expose = bare.endpoint.expose
        expose("bid.offer", self._answer_offer, changes=True, idempotent=True)
        expose("bid.announce", self._answer_announcement, changes=True, idempotent=True)
        expose("bid.cry", self._take_flooded_bids, changes=True)

    def join_auction(self, auction: Auction, on_summary: OnSummary) -> Bidding:
        """Take part in ``auction``."""
        return self._dissemination.take_part(auction, on_summary)

    def make_lease_client(self, task: Task, changed: Callable[[], None]) -> LeaseClient:
        """Return the lease client for ``task``."""
        return self._services.council_manager.make_lease_client(task, changed, 0)

    async def pin_council(self, task: Task) -> Task:
        """Return the new ``task`` with a council."""
        return await self._services.council_manager.choose_council(task)

    def stop(self) -> None:
        """Stop the services of a bare node after its end; a swarm node stops its own services."""
        if isinstance(self._services, BiddingServices):
            self._services.stop()

    @cached_property
    def _dissemination(self) -> AuctionService:
        auctions = self._services.auction_service
        auctions._endpoint = self.counter
        return auctions

    def _answer_offer(
        self, peer: Contact, auction: list[object], bids: list[object], age_ms: int, is_shared: bool
    ) -> list[object] | None:
        self.counter.count_request()
        return self._dissemination.answer_offer(peer, auction, bids, age_ms, is_shared)

    def _answer_announcement(self, peer: Contact, auction: list[object], announcement: list[object]) -> None:
        self.counter.count_request()
        self._dissemination.answer_announcement(peer, auction, announcement)

    def _take_flooded_bids(self, peer: Contact, auction: list[object], bids: list[object]) -> None:
        self.counter.count_request(is_answered=False)
        self._dissemination.answer_flood(peer, auction, bids)


class BiddingAgents:
    """The agents of a team (``get_bidding_agents``); an agent is created when its node starts."""

    def __init__(self, team: Team) -> None:
        self._clock = team.clock
        self._rng = team.make_rng
        self._present: dict[int, BiddingAgent] = {}
        self._lives = 0
        team.watch_lives(self._on_birth, self._on_death)

    def get(self, place: int) -> BiddingAgent | None:
        """Return the agent of a place; None if its node is not alive."""
        return self._present.get(place)

    def list_present(self) -> list[BiddingAgent]:
        """Return the agents of living nodes, by place."""
        return [self._present[place] for place in sorted(self._present)]

    def is_alive(self, agent: BiddingAgent) -> bool:
        """Return whether the node of the agent still lives."""
        return self._present.get(agent.place) is agent

    def _on_birth(self, place: int, node: Node) -> None:
        self._lives += 1
        rng = self._rng(f"rooms/{place}/{self._lives}")
        self._present[place] = BiddingAgent(place, node, self._clock, rng)

    def _on_death(self, place: int, node: Node) -> None:
        agent = self._present.get(place)
        if agent is not None and agent.node is node:
            del self._present[place]
            agent.stop()


_AGENTS_BY_TEAM: WeakKeyDictionary[Team, BiddingAgents] = WeakKeyDictionary()


def get_bidding_agents(team: Team) -> BiddingAgents:
    """Return the agents of ``team``, which all workloads share, because a node has only one handler for bids."""
    known = _AGENTS_BY_TEAM.get(team)
    if known is None:
        known = _AGENTS_BY_TEAM[team] = BiddingAgents(team)
    return known
