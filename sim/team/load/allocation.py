"""Run the auction of one task: its bidders, their decisions, and the holder of its lease.

Bidders act like agents (``agents.engagement``) whose robots never move. The agent that wins by the announced bids
claims the lease, and the next two agents are standbys. A holder that no longer wins releases the lease.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass

from twisted.internet.interfaces import IReactorTime

from middleware.consensus.bidding.auction import Auction
from middleware.consensus.bidding.auction_service import Bidding
from middleware.consensus.lease.lease_client import LeaseClient
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import Report
from middleware.entangled.errors import EntangledError
from middleware.tasks.task import Task
from sim.team.load.bidding_agents import BiddingAgent, BiddingAgents

STANDBYS = 2
"""Number of standbys, as in a team of agents."""
MAX_COST = 100.0
_NEAREST = Nearest()


@dataclass
class Bidder:
    """A bidder: its cost, the agent that it regards as assigned, and the time at which that agent last changed."""

    agent: BiddingAgent
    cost: float
    bidding: Bidding | None = None
    lease_client: LeaseClient | None = None
    assigned: str | None = None
    changed_at: float = math.inf


class TaskAllocation:
    """One task among the agents of ``places``, each at a random distance from its target.

    All agents bid within ``spread`` seconds. With ``claims`` the selected agents also claim the lease; otherwise the
    auction ends with the decision. ``began_at`` is the time of the first bid, ``held_at`` the time at which the lease
    was first held. ``overlaps`` counts leases won while another agent held the lease. ``start_failure`` is the reason
    why the auction did not start.
    """

    def __init__(
        self,
        task: Task,
        agents: BiddingAgents,
        places: Sequence[int],
        clock: IReactorTime,
        rng: random.Random,
        spread: float = 0.1,
        claims: bool = False,
    ) -> None:
        self.task = task
        self.began_at = math.inf
        self.held_at = math.inf
        self.overlaps = 0
        self.start_failure = ""
        self._agents = agents
        self._clock = clock
        self._rng = rng
        self._spread = spread
        self._claims = claims
        present = [agent for place in places if (agent := agents.get(place)) is not None]
        self.bidders = {agent.uuid: Bidder(agent, rng.uniform(1.0, MAX_COST)) for agent in present}

    async def begin(self) -> None:
        """Choose a council, and let all agents bid."""
        try:
            self.task = task = await next(iter(self.bidders.values())).agent.pin_council(self.task)
        except EntangledError as error:
            self.start_failure = str(error)
            return
        auction = Auction(task.task_id, 1, task.council, task.strategy, task.waiting_period, task.exclusive)
        for bidder in self.bidders.values():
            self._clock.callLater(self._rng.uniform(0.0, self._spread), self._bid, bidder, auction)

    @property
    def waiting_ends_at(self) -> float:
        """The end of the waiting period."""
        return self.began_at + self.task.waiting_period

    def list_present(self) -> list[Bidder]:
        """Return the bidders whose nodes are alive."""
        return [bidder for bidder in self.bidders.values() if self._agents.is_alive(bidder.agent)]

    def find_best(self) -> str | None:
        """Return the living agent with the lowest cost."""
        return min(((b.cost, b.agent.uuid) for b in self.list_present()), default=(0.0, None))[1]

    def find_holders(self) -> list[Bidder]:
        """Return the living agents that hold the lease by their own clocks; more than one is a violation (E2)."""
        return [b for b in self.list_present() if b.lease_client is not None and b.lease_client.lease is not None]

    def end(self) -> None:
        """Stop all bidding and release all leases."""
        for bidder in self.list_present():
            if bidder.bidding is not None:
                bidder.bidding.leave()
            if bidder.lease_client is not None:
                bidder.lease_client.release()
                bidder.lease_client = None

    # -- inside -----------------------------------------------------------------------------------------------------

    def _bid(self, bidder: Bidder, auction: Auction) -> None:
        if not self._agents.is_alive(bidder.agent):
            return
        self.began_at = min(self.began_at, self._clock.seconds())
        bidder.bidding = bidder.agent.join_auction(auction, lambda reports: self._on_reports(bidder, reports))
        bidder.bidding.report(Report(bidder.agent.uuid, bidder.cost))

    def _on_reports(self, bidder: Bidder, reports: tuple[Report, ...]) -> None:
        consensus = _NEAREST.find(reports)
        if consensus.assigned_agent != bidder.assigned:
            bidder.assigned, bidder.changed_at = consensus.assigned_agent, self._clock.seconds()
        if self._claims:
            self._claim_or_wait(bidder, (consensus.assigned_agent, *consensus.standby))

    def _claim_or_wait(self, bidder: Bidder, order: Sequence[str | None]) -> None:
        uuid = bidder.agent.uuid
        rank = order.index(uuid) if uuid in order else STANDBYS + 1
        if rank > STANDBYS:
            if bidder.lease_client is not None:
                bidder.lease_client.release()
            return
        if bidder.lease_client is None:
            bidder.lease_client = bidder.agent.make_lease_client(self.task, lambda: self._on_lease_change(bidder))
        if rank == 0:
            bidder.lease_client.claim()
        elif bidder.lease_client.lease is not None:
            bidder.lease_client.release()
        else:
            bidder.lease_client.stand_by(rank)

    def _on_lease_change(self, bidder: Bidder) -> None:
        if bidder.lease_client is None or bidder.lease_client.lease is None:
            return
        others = [one for one in self.find_holders() if one is not bidder]
        self.overlaps += len(others)
        self.held_at = min(self.held_at, self._clock.seconds())
