"""Workload: observe the traffic of a team; measures datagrams, bytes, contacts, and the simulation's CPU and memory.

CPU time and memory are those of the process that runs all nodes, divided by the number of nodes. Both depend on the
machine and on the other workloads of the scenario.
"""

from __future__ import annotations

import resource
import sys
import time
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from sim.team.metric import Metric, mean, percentile
from sim.team.team import Team
from sim.team.workload import Workload

PAGE_BYTES = resource.getpagesize()


@dataclass(frozen=True)
class TrafficSettings:
    """``[load.traffic]``: the sampled nodes."""

    sample: Annotated[int, Meta(ge=1, le=100_000)] = 200
    """Number of nodes whose contacts are counted at the end; bytes are counted for all nodes."""


def measure_resident_bytes() -> int:
    """Return the resident memory of this process in bytes."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * PAGE_BYTES
    except OSError:  # on other systems use the peak memory
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return most if sys.platform == "darwin" else most * 1024


class Traffic(Workload):
    """The workload ``traffic``; it sends nothing."""

    def __init__(self, team: Team, settings: TrafficSettings) -> None:
        self._team = team
        self._settings = settings
        self._bare_bytes = measure_resident_bytes()
        self._began: float | None = None
        self._cpu = 0.0
        self._node_seconds = 0.0
        self._last_at = 0.0
        self._before: dict[int, tuple[int, int]] = {}

    def step(self) -> None:
        """Count the living nodes; the first call starts the measurement."""
        now = self._team.clock.seconds()
        if self._began is None:
            self._began = self._last_at = now
            self._cpu = time.process_time()
            self._before = {place: self._read_sent(place) for place in self._team.places}
        self._node_seconds += (now - self._last_at) * len(self._team.living)
        self._last_at = now

    def collect_metrics(self) -> list[Metric]:
        """Return the traffic per node and second, the contacts, and the cost of the simulation."""
        spent, elapsed, lived = 0.0, 0.0, self._node_seconds
        sent, volume, busiest = 0, 0, 0
        known: list[float] = []
        if lived and self._began is not None:
            spent, elapsed = time.process_time() - self._cpu, self._last_at - self._began
            known = [float(len(self._team.get_entangled(place).overlay.contacts())) for place in self._sample_places()]
            for place in self._team.places:
                (datagrams, size), (past, past_size) = self._read_sent(place), self._before.get(place, (0, 0))
                sent, volume = sent + datagrams - past, volume + size - past_size
                busiest = max(busiest, size - past_size)
        n = len(self._team.living)
        memory = (measure_resident_bytes() - self._bare_bytes) / 1024 / max(1, n) if lived else None
        return [
            Metric("traffic.datagrams", _divide(sent, lived), "a node and s", n=n),
            Metric("traffic.bytes", _divide(volume, lived), "B a node and s", n=n),
            Metric("traffic.busiest", _divide(busiest, elapsed), "B/s", n=n),
            Metric("traffic.contacts", mean(known), "contacts", n=len(known)),
            Metric("traffic.contacts.max", percentile(known, 1.0), "contacts", n=len(known)),
            Metric("traffic.cpu", _divide(1000 * spent, lived), "ms a node and s", n=n, is_exact=False),
            Metric("traffic.real_time", _divide(elapsed, spent), "x", n=n, is_exact=False),
            Metric("traffic.memory", memory, "KiB a node", n=n, is_exact=False),
        ]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _read_sent(self, place: int) -> tuple[int, int]:
        traffic = self._team.traffic(place)
        return traffic.sent, traffic.sent_bytes

    def _sample_places(self) -> list[int]:
        places = self._team.alive()
        every = max(1, len(places) // self._settings.sample)
        return places[::every]


def _divide(total: float, whole: float) -> float | None:
    return total / whole if whole else None
