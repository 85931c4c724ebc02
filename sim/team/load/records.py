"""Records: clients write, remove and read a few slots, and write down what they were told; the checker judges it.

Nothing is measured here but how much is answered: whether it is right, fresh and lasting is D1 to D4 and D7 of
``sim.team.invariant.durability``, over the team's history.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from middleware.entangled.record import hashed_key
from sim.team.clients import READ, REMOVE, WRITE, Clients
from sim.team.figure import Figure, share
from sim.team.load.residents import Load, Pace
from sim.team.team import Team

NAME = "r"
"""Of the one slot that each node has under a key."""
ACTS = (WRITE, WRITE, REMOVE, READ, READ, READ)
MOST_READERS = 32
"""Nodes that read everything at the end: in a network of thousands not all of them."""


@dataclass(frozen=True)
class RecordSettings:
    """``[load.records]``: how much is written and read."""

    keys: Annotated[int, Meta(ge=1, le=10_000)] = 4
    """Keys that all write under, each in a slot of its own."""

    rate: Annotated[float, Meta(ge=0.001, le=10_000.0)] = 4.0
    """Writes, removals and reads in a second, in all."""


class Records(Load):
    """The workload ``records``."""

    def __init__(self, team: Team, settings: RecordSettings) -> None:
        super().__init__(team, "records")
        self._pace = Pace(team.clock, settings.rate)
        self._keys = [hashed_key(f"records {number}") for number in range(settings.keys)]
        self._clients = Clients(team.history)

    def step(self) -> None:
        """What is due, each at a random node."""
        for _ in range(self._pace.due()):
            for place in self._residents.any(self._rng):
                act, key = self._rng.choice(ACTS), self._rng.choice(self._keys)
                if act == READ:
                    self._read(place, key)
                else:
                    self._clients.write(place, self._residents.node(place), key, NAME, act=act)

    def settled(self) -> None:
        """Many read everything."""
        for place in self._residents.any(self._rng, MOST_READERS):
            for key in self._keys:
                self._read(place, key)

    def figures(self) -> list[Figure]:
        """How much was answered; what was not may have been done."""
        asked, answered = self._clients.asked, self._clients.answered
        return [
            share("records.acknowledged", answered[WRITE] + answered[REMOVE], asked[WRITE] + asked[REMOVE]),
            share("records.read", answered[READ], asked[READ]),
        ]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _read(self, place: int, key: bytes) -> None:
        self._clients.read(place, self._team.life[place], self._residents.node(place), key)
