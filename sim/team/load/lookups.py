"""Workload: random nodes look up other nodes; measures success, hops and time.

As in the published studies used for comparison (Li et al., INFOCOM 2005), the target is the id of a random joined node.
A lookup succeeds if this node is the first of the result within the time limit. If the searching node or the target
dies during the lookup, the trial is void.

``seconds`` are measured until the whole result (the k closest nodes) is available, ``reach_times`` until the target
itself has answered, as in those studies.

In a quiet network, random keys are looked up in addition: the result is exact if it contains the k closest of all
living nodes in order of distance (invariant D6).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta
from twisted.python.failure import Failure

from formats.convert import Unit
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError
from middleware.entangled.identity import ID_BYTES
from middleware.entangled.kademlia.overlay import K
from middleware.entangled.node import EntangledNode
from sim.team.load.client_workload import ClientWorkload, Pacer
from sim.team.metric import Metric, make_maximum, make_percentiles, make_share, mean
from sim.team.team import Team

MAX_LISTED = 20
"""Maximum number of violations listed individually."""


@dataclass(frozen=True)
class LookupSettings:
    """``[load.lookups]``: the rate of lookups."""

    rate: Annotated[float, Meta(ge=0.0, le=10_000.0)] = 10.0
    """Lookups per second of all nodes together."""

    limit: Annotated[float, Meta(ge=0.1, le=60.0), Unit("seconds")] = 4.0
    """Time limit of a lookup in seconds."""

    exact: Annotated[int, Meta(ge=0, le=100_000)] = 100
    """Number of random keys that are looked up at the end in a quiet network; these results must be exact."""


@dataclass
class LookupTrial:
    """One lookup: the searching node, its life, the target, and the start time."""

    place: int
    life: EntangledNode
    target: bytes
    began: float


class Lookups(ClientWorkload):
    """The workload ``lookups``."""

    def __init__(self, team: Team, settings: LookupSettings) -> None:
        super().__init__(team, "lookups")
        self._settings = settings
        self._pace = Pacer(team.clock, settings.rate)
        self._open: dict[int, LookupTrial] = {}
        self._begun = 0
        self.found = self.missed = self.late = self.void = 0
        self.hops: list[float] = []
        self.requests: list[float] = []
        self.seconds: list[float] = []
        self.reach_times: list[float] = []
        self.exact = self.inexact = 0
        self._violations: list[str] = []
        self._is_settled = False

    def step(self) -> None:
        """Start the lookups that are due."""
        self._count_late()
        for _ in range(self._pace.take_due()):
            pair = self._joined.any(self._rng, 2)
            if len(pair) == 2:
                self._start_lookup(*pair)

    def make_final_requests(self) -> None:
        """Look up random keys; these results must be exact."""
        self._count_late()
        self._is_settled = True
        for _ in range(self._settings.exact if len(self._joined) > 1 else 0):
            place = self._joined.any(self._rng)[0]
            life = self._joined.node(place)
            key = self._rng.randbytes(ID_BYTES)
            truth = self._joined.id_index.find_closest(key, K, life.identity.node_id)
            life.find_node(key).addCallbacks(self._compare, self._on_exact_failure, (place, key, truth), {}, (place,))

    def find_violations(self) -> list[str]:
        """Return the inexact lookups in a quiet network."""
        more = self.inexact - len(self._violations)
        return self._violations + ([f"D6: {more} more lookups are not exact"] if more > 0 else [])

    def collect_metrics(self) -> list[Metric]:
        """Return success, exactness, hops, requests and times."""
        self._count_late()
        n = self.found + self.missed + self.late
        # At least two hops: the first finds the address of the target, and the second confirms that the target is
        # alive.
        most = max(2.0, math.log2(max(2, len(self._joined))) / 2)
        figures = [
            make_share("lookups.success", self.found, n),
            Metric("lookups.late", float(self.late), "lookups", n=n),
            Metric("lookups.wrong", float(self.missed), "lookups", n=n),
            Metric("lookups.void", float(self.void), "lookups"),
            make_maximum("lookups.hops.mean", mean(self.hops), "hops", most, n=len(self.hops)),
            Metric("lookups.hops.max", max(self.hops, default=None), "hops", n=len(self.hops)),
            Metric("lookups.asked.mean", mean(self.requests), "nodes", n=len(self.requests)),
            *make_percentiles("lookups.seconds", self.seconds, "s", (0.5, 0.95, 0.99)),
            *make_percentiles("lookups.reached", self.reach_times, "s", (0.5, 0.95)),
        ]
        if self._settings.exact:
            figures.append(make_share("lookups.exact", self.exact, self.exact + self.inexact))
        return figures

    # -- inside -----------------------------------------------------------------------------------------------------

    def _start_lookup(self, place: int, other: int) -> None:
        life, sought = self._joined.node(place), self._joined.node(other)
        self._begun += 1
        number = self._begun
        self._open[number] = LookupTrial(place, life, sought.identity.node_id, self._clock.seconds())
        life.find_node(sought.identity.node_id).addCallbacks(
            self._on_answer, self._on_failure, (number,), {}, (number,)
        )

    def _on_answer(self, contacts: list[Contact], number: int) -> None:
        trial = self._open.pop(number, None)
        if trial is None:
            return  # the lookup exceeded the time limit
        took = self._clock.seconds() - trial.began
        if self._is_void(trial):
            self.void += 1
        elif took > self._settings.limit:
            self.late += 1
        elif not contacts or contacts[0].node_id != trial.target:
            self.missed += 1
        else:
            self.found += 1
            self.seconds.append(took)
            # The target answered this lookup, or sent a datagram up to ``overlay.RECORD_INTERVAL_S`` earlier.
            self.reach_times.append(took - min(took, trial.life.overlay.silence(contacts[0])))
            looked = next((one for one in reversed(trial.life.overlay.lookups) if one.key == trial.target), None)
            if looked is not None:
                self.hops.append(float(looked.hops))
                self.requests.append(float(looked.asked))

    def _on_failure(self, failure: Failure, number: int) -> None:
        failure.trap(EntangledError)
        trial = self._open.pop(number, None)
        if trial is not None:
            if self._is_void(trial):
                self.void += 1
            else:
                self.missed += 1

    def _count_late(self) -> None:
        since = self._clock.seconds() - self._settings.limit
        while self._open:
            number, trial = next(iter(self._open.items()))
            if trial.began > since:
                return
            del self._open[number]
            if self._is_void(trial):
                self.void += 1
            else:
                self.late += 1

    def _is_void(self, trial: LookupTrial) -> bool:
        return not (self._joined.is_alive(trial.place, trial.life) and trial.target in self._joined.id_index)

    def _compare(self, contacts: list[Contact], place: int, key: bytes, truth: list[bytes]) -> None:
        if [contact.node_id for contact in contacts] == truth:
            self.exact += 1
        else:
            right = len({contact.node_id for contact in contacts} & set(truth))
            self._record_inexact(f"D6: node {place} finds {right} of the {len(truth)} closest to {key.hex()[:8]}")

    def _on_exact_failure(self, failure: Failure, place: int) -> None:
        failure.trap(EntangledError)
        self._record_inexact(f"D6: the lookup of node {place} fails: {failure.getErrorMessage()}")

    def _record_inexact(self, line: str) -> None:
        self.inexact += 1
        if len(self._violations) < MAX_LISTED:
            self._violations.append(line)
