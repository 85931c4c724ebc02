"""Workload: readers list all devices; measures the time, and the distribution of device records over nodes.

The workload examines the stores of the nodes, so it does not depend on the keys of the directory.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from formats.convert import Unit
from middleware.directory.presence import parse_device, parse_devices
from middleware.entangled.record import Record
from middleware.node import SwarmNode
from sim.team.load.client_workload import ClientWorkload
from sim.team.metric import Metric, make_percentiles, make_share, mean
from sim.team.team import Team


@dataclass(frozen=True)
class DirectorySettings:
    """``[load.directory]``: listing of devices; for nodes of kind ``swarm`` only."""

    readers: Annotated[int, Meta(ge=0, le=10_000)] = 3
    """Number of nodes that list all devices, one after the other."""

    every: Annotated[float, Meta(ge=0.5, le=3600.0), Unit("seconds")] = 5.0
    """Time limit of each reader in seconds."""


class Directory(ClientWorkload):
    """The workload ``directory``."""

    def __init__(self, team: Team, settings: DirectorySettings) -> None:
        super().__init__(team, "directory")
        self._settings = settings
        self._begun = 0
        self._next_at = -math.inf
        self._stop: Callable[[], object] = lambda: None
        self.seconds: list[float] = []
        self.listed_shares: list[float] = []
        self._max_listed = 0

    def step(self) -> None:
        """Let the next reader list all devices, if the next listing is due."""
        now = self._clock.seconds()
        if now < self._next_at:
            return
        self._end()
        chosen = self._joined.any(self._rng) if self._begun < self._settings.readers else []
        if not chosen:
            self._next_at = math.inf
            return
        self._begun += 1
        self._next_at = now + self._settings.every
        self._start_listing(chosen[0])

    def make_final_requests(self) -> None:
        """Record the result of the last reader."""
        self._end()

    def collect_metrics(self) -> list[Metric]:
        """Return the device records per node, the share at the busiest node, and the times and results of readers."""
        held = []
        for place in self._team.alive():
            store = self._team.get_entangled(place).store
            held.append(len({record.owner for record in store.records() if parse_device(record) is not None}))
        n = len(held)
        most = max(held, default=0)
        return [
            Metric("directory.devices", float(n), "devices"),
            Metric("directory.held.mean", mean([float(count) for count in held]), "devices a node", n=n),
            Metric("directory.held.max", float(most), "devices", n=n),
            Metric("directory.busiest", most / n if n else None, "share of all", n=n),
            make_share(
                "directory.listed_whole", sum(part >= 1.0 for part in self.listed_shares), len(self.listed_shares)
            ),
            Metric("directory.listed", mean(self.listed_shares), "share", n=len(self.listed_shares)),
            *make_percentiles("directory.seconds", self.seconds, "s", (0.5,)),
        ]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _start_listing(self, place: int) -> None:
        node = self._team.node(place)
        if not isinstance(node, SwarmNode):
            return
        started_at, wanted = self._clock.seconds(), len(self._team.get_joined())
        self._max_listed = 0

        def changed(records: list[Record]) -> None:
            before, self._max_listed = self._max_listed, max(self._max_listed, len(parse_devices(records)))
            if before < wanted <= self._max_listed:
                self.seconds.append(self._clock.seconds() - started_at)

        watch = node.watch_devices(changed)

        def end() -> None:
            watch.stop()
            self.listed_shares.append(min(1.0, self._max_listed / wanted))

        self._stop = end

    def _end(self) -> None:
        self._stop()
        self._stop = lambda: None
