"""Run one random schedule of nodes with losses, partitions, kills and restarts, observed by workloads.

Everything follows from the seed. At the end all faults end and killed nodes restart; after the repair interval the
workloads check their results.
"""

from __future__ import annotations

import random
from collections.abc import Sequence

from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import PERFECT, LinkConditions
from middleware.entangled.node import EntangledNode
from sim.team.checker import find_violations
from sim.team.event import Settled
from sim.team.faults.timeline import TimedFault, Timeline
from sim.team.shrinking import NO_REDUCTION, Reduction
from sim.team.simulation import EntangledTeam
from sim.team.workload import Workload

STRANDED_SHARE = 0.15
"""Share of schedules in which a partition separates a minority together with newcomers."""
STEP_S = 0.5
REPAIR_S = 45.0
"""Repair interval in seconds: retries, three rounds of anti-entropy, and the removal of a dead member."""


class Schedule:
    """The run of ``seed``: nodes, network conditions and faults.

    ``workloads`` are created when the nodes exist. The first workload uses ``rng``, and each further workload has its
    own generator, so that a seed that reveals a bug still reveals it when workloads are added. ``world`` creates the
    nodes; ``trim`` reduces the run.
    """

    def __init__(self, seed: int, world: type[EntangledTeam] = EntangledTeam, trim: Reduction = NO_REDUCTION) -> None:
        self.seed = seed
        self.trim = trim
        self.rng = random.Random(f"invariants/{seed}")
        generator = random.Random(f"faults/{seed}")
        self.n = generator.choice([3, 4, 5, 5, 6, 7, 9, 10, 11])
        self.seconds = generator.choice([20.0, 30.0, 45.0])
        self.team = world(self.n, seed, LinkConditions(delay_s=0.002))
        self.history = self.team.history
        self.lying_place: int | None = generator.randrange(self.n) if generator.random() < 0.2 else None
        self.conditions = LinkConditions(
            delay_s=generator.choice([0.001, 0.01, 0.05]),
            jitter_s=generator.choice([0.0, 0.01]),
            loss=generator.choice([0.0, 0.0, 0.05, 0.2]),
            duplicate=generator.choice([0.0, 0.1]),
            reorder=generator.choice([0.0, 0.2]),
        )
        self.faults = self._draw_faults(generator)
        if trim.calm:
            self.conditions = LinkConditions(delay_s=self.conditions.delay_s)
        generator = random.Random(f"stranded/{seed}")
        if generator.random() < STRANDED_SHARE and self.n <= 7:
            self.faults += self._draw_minority_faults(generator)
        self.seconds = trim.limit_duration(self.seconds)
        self.restarting: set[int] = set()
        """The places whose nodes will restart."""

    def alive(self) -> list[int]:
        """Return the places with running nodes."""
        return self.team.alive()

    def node(self, place: int) -> EntangledNode:
        """Return the node at a place in its present life."""
        return self.team.nodes[place]

    def addresses(self, places: Sequence[int]) -> list[Address]:
        """Return the addresses of these places."""
        return [self.team.address(place) for place in places]

    def run(self, workloads: Sequence[Workload]) -> list[str]:
        """Run the schedule; returns the violations, one line each."""
        team = self.team
        team.run(2.0)
        team.switchboard.conditions = self.conditions
        timeline, now = Timeline(self.faults, self.trim), 0.0
        while now < self.seconds:
            for fault, is_end in timeline.pop_due(now):
                (self._end_fault if is_end else self._start_fault)(fault)
            for workload in workloads:
                workload.step()
            team.run(STEP_S)
            now += STEP_S
        team.switchboard.heal()
        team.switchboard.conditions = PERFECT
        for place in sorted(self.restarting):
            self.restart(place)
        team.run(REPAIR_S)
        self.history.record(Settled)
        for workload in workloads:
            workload.make_final_requests()
        team.run(10.0)
        found = [line for workload in workloads for line in workload.find_violations()]
        team.stop()
        return found + find_violations(self.history)

    def restart(self, place: int) -> None:
        """Restart the node of a place with the store that it had before."""
        self.restarting.discard(place)
        others = sorted({*self.alive(), place})
        self.team.restart(place, [one for one in self.rng.sample(others, min(2, len(others))) if one != place])

    # -- inside -----------------------------------------------------------------------------------------------------

    def _draw_faults(self, generator: random.Random) -> list[TimedFault]:
        places, faults = list(range(self.n)), []
        # The nodes that fail permanently are never more than a minority of the smallest replica set.
        mortal = generator.sample(places, max(0, (min(self.n, 8) - 1) // 2))
        for _ in range(generator.randrange(1, 6)):
            at = generator.uniform(0.0, self.seconds * 0.8)
            until = at + generator.choice([0.5, 2.0, 8.0, 20.0])
            kind = generator.choice(["cut", "cut", "one way", "kill", "kill", "kill all", "die"])
            if kind == "cut":
                chosen = generator.sample(places, generator.randrange(1, self.n))
            elif kind == "one way":
                chosen = generator.sample(places, 2)
            elif kind == "kill":
                chosen = generator.sample(places, generator.randrange(1, 1 + self.n // 2))
            elif kind == "kill all":
                chosen = places if generator.random() < 0.3 else places[:1]
            else:
                chosen = [mortal.pop()] if mortal and generator.random() < 0.5 else []
            faults.append(TimedFault(at, until, kind, tuple(chosen)))
        return faults

    def _draw_minority_faults(self, generator: random.Random) -> list[TimedFault]:
        """Cut off a minority; new nodes join this minority until they and it together are a majority."""
        few = generator.sample(range(self.n), (self.n - 1) // 2)
        newcomers = range(self.n, 2 * self.n - 2 * len(few) + 1)
        at = generator.uniform(2.0, self.seconds * 0.5)
        faults = [TimedFault(at, at + generator.choice([8.0, 15.0]), "cut", (*few, *newcomers))]
        first = at + generator.choice([0.5, 2.0, 5.0])
        return faults + [TimedFault(first + n, first + n, "join", (place, *few)) for n, place in enumerate(newcomers)]

    def _start_fault(self, fault: TimedFault) -> None:
        switchboard = self.team.switchboard
        if fault.kind == "join":
            known: Sequence[int] = fault.places[1:]
            if not {*self.alive(), *self.restarting}.intersection(known):
                known = self.alive()[:1]  # a new node that knows only dead nodes could not join
            self.team.restart(len(self.team.nodes), known)
            self.n += 1
        elif fault.kind == "cut":
            switchboard.partition(self.addresses(fault.places))
        elif fault.kind == "one way":
            source, target = self.addresses(fault.places)
            switchboard.cut(source, target, one_way=True)
        else:
            for place in fault.places:
                if place in self.team.living:
                    if fault.kind != "die":
                        self.restarting.add(place)
                    self.team.kill(place)

    def _end_fault(self, fault: TimedFault) -> None:
        if fault.kind in ("cut", "one way"):
            self.team.switchboard.heal()
        elif fault.kind not in ("die", "join"):
            for place in fault.places:
                if place in self.restarting:
                    self.restart(place)
