"""Measure all figures of a team of one size, one after the other.

Nodes adapt their timeouts to observed round-trip times, so the links of a team are not changed after its formation.
Three teams are measured. Bare nodes on internet links give cost and lookups. Bare nodes on fast links give auctions and
takeovers, whose targets are defined for such links. Complete nodes give the directory, because bare nodes have no
devices.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from sim.team.leases.radio_link import LinkQuality, RadioLink
from sim.team.link import LinkSettings
from sim.team.load.auctions import Auctions, AuctionSettings
from sim.team.load.bidding_agents import get_bidding_agents
from sim.team.load.directory import Directory, DirectorySettings
from sim.team.load.lookups import Lookups, LookupSettings
from sim.team.load.takeovers import Takeovers, TakeoverSettings
from sim.team.load.traffic import Traffic, TrafficSettings
from sim.team.metric import Metric
from sim.team.scenario import Join, Scenario
from sim.team.team import Team
from sim.team.workload import Workload

DELAY_S, JITTER_S = 0.02, 0.01
"""One-way delay in seconds of the link of ``docs/explanation/choosing-a-robot.md``, and the mean exponential jitter."""
STEP_S = 0.5
SLICE_S = 0.25
"""Seconds of the team's time between two calls of ``Watcher.is_stopped``."""
AWAY_S = 5.0
"""Seconds for which killed lease holders are away."""
VERSION = 2
"""Version of the measurements; changed when a figure changes its meaning."""


@dataclass(frozen=True)
class SurveySettings:
    """The parameters of the measurement; figures of different settings are not comparable."""

    seed: int = 1
    settle: float = 30.0
    """Seconds from the last join until the team is regarded as quiet."""
    quiet: float = 20.0
    """Seconds without requests in which traffic is counted."""
    lookups: float = 10.0
    """Duration of the lookups in seconds."""
    rate: float = 30.0
    """Lookups per second."""
    exact: int = 1000
    """Number of keys for which the lookup must be exact."""
    auctions: int = 3
    """Number of auctions in which all agents bid."""
    takeovers: int = 100
    """Number of lease holders killed."""
    loss: float = 0.1
    """Share of datagrams lost during auctions and takeovers."""
    swarm_most: int = 100
    """Number of nodes of the largest team of whole nodes."""

    def digest(self) -> str:
        """Return a hash that identifies these settings."""
        return hashlib.blake2s(f"{VERSION} {self!r}".encode(), digest_size=8).hexdigest()


@dataclass
class SizeResult:
    """The results of one size; ``cpu`` is in processor seconds."""

    nodes: int
    metrics: list[Metric] = field(default_factory=list)
    violations: list[str] = field(default_factory=list)
    hash: str = ""
    cpu: float = 0.0


class MeasurementStopped(Exception):
    """The user has stopped the measurement; the results of this size are discarded."""


@dataclass(frozen=True)
class ProgressCallbacks:
    """Callbacks: ``say`` receives progress messages, ``is_stopped`` returns whether the user wants to stop."""

    say: Callable[[str], None] = lambda line: None
    is_stopped: Callable[[], bool] = lambda: False


def measure_size(nodes: int, settings: SurveySettings, watcher: ProgressCallbacks = ProgressCallbacks()) -> SizeResult:  # noqa: B008  (never changed)
    """Measure a team of that size; raises ``MeasurementStopped``."""
    return SizeMeasurement(nodes, settings, watcher).run()


class SizeMeasurement:
    """The measurement of one size."""

    def __init__(self, nodes: int, settings: SurveySettings, watcher: ProgressCallbacks) -> None:
        self._nodes = nodes
        self._settings = settings
        self._callbacks = watcher
        self._result = SizeResult(nodes)
        join = Join("batches", pause=0.5, size=min(32, nodes), within=300.0, settle=settings.settle)
        self._scenario = Scenario(nodes=nodes, join=join, link=LinkSettings("internet"), step=STEP_S)

    def run(self) -> SizeResult:
        """Measure all figures; raises ``MeasurementStopped``."""
        started_at, sized = time.process_time(), self._result
        hashes = [self._measure_lookups(), self._measure_auctions()]
        if self._nodes <= self._settings.swarm_most:
            hashes.append(self._measure_directory())
        sized.hash = hashlib.blake2s("".join(hashes).encode(), digest_size=16).hexdigest()
        sized.cpu = time.process_time() - started_at
        return sized

    # -- inside -----------------------------------------------------------------------------------------------------

    def _measure_lookups(self) -> str:
        """Measure cost and lookups, with bare nodes on internet links."""
        team = Team(self._scenario, self._settings.seed)
        cost = Traffic(team, TrafficSettings())
        get_bidding_agents(team)  # create the services for bids, which also need memory
        asking = Lookups(team, LookupSettings(rate=self._settings.rate, exact=self._settings.exact))
        self._say("nodes join")
        self._form_team(team)
        self._say("nodes in quiet")
        self._run_workload(team, cost, self._settings.quiet)
        self._result.metrics += cost.collect_metrics()
        self._say("nodes look up each other")
        self._run_workload(team, asking, self._settings.lookups)
        self._finish(team, asking)
        return team.digest()  # without graceful leaves, which would take longer than all lookups

    def _measure_auctions(self) -> str:
        """Measure auctions and takeovers, with bare nodes and the services for bids."""
        nodes, settings = self._nodes, self._settings
        team = Team(self._scenario, settings.seed)
        team.switchboard.link_model = RadioLink(LinkQuality(DELAY_S, JITTER_S, settings.loss))
        bidding = Auctions(team, AuctionSettings(count=settings.auctions, every=4.0))
        # This rate is low enough that a small team tolerates the number of nodes that are away at the same time.
        rate = min(5.0, max(0.12, nodes / 200))
        dying = Takeovers(team, TakeoverSettings(count=settings.takeovers, rate=rate, away=AWAY_S))
        self._say("nodes join for a task")
        self._form_team(team)
        self._say("nodes bid")
        self._run_workload(team, bidding, 4.0 * settings.auctions + STEP_S)
        self._finish(team, bidding)
        self._say(f"nodes, {settings.takeovers} lease holders are killed")
        self._run_workload(team, dying, settings.takeovers / rate + 15.0)
        self._finish(team, dying)
        return team.digest()

    def _measure_directory(self) -> str:
        """Measure the directory, with device nodes."""
        scenario = replace(self._scenario, kind="swarm", link=LinkSettings("wifi"))
        team = Team(scenario, self._settings.seed)
        listing = Directory(team, DirectorySettings())
        self._say("devices announce themselves")
        self._form_team(team)
        self._run_workload(team, listing, 16.0)
        self._finish(team, listing)
        return team.digest()

    def _form_team(self, team: Team) -> None:
        self._advance(team, team.start_all())
        self._advance(team, self._scenario.join.within, team.is_joined)
        if not team.is_joined():
            self._result.violations.append(f"join: {len(team.living) - len(team.get_joined())} nodes have not joined")
        self._advance(team, self._scenario.join.settle)

    def _run_workload(self, team: Team, workload: Workload, seconds: float) -> None:
        end = team.clock.seconds() + seconds
        while team.clock.seconds() < end - 1e-9:
            workload.step()
            self._advance(team, STEP_S)
        workload.step()

    def _finish(self, team: Team, workload: Workload) -> None:
        workload.make_final_requests()
        self._advance(team, 5.0)
        self._result.metrics += workload.collect_metrics()
        self._result.violations += workload.find_violations()

    def _advance(self, team: Team, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        end = team.clock.seconds() + seconds
        while team.clock.seconds() < end - 1e-9 and not until():
            team.run(min(SLICE_S, end - team.clock.seconds()))
            if self._callbacks.is_stopped():
                raise MeasurementStopped

    def _say(self, line: str) -> None:
        self._callbacks.say(f"{self._nodes:,} {line}")
