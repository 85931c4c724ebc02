"""Traffic: what a team costs by itself: datagrams, bytes, contacts, and the processor and memory of the simulation.

Seconds of the processor and bytes of memory are those of the process that runs all nodes, divided by them; they depend
on the machine, and on what else the scenario asks of the nodes.
"""

from __future__ import annotations

import resource
import sys
import time
from dataclasses import dataclass, field

from middleware.setting import whole
from sim.team.figure import Figure, mean, percentile
from sim.team.team import Team

PAGE = resource.getpagesize()
UNITS = {
    "traffic.datagrams": "a node and s",
    "traffic.bytes": "B a node and s",
    "traffic.busiest": "B/s",
    "traffic.contacts": "contacts",
    "traffic.contacts.max": "contacts",
    "traffic.cpu": "ms a node and s",
    "traffic.real_time": "x",
    "traffic.memory": "KiB a node",
}
"""The figures."""


@dataclass(frozen=True)
class TrafficSettings:
    """``[load.traffic]``: who is counted."""

    sample: int = field(default=200, metadata=whole(1, 100_000))
    """Nodes whose contacts are counted at the end; the bytes of all are."""


def resident_bytes() -> int:
    """The memory that this process has now."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[1]) * PAGE
    except OSError:  # another system: the most that it ever had
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return most if sys.platform == "darwin" else most * 1024


class Traffic:
    """The workload ``traffic``; it asks nothing of anybody."""

    def __init__(self, team: Team, settings: TrafficSettings) -> None:
        self._team = team
        self._settings = settings
        self._bare_bytes = resident_bytes()
        self._began: float | None = None
        self._cpu = 0.0
        self._node_seconds = 0.0
        self._last_at = 0.0
        self._before: dict[int, tuple[int, int]] = {}

    def step(self) -> None:
        """Take note of who lives; the first time is the beginning."""
        now = self._team.clock.seconds()
        if self._began is None:
            self._began = self._last_at = now
            self._cpu = time.process_time()
            self._before = {place: self._sent(place) for place in self._team.places}
        self._node_seconds += (now - self._last_at) * len(self._team.nodes)
        self._last_at = now

    def settled(self) -> None:
        """Nothing is left to do."""

    def verdict(self) -> list[str]:
        """Nothing: what it costs is a figure."""
        return []

    def figures(self) -> list[Figure]:
        """Of a node and a second of its life; its contacts; and what it costs here."""
        if self._began is None or not self._node_seconds:
            return [Figure(name, None, unit) for name, unit in UNITS.items()]
        spent = time.process_time() - self._cpu
        elapsed = self._last_at - self._began
        sent, volume, busiest = 0, 0, 0
        for place in self._team.places:
            (datagrams, size), (past, past_size) = self._sent(place), self._before.get(place, (0, 0))
            sent, volume, busiest = sent + datagrams - past, volume + size - past_size, max(busiest, size - past_size)
        known = [float(len(self._team.entangled(place).overlay.contacts())) for place in self._sampled()]
        n = len(self._team.nodes)
        memory = (resident_bytes() - self._bare_bytes) / 1024 / max(1, n)
        values = [
            (sent / self._node_seconds, n),
            (volume / self._node_seconds, n),
            (busiest / elapsed, n),
            (mean(known), len(known)),
            (percentile(known, 1.0), len(known)),
        ]
        of_machine = [(1000 * spent / self._node_seconds, n), (elapsed / spent if spent else None, n), (memory, n)]
        rows = zip(UNITS.items(), values + of_machine, strict=True)
        return [
            Figure(name, value, unit, n=trials, is_exact=number < len(values))
            for number, ((name, unit), (value, trials)) in enumerate(rows)
        ]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _sent(self, place: int) -> tuple[int, int]:
        traffic = self._team.traffic(place)
        return traffic.sent, traffic.sent_bytes

    def _sampled(self) -> list[int]:
        places = self._team.alive()
        every = max(1, len(places) // self._settings.sample)
        return places[::every]
