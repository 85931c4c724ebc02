"""Schedule: one random run of a fleet under loss, partitions, kills and restarts, with workloads that watch it.

Everything follows from the seed.  After the faults everything heals, those that are to come back come back, and when
the repair interval is over the workloads give their verdicts.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from typing import Protocol

from middleware.entangled.errors import NotRunning
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import CALM, Weather
from middleware.entangled.node import EntangledNode
from sim.team.checker import check
from sim.team.event import Born, Died, Settled
from sim.team.faults.timeline import TimedFault, Timeline
from sim.team.history import History
from sim.team.shrink import WHOLE, Trim
from sim.team.world import Fleet

STRANDED = 0.15
"""The share of schedules in which a cut leaves a few with newcomers of their own."""
STEP = 0.5
SETTLE = 45.0
"""Seconds after which a healed team is as it should be: tries, three rounds of mending, and a struck member."""


Watcher = Callable[[int, EntangledNode], object]
"""Called with a place and its node."""


class Workload(Protocol):
    """What clients do beside the faults; they write down in the history what they asked for and what they got."""

    def step(self) -> None:
        """Do something, every ``STEP`` seconds while the faults last."""

    def settled(self) -> None:
        """The faults are over and the repair interval has passed: ask what is to be asked; 10 s are left for it."""

    def verdict(self) -> list[str]:
        """Write down how things stand at the end; what only the workload itself can judge, a line each."""


class Schedule:
    """The run of ``seed``: a fleet, its weather and its faults.

    ``workloads`` are made with the schedule when the fleet stands.  ``rng`` is for the first of them; the others have
    dice of their own, so that the seeds that show a bug go on showing it.  ``world`` is what makes the nodes;
    ``life`` has the number of each place's present life.  ``trim`` says what is left of it.
    """

    def __init__(self, seed: int, world: type[Fleet] = Fleet, trim: Trim = WHOLE) -> None:
        self.seed = seed
        self.trim = trim
        self.rng = random.Random(f"invariants/{seed}")
        dice = random.Random(f"faults/{seed}")
        self.n = dice.choice([3, 4, 5, 5, 6, 7, 9, 10, 11])
        self.seconds = dice.choice([20.0, 30.0, 45.0])
        self.fleet = world(self.n, seed, Weather(delay_s=0.002))
        self.history = History(self.fleet.clock.seconds)
        self.liar: int | None = dice.randrange(self.n) if dice.random() < 0.2 else None
        self.weather = Weather(
            delay_s=dice.choice([0.001, 0.01, 0.05]),
            jitter_s=dice.choice([0.0, 0.01]),
            loss=dice.choice([0.0, 0.0, 0.05, 0.2]),
            duplicate=dice.choice([0.0, 0.1]),
            reorder=dice.choice([0.0, 0.2]),
        )
        self.faults = self._faults(dice)
        if trim.calm:
            self.weather = Weather(delay_s=self.weather.delay_s)
        dice = random.Random(f"stranded/{seed}")
        if dice.random() < STRANDED and self.n <= 7:
            self.faults += self._stranded(dice)
        self.seconds = trim.within(self.seconds)
        self.down: set[int] = set()
        self.dead: set[int] = set()
        self.life: dict[int, int] = {}
        self._on_birth: list[Watcher] = []
        self._on_death: list[Watcher] = []
        self.attend(self._born, lambda place, node: self.history.note(Died, place, self.fleet.forgets(place)))

    def alive(self) -> list[int]:
        """The places whose nodes run."""
        return [place for place in range(self.n) if place not in self.down and place not in self.dead]

    def node(self, place: int) -> EntangledNode:
        """The node of a place, in its present life."""
        return self.fleet.nodes[place]

    def attend(self, born: Watcher, died: Watcher) -> None:
        """Call ``born`` with every node that lives, and with each that is made later before it starts, and ``died``."""
        self._on_birth.append(born)
        self._on_death.append(died)
        for place in self.alive():
            born(place, self.node(place))

    def is_calm(self) -> bool:
        """Whether no fault lasts and the weather is over."""
        return self.fleet.board.weather is CALM and not self.down

    def addresses(self, places: Sequence[int]) -> list[Address]:
        """Where those places listen."""
        return [self.fleet.address(place) for place in places]

    def run(self, workloads: Sequence[Workload]) -> list[str]:
        """Run everything; the violations, a line each."""
        fleet = self.fleet
        fleet.run(2.0)
        fleet.board.weather = self.weather
        timeline, now = Timeline(self.faults, self.trim), 0.0
        while now < self.seconds:
            for fault, is_end in timeline.due(now):
                (self._end if is_end else self._begin)(fault)
            for workload in workloads:
                workload.step()
            fleet.run(STEP)
            now += STEP
        fleet.board.heal()
        fleet.board.weather = CALM
        for place in sorted(self.down):
            self.restart(place)
        fleet.run(SETTLE)
        self.history.note(Settled)
        for workload in workloads:
            workload.settled()
        fleet.run(10.0)
        found = [line for workload in workloads for line in workload.verdict()]
        fleet.stop()
        return found + check(self.history)

    def restart(self, place: int) -> None:
        """Let the node of a place live again, on the store of its former life."""
        self.down.discard(place)
        others = self.alive()
        known = [other for other in self.rng.sample(others, min(2, len(others))) if other != place]
        node = self.fleet.nodes[place] = self.fleet.made(place)
        for born in self._on_birth:
            born(place, node)
        # It may be killed again before it has found anybody.
        self.fleet.enter(node, self.addresses(known)).addErrback(lambda failure: failure.trap(NotRunning))

    # -- inside -----------------------------------------------------------------------------------------------------

    def _born(self, place: int, node: EntangledNode) -> None:
        life = self.life[place] = self.life.get(place, 0) + 1
        identity, address = node.identity, self.fleet.address(place)
        self.history.note(Born, place, life, identity.public, identity.node_id, str(address))

    def _faults(self, dice: random.Random) -> list[TimedFault]:
        places, faults = list(range(self.n)), []
        # As many may die for good as a majority can do without, one quorum of the smallest record kept.
        mortal = dice.sample(places, max(0, (min(self.n, 8) - 1) // 2))
        for _ in range(dice.randrange(1, 6)):
            at = dice.uniform(0.0, self.seconds * 0.8)
            until = at + dice.choice([0.5, 2.0, 8.0, 20.0])
            kind = dice.choice(["cut", "cut", "one way", "kill", "kill", "kill all", "die"])
            if kind == "cut":
                chosen = dice.sample(places, dice.randrange(1, self.n))
            elif kind == "one way":
                chosen = dice.sample(places, 2)
            elif kind == "kill":
                chosen = dice.sample(places, dice.randrange(1, 1 + self.n // 2))
            elif kind == "kill all":
                chosen = places if dice.random() < 0.3 else places[:1]
            else:
                chosen = [mortal.pop()] if mortal and dice.random() < 0.5 else []
            faults.append(TimedFault(at, until, kind, tuple(chosen)))
        return faults

    def _stranded(self, dice: random.Random) -> list[TimedFault]:
        """Less than half are cut off, and so many newcomers join them that together they are more than half."""
        few = dice.sample(range(self.n), (self.n - 1) // 2)
        newcomers = range(self.n, 2 * self.n - 2 * len(few) + 1)
        at = dice.uniform(2.0, self.seconds * 0.5)
        faults = [TimedFault(at, at + dice.choice([8.0, 15.0]), "cut", (*few, *newcomers))]
        first = at + dice.choice([0.5, 2.0, 5.0])
        return faults + [TimedFault(first + n, first + n, "join", (place, *few)) for n, place in enumerate(newcomers)]

    def _join(self, place: int, known: Sequence[int]) -> None:
        """A newcomer joins through ``known``."""
        node = self.fleet.made(place)
        self.fleet.nodes.append(node)
        self.n += 1
        for born in self._on_birth:
            born(place, node)
        self.fleet.enter(node, self.addresses(known)).addErrback(lambda failure: failure.trap(NotRunning))

    def _begin(self, fault: TimedFault) -> None:
        board = self.fleet.board
        if fault.kind == "join":
            place, *known = len(self.fleet.nodes), *fault.places[1:]
            if self.dead.issuperset(known):
                known = self.alive()[:1]  # who knows nobody but the dead never gets in
            self._join(place, known)
        elif fault.kind == "cut":
            board.partition(self.addresses(fault.places))
        elif fault.kind == "one way":
            source, target = self.addresses(fault.places)
            board.cut(source, target, one_way=True)
        else:
            for place in fault.places:
                if place in self.down or place in self.dead:
                    continue
                (self.dead if fault.kind == "die" else self.down).add(place)
                for died in self._on_death:
                    died(place, self.node(place))
                self.fleet.kill(place)

    def _end(self, fault: TimedFault) -> None:
        if fault.kind in ("cut", "one way"):
            self.fleet.board.heal()
        elif fault.kind not in ("die", "join"):
            for place in fault.places:
                if place in self.down:
                    self.restart(place)
