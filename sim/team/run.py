"""Run a scenario from the first node to the verdict; it can be stopped at any time and then gives a partial result."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import cast

from twisted.logger import ILogObserver, LogEvent, Logger, globalLogPublisher

from sim.team.checker import check
from sim.team.event import Settled
from sim.team.faults.injector import TeamFaults
from sim.team.figure import Bound, Figure
from sim.team.scenario import Scenario
from sim.team.team import Team
from sim.team.workload import Kinds, Workload

ASKED = 10.0
"""Seconds that the workloads get for their final requests."""
SLICE = 0.25
"""Seconds of the team's time between two calls of the observers."""
MOST_VIOLATIONS = 1000
NONE = 1e-9
"""Tolerance in seconds for rounding errors of summed steps."""
LONG, SHORT, LEAST_GRAIN = 0.5, 0.1, 1e-4
"""Real seconds for one grain: above ``LONG`` the grain becomes finer, so that a user can stop the run soon, and below
``SHORT`` coarser.  ``LEAST_GRAIN`` is the finest one in seconds of the team's time."""

Phase = str
JOINING, SETTLING, RUNNING, REPAIRING, ASKING, DONE = "joining", "settling", "running", "repairing", "asking", "done"
Looked = Callable[["Run"], bool]
"""Called after every slice; True stops the run."""


@dataclass(frozen=True)
class Outcome:
    """The result of a run; ``is_partial`` if it was stopped early, in the phase ``phase``."""

    seed: int
    phase: Phase
    seconds: float
    figures: list[Figure] = field(default_factory=list)
    violations: list[str] = field(default_factory=list)
    digest: str = ""

    @property
    def is_partial(self) -> bool:
        """Whether the run was stopped early."""
        return self.phase != DONE

    @property
    def missed(self) -> list[Figure]:
        """The figures that miss their targets."""
        return [figure for figure in self.figures if figure.holds is False]


class Run:
    """One run of a ``scenario``.

    ``looked`` is called after each slice, at times that follow from the seed, and may stop the run.  ``watched`` is
    called more often on a slow machine, according to the real time ``seconds``, and may stop the run as well.
    ``grown`` is called when all nodes exist: from then on most of the memory has their lifetime.
    """

    _log = Logger()

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        kinds: Kinds,
        looked: Looked = lambda run: False,
        grown: Callable[[], None] = lambda: None,
        watched: Looked = lambda run: False,
        seconds: Callable[[], float] = lambda: 0.0,
    ) -> None:
        self.scenario = scenario
        self.team = Team(scenario, seed)
        self.phase: Phase = JOINING
        self.began_at: float | None = None
        """The time on the team's clock when the team was complete and had settled."""
        self.workloads: list[tuple[str, Workload]] = [
            (name, kinds[name].make(self.team, settings)) for name, settings in scenario.loads
        ]
        self.violations: list[str] = []
        join = scenario.join
        self.expected_end = join.settle + scenario.seconds + scenario.repair + (ASKED if self.workloads else 0.0)
        """The expected end on the team's clock."""
        self._looked = looked
        self._grown = grown
        self._watched = watched
        self._seconds = seconds
        self._grain = SLICE
        self._faults = TeamFaults(self.team)
        self._is_ended = False

    def go(self) -> Outcome:
        """Run all phases and return the result."""
        phases = (
            (JOINING, self._join),
            (SETTLING, self._settle),
            (RUNNING, self._act),
            (REPAIRING, self._repair),
            (ASKING, self._ask),
        )
        observer = cast(ILogObserver, self._on_log_event)
        globalLogPublisher.addObserver(observer)
        try:
            for self.phase, work in phases:
                work()
                if self._is_ended:
                    return self.outcome()
        finally:
            globalLogPublisher.removeObserver(observer)
        self.phase = DONE
        return self.outcome()

    def figures(self) -> list[Figure]:
        """Return every figure so far, with the targets of the scenario."""
        found = [figure for _, workload in self.workloads for figure in workload.figures()]
        targets: dict[str, Bound] = dict(self.scenario.targets)
        return [figure.against(targets[figure.name]) if figure.name in targets else figure for figure in found]

    def outcome(self) -> Outcome:
        """Return the result so far."""
        team = self.team
        figures = self.figures()
        violations = [
            *self.violations,
            *self._unmatched_targets(figures),
            *(line for _, workload in self.workloads for line in workload.verdict()),
            *check(team.history),
        ]
        whole = hashlib.blake2b(digest_size=16)
        whole.update(team.digest().encode())
        for figure in figures:
            if figure.is_exact:
                whole.update(f"{figure.name} {figure.value!r}\n".encode())
        for line in violations:
            whole.update(f"{line}\n".encode())
        return Outcome(team.seed, self.phase, team.clock.seconds(), figures, violations, whole.hexdigest())

    # -- inside -----------------------------------------------------------------------------------------------------

    def _on_log_event(self, event: LogEvent) -> None:
        """Record a failure that a node logged as a violation, as no client would notice it."""
        failure = event.get("log_failure")
        if failure is not None and len(self.violations) < MOST_VIOLATIONS:
            name, moment = failure.type.__name__, self.team.clock.seconds()
            self.violations.append(f"exception: {name} at {moment:.3f} s: {failure.getErrorMessage()}")

    def _join(self) -> None:
        team, within = self.team, self.scenario.join.within
        last = team.come()
        self.expected_end += last
        self._advance(last)
        self._advance(within, until=team.is_standing)
        self.expected_end += team.clock.seconds() - last
        outside = len(team.living) - len(team.inside())
        if outside and not self._is_ended:
            self.violations.append(f"join: {outside} nodes have not joined {within:g} s after the last one started")

    def _settle(self) -> None:
        self._grown()
        self._advance(self.scenario.join.settle)

    def _act(self) -> None:
        """Apply faults and sessions while the workloads run."""
        scenario, clock = self.scenario, self.team.clock
        self.began_at = began = clock.seconds()
        self._faults.begin()
        end = began + scenario.seconds
        while not self._is_ended and clock.seconds() < end - NONE:
            if clock.seconds() >= began + scenario.lead - NONE:
                for _, workload in self.workloads:
                    workload.step()
            self._advance(min(scenario.step, end - clock.seconds()))

    def _repair(self) -> None:
        if self.scenario.repair:
            self._faults.end()
        self._advance(self.scenario.repair)

    def _ask(self) -> None:
        if self.scenario.repair:
            self.team.history.note(Settled)
        for _, workload in self.workloads:
            workload.settled()
        self._advance(ASKED if self.workloads else 0.0)

    def _unmatched_targets(self, figures: list[Figure]) -> list[str]:
        """Return the targets that match no figure."""
        names = [figure.name for figure in figures]
        unmatched = [] if self.phase != DONE else [name for name, _ in self.scenario.targets if name not in names]
        return [f"targets: nothing measured {name!r}; there are {', '.join(names) or 'none'}" for name in unmatched]

    def _advance(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Let time pass in slices."""
        clock = self.team.clock
        end = clock.seconds() + seconds
        while not self._is_ended and clock.seconds() < end - NONE and not until():
            self._slice(min(SLICE, end - clock.seconds()))
            self._is_ended = self._is_ended or self._looked(self)

    def _slice(self, seconds: float) -> None:
        """Let time pass in grains, whose size does not affect the result."""
        clock = self.team.clock
        end = clock.seconds() + seconds
        while not self._is_ended and clock.seconds() < end:
            began = self._seconds()
            try:
                clock.run_until(min(end, clock.seconds() + self._grain))
            except Exception:  # a reactor would continue as well
                self._log.failure("a scheduled call of the team failed")
            self._is_ended = self._watched(self)
            took = self._seconds() - began
            if took > LONG:
                self._grain = max(LEAST_GRAIN, self._grain / 4)
            elif took < SHORT:
                self._grain = min(SLICE, self._grain * 2)
