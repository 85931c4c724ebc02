"""Run a scenario from the first node to the result; a run that is stopped early gives a partial result."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import cast

from twisted.logger import ILogObserver, LogEvent, Logger, globalLogPublisher

from sim.team.checker import find_violations
from sim.team.event import Settled
from sim.team.faults.injector import TeamFaults
from sim.team.metric import Bound, Metric
from sim.team.scenario import Scenario
from sim.team.team import Team
from sim.team.workload import Workload, WorkloadKinds

FINAL_REQUESTS_S = 10.0
"""Seconds that the workloads get for their final requests."""
SLICE_S = 0.25
"""Seconds of the team's time between two calls of the observers."""
MAX_VIOLATIONS = 1000
EPSILON_S = 1e-9
"""Tolerance in seconds for rounding errors of summed steps."""
LONG_S, SHORT_S, MIN_GRAIN_S = 0.5, 0.1, 1e-4
"""The real time that a grain (one step of the team's time) should take: above ``LONG_S`` seconds grains become
shorter, so that a user can stop the run soon; below ``SHORT_S`` they become longer. ``MIN_GRAIN_S`` is the shortest
grain in seconds of the team's time."""

Phase = str
JOINING, SETTLING, RUNNING, REPAIRING, ASKING, DONE = "joining", "settling", "running", "repairing", "asking", "done"
OnProgress = Callable[["Run"], bool]
"""Called after every slice; True stops the run."""


@dataclass(frozen=True)
class Outcome:
    """The result of a run; ``is_partial`` if it was stopped early, in the phase ``phase``."""

    seed: int
    phase: Phase
    seconds: float
    metrics: list[Metric] = field(default_factory=list)
    violations: list[str] = field(default_factory=list)
    digest: str = ""

    @property
    def is_partial(self) -> bool:
        """Whether the run was stopped early."""
        return self.phase != DONE

    @property
    def missed(self) -> list[Metric]:
        """The figures that miss their targets."""
        return [metric for metric in self.metrics if metric.holds is False]


class Run:
    """One run of a ``scenario``.

    ``looked`` is called after each slice, at times that follow from the seed, and may stop the run. ``watched`` is
    called at intervals of the real time ``seconds``, and may also stop the run. ``grown`` is called when all nodes
    exist: most of the memory that is allocated by then lives as long as the nodes.
    """

    _log = Logger()

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        kinds: WorkloadKinds,
        looked: OnProgress = lambda run: False,
        grown: Callable[[], None] = lambda: None,
        watched: OnProgress = lambda run: False,
        seconds: Callable[[], float] = lambda: 0.0,
    ) -> None:
        self.scenario = scenario
        self.team = Team(scenario, seed)
        self.phase: Phase = JOINING
        self.began_at: float | None = None
        """The time on the team's clock at which the team was complete and had settled."""
        self.workloads: list[tuple[str, Workload]] = [
            (name, kinds[name].make(self.team, settings)) for name, settings in scenario.loads
        ]
        self.violations: list[str] = []
        join = scenario.join
        self.expected_end = (
            join.settle + scenario.seconds + scenario.repair + (FINAL_REQUESTS_S if self.workloads else 0.0)
        )
        """The expected end on the team's clock."""
        self._on_slice = looked
        self._on_allocated = grown
        self._on_grain = watched
        self._real_time = seconds
        self._grain = SLICE_S
        self._faults = TeamFaults(self.team)
        self._is_ended = False

    def run(self) -> Outcome:
        """Run all phases and return the result."""
        phases = (
            (JOINING, self._join),
            (SETTLING, self._settle),
            (RUNNING, self._run_workloads),
            (REPAIRING, self._repair),
            (ASKING, self._make_final_requests),
        )
        observer = cast(ILogObserver, self._on_log_event)
        globalLogPublisher.addObserver(observer)
        try:
            for self.phase, work in phases:
                work()
                if self._is_ended:
                    return self.make_outcome()
        finally:
            globalLogPublisher.removeObserver(observer)
        self.phase = DONE
        return self.make_outcome()

    def collect_metrics(self) -> list[Metric]:
        """Return every figure so far, with the targets of the scenario."""
        found = [metric for _, workload in self.workloads for metric in workload.collect_metrics()]
        targets: dict[str, Bound] = dict(self.scenario.targets)
        return [metric.with_target(targets[metric.name]) if metric.name in targets else metric for metric in found]

    def make_outcome(self) -> Outcome:
        """Return the result so far."""
        team = self.team
        metrics = self.collect_metrics()
        violations = [
            *self.violations,
            *self._find_unmatched_targets(metrics),
            *(line for _, workload in self.workloads for line in workload.find_violations()),
            *find_violations(team.history),
        ]
        whole = hashlib.blake2b(digest_size=16)
        whole.update(team.digest().encode())
        for figure in metrics:
            if figure.is_exact:
                whole.update(f"{figure.name} {figure.value!r}\n".encode())
        for line in violations:
            whole.update(f"{line}\n".encode())
        return Outcome(team.seed, self.phase, team.clock.seconds(), metrics, violations, whole.hexdigest())

    # -- inside -----------------------------------------------------------------------------------------------------

    def _on_log_event(self, event: LogEvent) -> None:
        """Record a failure that a node logged as a violation, because no client would notice the failure."""
        failure = event.get("log_failure")
        if failure is not None and len(self.violations) < MAX_VIOLATIONS:
            name, moment = failure.type.__name__, self.team.clock.seconds()
            self.violations.append(f"exception: {name} at {moment:.3f} s: {failure.getErrorMessage()}")

    def _join(self) -> None:
        team, within = self.team, self.scenario.join.within
        last = team.start_all()
        self.expected_end += last
        self._advance(last)
        self._advance(within, until=team.is_joined)
        self.expected_end += team.clock.seconds() - last
        outside = len(team.living) - len(team.get_joined())
        if outside and not self._is_ended:
            self.violations.append(f"join: {outside} nodes have not joined {within:g} s after the last one started")

    def _settle(self) -> None:
        self._on_allocated()
        self._advance(self.scenario.join.settle)

    def _run_workloads(self) -> None:
        """Apply faults and sessions while the workloads run."""
        scenario, clock = self.scenario, self.team.clock
        self.began_at = started_at = clock.seconds()
        self._faults.begin()
        end = started_at + scenario.seconds
        while not self._is_ended and clock.seconds() < end - EPSILON_S:
            if clock.seconds() >= started_at + scenario.lead - EPSILON_S:
                for _, workload in self.workloads:
                    workload.step()
            self._advance(min(scenario.step, end - clock.seconds()))

    def _repair(self) -> None:
        if self.scenario.repair:
            self._faults.end()
        self._advance(self.scenario.repair)

    def _make_final_requests(self) -> None:
        if self.scenario.repair:
            self.team.history.record(Settled)
        for _, workload in self.workloads:
            workload.make_final_requests()
        self._advance(FINAL_REQUESTS_S if self.workloads else 0.0)

    def _find_unmatched_targets(self, figures: list[Metric]) -> list[str]:
        """Return the targets that do not match any figure."""
        names = [figure.name for figure in figures]
        unmatched = [] if self.phase != DONE else [name for name, _ in self.scenario.targets if name not in names]
        return [f"targets: nothing measured {name!r}; there are {', '.join(names) or 'none'}" for name in unmatched]

    def _advance(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """Let time pass in slices."""
        clock = self.team.clock
        end = clock.seconds() + seconds
        while not self._is_ended and clock.seconds() < end - EPSILON_S and not until():
            self._run_slice(min(SLICE_S, end - clock.seconds()))
            self._is_ended = self._is_ended or self._on_slice(self)

    def _run_slice(self, seconds: float) -> None:
        """Let time pass in grains, whose size does not affect the result."""
        clock = self.team.clock
        end = clock.seconds() + seconds
        while not self._is_ended and clock.seconds() < end:
            began = self._real_time()
            try:
                clock.run_until(min(end, clock.seconds() + self._grain))
            except Exception:  # continue, as a reactor does
                self._log.failure("a scheduled call of the team failed")
            self._is_ended = self._on_grain(self)
            elapsed = self._real_time() - began
            if elapsed > LONG_S:
                self._grain = max(MIN_GRAIN_S, self._grain / 4)
            elif elapsed < SHORT_S:
                self._grain = min(SLICE_S, self._grain * 2)
