"""Workload: clients write, remove and read a few slots; the checker checks the answers.

Only the share of answered requests is measured here. Correctness, freshness and durability are checked in the team's
history, as D1 to D4 and D7 of ``sim.team.invariant.durability``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from middleware.entangled.record import hash_key
from sim.team.clients import READ, REMOVE, WRITE, Clients
from sim.team.load.client_workload import ClientWorkload, Pacer
from sim.team.metric import Metric, make_share
from sim.team.team import Team

NAME = "r"
"""Name of the slot that each node has under a key."""
OPERATIONS = (WRITE, WRITE, REMOVE, READ, READ, READ)
MAX_READERS = 32
"""Maximum number of nodes that read all keys at the end."""


@dataclass(frozen=True)
class RecordSettings:
    """``[load.records]``: the rates of writes and reads."""

    keys: Annotated[int, Meta(ge=1, le=10_000)] = 4
    """Number of keys, with one slot per node under each."""

    rate: Annotated[float, Meta(ge=0.001, le=10_000.0)] = 4.0
    """Total number of writes, removals and reads per second."""


class Records(ClientWorkload):
    """The workload ``records``."""

    def __init__(self, team: Team, settings: RecordSettings) -> None:
        super().__init__(team, "records")
        self._pace = Pacer(team.clock, settings.rate)
        self._keys = [hash_key(f"records {number}") for number in range(settings.keys)]
        self._clients = Clients(team.history)

    def step(self) -> None:
        """Run the operations that are due, each at a random node."""
        for _ in range(self._pace.take_due()):
            for place in self._joined.any(self._rng):
                act, key = self._rng.choice(OPERATIONS), self._rng.choice(self._keys)
                if act == READ:
                    self._read(place, key)
                else:
                    self._clients.write(place, self._joined.node(place), key, NAME, act=act)

    def make_final_requests(self) -> None:
        """Let many nodes read all keys."""
        for place in self._joined.any(self._rng, MAX_READERS):
            for key in self._keys:
                self._read(place, key)

    def collect_metrics(self) -> list[Metric]:
        """Return the shares of answered requests; unanswered requests may have been executed."""
        asked, answered = self._clients.request_counts, self._clients.answer_counts
        return [
            make_share("records.acknowledged", answered[WRITE] + answered[REMOVE], asked[WRITE] + asked[REMOVE]),
            make_share("records.read", answered[READ], asked[READ]),
        ]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _read(self, place: int, key: bytes) -> None:
        self._clients.read(place, self._team.life_numbers[place], self._joined.node(place), key)
