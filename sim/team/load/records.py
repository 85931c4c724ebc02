"""Records: clients write, remove and read a few slots, and write down what they were told; the checker judges it.

Nothing is measured here but how much is answered: whether it is right, fresh and lasting is D1 to D4 and D7 of
``sim.team.invariant.durability``, over the team's history.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from twisted.python.failure import Failure

from middleware.entangled.errors import EntangledError, Unavailable
from middleware.entangled.record import Record, hashed_key
from middleware.setting import number, whole
from sim.team.figure import Figure, share
from sim.team.invariant.durability import MAJORITY, Slot
from sim.team.load.pace import Pace
from sim.team.load.residents import Residents
from sim.team.team import Team

WRITE, REMOVE, READ = "write", "remove", "read"
"""As the checker knows what is asked."""
ACTS = (WRITE, WRITE, REMOVE, READ, READ, READ)
MOST_READERS = 32
"""Nodes that read everything at the end: in a network of thousands not all of them."""


@dataclass(frozen=True)
class RecordSettings:
    """``[load.records]``: how much is written and read."""

    keys: int = field(default=4, metadata=whole(1, 10_000))
    """Keys that all write under, each in a slot of its own."""

    rate: float = field(default=4.0, metadata=number(0.001, 10_000.0))
    """Writes, removals and reads in a second, in all."""


class Records:
    """The workload ``records``."""

    def __init__(self, team: Team, settings: RecordSettings) -> None:
        self._team = team
        self._history = team.history
        self._rng = team.rng("records")
        self._residents = Residents(team)
        self._pace = Pace(team.clock, settings.rate)
        self._keys = [hashed_key(f"records {number}") for number in range(settings.keys)]
        self._written: Counter[Slot] = Counter()
        self.asked: Counter[str] = Counter()
        self.answered: Counter[str] = Counter()

    def step(self) -> None:
        """What is due, each at a random node."""
        for _ in range(self._pace.due()):
            for place in self._residents.any(self._rng):
                act, key = self._rng.choice(ACTS), self._rng.choice(self._keys)
                if act == READ:
                    self._read(place, key)
                else:
                    self._write(place, key, act)

    def settled(self) -> None:
        """Many read everything."""
        for place in self._residents.any(self._rng, MOST_READERS):
            for key in self._keys:
                self._read(place, key)

    def verdict(self) -> list[str]:
        """Nothing: the checker has it."""
        return []

    def figures(self) -> list[Figure]:
        """How much was answered; what was not may have been done."""
        writes = self.asked[WRITE] + self.asked[REMOVE]
        return [
            share("records.acknowledged", self.answered[WRITE] + self.answered[REMOVE], writes),
            share("records.read", self.answered[READ], self.asked[READ]),
        ]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _write(self, place: int, key: bytes, act: str) -> None:
        node = self._residents.node(place)
        slot = Slot(key, node.identity.public, "r")
        self._written[slot] += 1
        count = self._written[slot]
        number = self._history.asked(place, act, slot, count)
        self.asked[act] += 1
        done = node.put(key, slot.name, b"%d" % count) if act == WRITE else node.remove(key, slot.name)
        done.addCallbacks(lambda _: self._told(number, act), self._failed, errbackArgs=(number,))

    def _read(self, place: int, key: bytes) -> None:
        # Another life of a node is another client: what it has read itself it may have forgotten.
        client = place, self._team.place(place).lives
        number = self._history.asked(client, READ, key, MAJORITY)
        self.asked[READ] += 1
        self._residents.node(place).get(key).addCallbacks(self._shown, self._failed, (number,), {}, (number,))

    def _shown(self, records: list[Record], number: int) -> None:
        self._told(number, READ, {Slot(*record.slot): int(record.value or b"0") for record in records})

    def _told(self, number: int, act: str, result: object = None) -> None:
        self.answered[act] += 1
        self._history.answered(number, result)

    def _failed(self, failure: Failure, number: int) -> None:
        failure.trap(EntangledError)
        self._history.unanswered(number, failure.value, failure.check(Unavailable) is not None)
