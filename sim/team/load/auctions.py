"""Workload: auctions of one task at a time among all agents; measures time to agreement, and messages.

Times are measured from the end of the waiting period, which starts with the first bid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta
from twisted.internet.defer import Deferred

from formats.convert import Unit
from middleware.tasks.task import Task
from sim.team.load.allocation import TaskAllocation
from sim.team.load.bidding_agents import BiddingAgent, get_bidding_agents
from sim.team.load.client_workload import ClientWorkload
from sim.team.metric import Metric, make_percentiles, make_share, mean
from sim.team.team import Team


@dataclass(frozen=True)
class AuctionSettings:
    """``[load.auctions]``: tasks for which all agents bid, one after the other."""

    count: Annotated[int, Meta(ge=1, le=10_000)] = 3
    """Total number of auctions."""

    every: Annotated[float, Meta(ge=2.0, le=3600.0), Unit("seconds")] = 10.0
    """Seconds between the starts of two auctions."""

    waiting: Annotated[float, Meta(ge=0.0, le=60.0), Unit("seconds")] = 0.5
    """Waiting period for bids after the first one, in seconds."""

    spread: Annotated[float, Meta(ge=0.0, le=60.0), Unit("seconds")] = 0.1
    """Seconds within which all agents bid."""


class Auctions(ClientWorkload):
    """The workload ``auctions``."""

    def __init__(self, team: Team, settings: AuctionSettings) -> None:
        super().__init__(team, "auctions")
        self._settings = settings
        self._agents = get_bidding_agents(team)
        self._allocation: TaskAllocation | None = None
        self._begun = 0
        self._before: dict[int, tuple[int, int, int]] = {}
        self._next_at = -math.inf
        self.right_shares: list[float] = []
        self.agreement_times: list[float] = []
        self.last_agreement_times: list[float] = []
        self.messages: list[float] = []
        self.busiest: list[float] = []
        self.bytes: list[float] = []
        self.start_failures: list[str] = []

    def step(self) -> None:
        """Evaluate an auction at its end, and start the next one."""
        now = self._clock.seconds()
        if now >= self._next_at:
            self._evaluate_auction()
            if self._begun < self._settings.count:
                self._start_auction()
            self._next_at = now + self._settings.every

    def make_final_requests(self) -> None:
        """Evaluate the last auction."""
        self._evaluate_auction()

    def find_violations(self) -> list[str]:
        """Return the auctions that could not start."""
        return self.start_failures

    def collect_metrics(self) -> list[Metric]:
        """Return the share of agents that decided correctly, their times to decide, and the number of messages."""
        n = len(self.right_shares)
        return [
            Metric("auctions.right", mean(self.right_shares), "share", n=n),
            make_share("auctions.unanimous", sum(part == 1.0 for part in self.right_shares), n),
            *make_percentiles("auctions.agree", self.agreement_times, "s", (0.5, 0.95, 0.99)),
            Metric("auctions.last", mean(self.last_agreement_times), "s", n=n),
            Metric("auctions.messages", mean(self.messages), "datagrams a node", n=n),
            Metric("auctions.bytes", mean(self.bytes), "B a node in questions", n=n),
            Metric("auctions.busiest", max(self.busiest, default=None), "datagrams", n=n),
        ]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _start_auction(self) -> None:
        self._begun += 1
        self._before = {agent.place: _read_counts(agent) for agent in self._agents.list_present()}
        task = Task(f"auction {self._begun}", "none", "nothing", waiting_period=self._settings.waiting)
        rng = self._team.make_rng(f"auction/{self._begun}")
        places = self._joined.list_places()
        rng.shuffle(places)  # the first agent requests the council
        allocation = TaskAllocation(task, self._agents, places, self._clock, rng, self._settings.spread)
        self._allocation = allocation
        Deferred.fromCoroutine(allocation.begin())

    def _evaluate_auction(self) -> None:
        allocation, self._allocation = self._allocation, None
        if allocation is None:
            return
        if allocation.start_failure:
            self.start_failures.append(f"{allocation.task.task_id} did not begin: {allocation.start_failure}")
            return
        present, best = allocation.list_present(), allocation.find_best()
        traffic = [self._traffic_since_start(agent) for agent in self._agents.list_present()]
        n = max(1, len(present))
        self.messages.append(sum(sent for sent, _, _ in traffic) / n)
        self.busiest.append(max((handled for _, handled, _ in traffic), default=0))
        self.bytes.append(sum(volume for _, _, volume in traffic) / n)
        right = [bidder for bidder in present if bidder.assigned == best]
        delays = [max(0.0, bidder.changed_at - allocation.waiting_ends_at) for bidder in right]
        self.right_shares.append(len(right) / n)
        self.agreement_times += delays
        self.last_agreement_times.append(max(delays) if len(right) == len(present) and delays else math.inf)
        allocation.end()

    def _traffic_since_start(self, agent: BiddingAgent) -> tuple[int, int, int]:
        """Return a node's sent and handled datagrams, and its bytes of requests, since the auction started."""
        sent, handled, volume = self._before.get(agent.place, (0, 0, 0))
        now_sent, now_handled, now_volume = _read_counts(agent)
        if now_handled < handled:  # the node was restarted
            return now_sent, now_handled, now_volume
        return now_sent - sent, now_handled - handled, now_volume - volume


def _read_counts(agent: BiddingAgent) -> tuple[int, int, int]:
    return agent.counter.sent, agent.counter.handled_count, agent.counter.bytes
