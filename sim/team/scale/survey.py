"""Survey: everything that is measured of a team of one size, one thing after the other.

Nodes wait for an answer as long as answers took before, so a team stays on the links on which it came together: one of
bare nodes has an internet, for its cost and its lookups, and one the quick links that auctions and takeovers are held
to.  The directory has a third one of whole nodes, for bare ones have no devices.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from sim.team.figure import Figure
from sim.team.leases.radio import Air, Radio
from sim.team.link import LinkSettings
from sim.team.load.auctions import Auctions, AuctionSettings
from sim.team.load.deputies import deputies_of
from sim.team.load.directory import Directory, DirectorySettings
from sim.team.load.lookups import Lookups, LookupSettings
from sim.team.load.takeovers import Takeovers, TakeoverSettings
from sim.team.load.traffic import Traffic, TrafficSettings
from sim.team.scenario import Join, Scenario
from sim.team.team import Team
from sim.team.workload import Workload

DELAY, JITTER = 0.02, 0.01
"""Seconds one way on the link of ``docs/explanation/choosing-a-robot.md``, and the mean of the exponential jitter."""
STEP = 0.5
SLICE = 0.25
"""Seconds of the team's time between two looks at whether a person wants an end."""
AWAY = 5.0
"""Seconds for which those that die while they act are gone."""
VERSION = 2
"""Another one when what is measured means something else."""


@dataclass(frozen=True)
class SurveySettings:
    """What is done with each team; figures of other settings are not to be compared."""

    seed: int = 1
    settle: float = 30.0
    """Seconds from the moment when all are in until the team counts as quiet."""
    quiet: float = 20.0
    """Seconds in which nothing is asked, and what is sent is counted."""
    lookups: float = 10.0
    """Seconds of lookups."""
    rate: float = 30.0
    """Lookups a second."""
    exact: int = 1000
    """Keys whose lookup has to be exact."""
    auctions: int = 3
    """Auctions in which everybody bids."""
    takeovers: int = 100
    """Holders that die."""
    loss: float = 0.1
    """Share of the datagrams that auctions and takeovers have to do without."""
    swarm_most: int = 100
    """Nodes of the largest team of whole nodes."""

    def digest(self) -> str:
        """What tells these settings from all others."""
        return hashlib.blake2s(f"{VERSION} {self!r}".encode(), digest_size=8).hexdigest()


@dataclass
class Sized:
    """What was measured at one size; ``cpu`` is in seconds of the processor."""

    nodes: int
    figures: list[Figure] = field(default_factory=list)
    violations: list[str] = field(default_factory=list)
    hash: str = ""
    cpu: float = 0.0


class Ended(Exception):
    """A person wants an end; what was measured of this size is let go of."""


@dataclass(frozen=True)
class Watcher:
    """Who looks on: ``say`` is told what is being done, ``is_stopped`` says whether a person wants an end."""

    say: Callable[[str], None] = lambda line: None
    is_stopped: Callable[[], bool] = lambda: False


def surveyed(nodes: int, settings: SurveySettings, watcher: Watcher = Watcher()) -> Sized:  # noqa: B008  (never changed)
    """Measure a team of that size; raises ``Ended``."""
    return Survey(nodes, settings, watcher).run()


class Survey:
    """The measuring of one size."""

    def __init__(self, nodes: int, settings: SurveySettings, watcher: Watcher) -> None:
        self._nodes = nodes
        self._settings = settings
        self._watcher = watcher
        self._sized = Sized(nodes)
        join = Join("batches", pause=0.5, size=min(32, nodes), within=300.0, settle=settings.settle)
        self._scenario = Scenario(nodes=nodes, join=join, link=LinkSettings("internet"), step=STEP)

    def run(self) -> Sized:
        """Measure everything; raises ``Ended``."""
        began, sized = time.process_time(), self._sized
        hashes = [self._far(), self._near()]
        if self._nodes <= self._settings.swarm_most:
            hashes.append(self._whole())
        sized.hash = hashlib.blake2s("".join(hashes).encode(), digest_size=16).hexdigest()
        sized.cpu = time.process_time() - began
        return sized

    # -- inside -----------------------------------------------------------------------------------------------------

    def _far(self) -> str:
        """Cost and lookups, by nodes of the library on an internet."""
        team = Team(self._scenario, self._settings.seed)
        cost = Traffic(team, TrafficSettings())
        deputies_of(team)  # the rooms for bids cost memory too
        asking = Lookups(team, LookupSettings(rate=self._settings.rate, exact=self._settings.exact))
        self._say("nodes come together")
        self._stand(team)
        self._say("nodes in quiet")
        self._play(team, cost, self._settings.quiet)
        self._sized.figures += cost.figures()
        self._say("nodes look for each other")
        self._play(team, asking, self._settings.lookups)
        self._finish(team, asking)
        return team.digest()  # and no goodbyes, which would take longer than all the lookups

    def _near(self) -> str:
        """Auctions and takeovers, by nodes of the library with the rooms for bids beside them."""
        nodes, settings = self._nodes, self._settings
        team = Team(self._scenario, settings.seed)
        team.board.link = Radio(Air(DELAY, JITTER, settings.loss))
        bidding = Auctions(team, AuctionSettings(count=settings.auctions, every=4.0))
        # No more are away at once than a small team can do without.
        rate = min(5.0, max(0.12, nodes / 200))
        dying = Takeovers(team, TakeoverSettings(count=settings.takeovers, rate=rate, away=AWAY))
        self._say("nodes come together for a task")
        self._stand(team)
        self._say("nodes bid")
        self._play(team, bidding, 4.0 * settings.auctions + STEP)
        self._finish(team, bidding)
        self._say(f"nodes, and {settings.takeovers} of them die while they act")
        self._play(team, dying, settings.takeovers / rate + 15.0)
        self._finish(team, dying)
        return team.digest()

    def _whole(self) -> str:
        """The directory, by the nodes of devices."""
        scenario = replace(self._scenario, kind="swarm", link=LinkSettings("wifi"))
        team = Team(scenario, self._settings.seed)
        listing = Directory(team, DirectorySettings())
        self._say("devices announce themselves")
        self._stand(team)
        self._play(team, listing, 16.0)
        self._finish(team, listing)
        return team.digest()

    def _stand(self, team: Team) -> None:
        self._pass(team, team.come())
        self._pass(team, self._scenario.join.within, team.is_standing)
        if not team.is_standing():
            self._sized.violations.append(f"join: {len(team.living) - len(team.inside())} nodes are not in")
        self._pass(team, self._scenario.join.settle)

    def _play(self, team: Team, workload: Workload, seconds: float) -> None:
        end = team.clock.seconds() + seconds
        while team.clock.seconds() < end - 1e-9:
            workload.step()
            self._pass(team, STEP)
        workload.step()

    def _finish(self, team: Team, workload: Workload) -> None:
        workload.settled()
        self._pass(team, 5.0)
        self._sized.figures += workload.figures()
        self._sized.violations += workload.verdict()

    def _pass(self, team: Team, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        end = team.clock.seconds() + seconds
        while team.clock.seconds() < end - 1e-9 and not until():
            team.run(min(SLICE, end - team.clock.seconds()))
            if self._watcher.is_stopped():
                raise Ended

    def _say(self, line: str) -> None:
        self._watcher.say(f"{self._nodes:,} {line}")
