"""The workload of leases: agents claim, keep, lose and return leases under all faults.

The workload checks the invariants E1 to E3, E5, E8 and E9. Its world is small, so a thousand schedules take two
minutes; it consists of the classes of the protocol, simulated machines and a simulated link. The assignments are
random, because leases must be exclusive for any assignment.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

from twisted.internet.defer import Deferred

from middleware.consensus.lease.lease_client import STAGGER_S
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError
from sim.team.clients import record_outcome
from sim.team.event import CommandExpected
from sim.team.faults.timeline import TimedFault, Timeline
from sim.team.leases.radio_link import DEFAULT_QUALITY, LinkQuality
from sim.team.leases.team import LeaseTeam
from sim.team.shrinking import NO_REDUCTION, Reduction

TTL = 1.5
SLACK = 0.8
"""The maximum time in seconds beyond the TTL until another agent executes, if only the executor has failed (E3)."""
LEAVE = 0.2
"""The maximum time in seconds, beyond the time to stop, until a standby gets a returned lease."""


KINDS = (
    "cut", "cut", "one way", "swizzle", "kill", "kill", "wipe", "freeze", "freeze", "suspend", "change", "change",
    "torn change", "leave", "air", "step", "blackout",
)  # fmt: skip


def draw_faults(rng: random.Random, n: int, agents: Sequence[int], has_stores: bool) -> list[TimedFault]:
    """Return random faults for a schedule with ``n`` nodes; nodes with agents are chosen more often."""
    faults = []
    for _ in range(rng.choice([1, 2, 3, 3, 4, 6])):
        at = rng.uniform(0.5, 12.0)
        kind = rng.choice(KINDS)
        seconds = rng.choice([0.5, 1.0, 2.0, 2.0, 3.0, 5.0, 10.0])
        count = rng.choice([1, 1, 2, 3]) if kind in ("kill", "wipe", "freeze", "cut") else 1
        places = tuple(rng.sample(range(n), min(count, n - 1)))
        if rng.random() < 0.4:
            places = (rng.choice(agents), *places[1:])
        if kind == "blackout":
            kind, places = "kill", tuple(range(n))
        if kind == "wipe" and has_stores:
            kind = "kill"
        faults.append(TimedFault(at, at + seconds, kind, places))
    return faults


class Leases(LeaseTeam):
    """A schedule of the workload, which ``seed`` completely determines."""

    def __init__(self, seed: int, trim: Reduction = NO_REDUCTION, ttl: float = TTL) -> None:
        rng = self._schedule_rng = random.Random(f"leases/{seed}")
        n = rng.choice([4, 5, 5, 6, 7])
        agents = rng.choice([2, 3, 3, 4])
        stop_time = rng.choice([0.0, 0.0, 0.3])
        drift = rng.choice([0.0, 0.01, 0.01, 0.01, 0.05])
        # The worst permitted combination of clocks, a slow holder and fast members, must occur often.
        rates = [1.0 + rng.choice([-1, 1]) * drift for _ in range(n)]
        # Without stores a restarted member loses all its state; councils then do not change, and tokens may decrease.
        has_stores = rng.random() < 0.7
        super().__init__(f"leases/{seed}", rates, agents, ttl, stop_time, drift, has_stores)
        self.air = LinkQuality(
            rng.choice([0.001, 0.005, 0.02, 0.05, 0.2]),
            rng.choice([0.0, 0.01, 0.05]),
            rng.choice([0.0, 0.05, 0.1, 0.2, 0.3, 0.5]),
            rng.choice([0.0, 0.1, 0.3]),
            rng.choice([1.0, 1.0, 5.0]),
        )
        if trim.calm:
            self.air = LinkQuality(self.air.delay)
        self.faults = draw_faults(rng, n, self.agents, has_stores)
        self._trim = trim
        self.seconds = 0.0
        self._is_well = False
        for task_id in ["t0", "t1"][: rng.choice([1, 1, 2])]:
            size = 5 if n >= 5 and rng.random() < 0.25 else 3
            self.add_task(task_id, sorted(rng.sample(range(n), size)))

    # -- the run ----------------------------------------------------------------------------------------------------

    @property
    def digest(self) -> str:
        """Return the hash of all messages that arrived, with their times."""
        return self.switchboard.digest()

    def __str__(self) -> str:
        """Describe the schedule."""
        stores = "stores" if self.has_stores else "no stores"
        return f"n={self.n} agents={len(self.agents)} drift={self.drift} stop={self.stop_time} {stores} {self.air} " + (
            "; ".join(map(str, self.faults))
        )

    def run(self) -> list[str]:  # type: ignore[override]
        """Run the faults and then a phase without faults; return one line per violation."""
        self.clock.advance(self.ttl + 0.1)
        self.radio.quality = self.air
        self.recorder.record_assumptions()
        timeline = Timeline(self.faults, self._trim)
        self.seconds = end = self._trim.limit_duration(self._schedule_rng.choice([8.0, 12.0, 16.0]))
        started_at = self.clock.seconds()
        while self.clock.seconds() - started_at < end:
            for fault, is_end in timeline.pop_due(self.clock.seconds() - started_at):
                (self._end if is_end else self._begin)(fault)
            self._choose()
            self.clock.advance(0.25)
        self._heal()
        for task_id in self.charters:
            self._verify_health(task_id)
        return self.recorder.violations

    def _choose(self) -> None:
        """Let random agents claim, stand by, leave or suspect the holder."""
        for task_id in self.charters:
            for place in self.agents:
                bidder = self.nodes[place]
                if bidder.machine.is_frozen or not bidder.machine.is_alive or self._schedule_rng.random() > 0.25:
                    continue
                fate = self._schedule_rng.random()
                if fate < 0.35:
                    bidder.get_lease_client(task_id).claim()
                elif fate < 0.75:
                    bidder.get_lease_client(task_id).stand_by(self._schedule_rng.choice([1, 1, 2, 3]))
                elif fate < 0.85:
                    bidder.leave(task_id)
                elif fate < 0.9:
                    bidder.get_lease_client(task_id).suspect_holder()

    def _heal(self) -> None:
        self._is_well = True
        self.radio.cut.clear()
        self.recorder.record_reachability()
        self.radio.quality = DEFAULT_QUALITY
        for place, bidder in enumerate(self.nodes):
            if bidder.machine.is_frozen:
                bidder.machine.thaw()
            if not bidder.machine.is_alive:
                self.nodes[place] = self.start_life(place)

    def _verify_health(self, task_id: str) -> None:
        """Without faults, let one agent after the other leave; check invariants E3 and E5, and the graceful leave."""
        if not self.has_stores:
            # A lease that no member remembers must end first, because the next lease may have the same token.
            self.clock.advance(self.ttl)
        for rank, place in enumerate(self._schedule_rng.sample(self.agents, len(self.agents))):
            lease_client = self.nodes[place].get_lease_client(task_id)
            if rank:
                lease_client.stand_by(rank)
            else:
                lease_client.claim()
        # A restarted member is silent for one TTL, and a device may have to report its token first.
        since, most = self.clock.seconds(), 2 * self.ttl + SLACK + 1.0
        if not self._wait_for_command(task_id, f"there are no faults, task {task_id}", 0, since, most, most):
            return
        self.clock.advance(self._schedule_rng.uniform(0.7, 1.3) * self.ttl)
        _, token, holder = self.recorder.accepted[task_id][-1]
        self._depart_politely(task_id, token, holder)
        self.clock.advance(self._schedule_rng.uniform(0.7, 1.3) * self.ttl)
        _, token, holder = self.recorder.accepted[task_id][-1]
        self._depart_suddenly(task_id, token, holder)
        self._conclude(task_id)

    def _depart_politely(self, task_id: str, token: int, holder: int) -> None:
        left_at = self.clock.seconds()
        self.nodes[holder].leave(task_id)
        within = self.stop_time + LEAVE + 0.1 + 0.1 * len(self.agents)
        self._wait_for_command(task_id, f"{holder} returns {task_id}", token, left_at, within, 2 * self.ttl + SLACK)
        self.nodes[holder].get_lease_client(task_id).stand_by(len(self.agents))

    def _depart_suddenly(self, task_id: str, token: int, holder: int) -> None:
        """Kill, freeze or disconnect the executing agent together with a member of the council."""
        gone_at, rng = self.clock.seconds(), self._schedule_rng
        members = [self.get_place(member) for member in self.charters[task_id].members]
        spare = [place for place in members if place not in self.agents]
        also = [rng.choice(spare)] if spare and holder not in members else []
        how = rng.choice(["kill", "freeze", "suspend", "cut"])
        self._begin(TimedFault(0, 0, how, (holder, *also)))
        others = [place for place in self.agents if place != holder]
        within = self.ttl / (1.0 - self.drift) + SLACK + STAGGER_S * (len(self.agents) - 1)
        if len(others) > 1 and rng.random() < 0.75:
            # The strategy assigns one agent when the lease ends, and then a different one.
            fickle = rng.choice(others)
            self.nodes[fickle].leave(task_id)
            self.clock.advance(rng.uniform(0.8, 1.0) * self.ttl)
            self.nodes[fickle].get_lease_client(task_id).claim()
            while self.clock.seconds() < gone_at + 1.1 * self.ttl and self.recorder.accepted[task_id][-1][1] <= token:
                self.clock.advance(rng.choice([0.004, 0.011, 0.017]))
                if rng.random() < 0.2:
                    break
            # A robot that this agent has moved must stop first.
            within += self.stop_time if self.nodes[fickle].has_lease(task_id) else 0.0
            self.nodes[fickle].leave(task_id)
        why = f"{holder}, holder of {task_id}, has failed ({how})"
        self._wait_for_command(task_id, why, token, gone_at, within, 3 * self.ttl + SLACK)
        self._heal()

    def _conclude(self, task_id: str) -> None:
        """Let the executing agent complete the task, or let the last node cancel the task.

        After the acknowledgement no robot may move.
        """
        _, token, holder = self.recorder.accepted[task_id][-1]
        place = self._schedule_rng.choice([holder, self.n - 1])
        if place == holder:
            self.recorder.stop_robot(holder, task_id)
        history = self.recorder.history
        asked = history.record_request(place, "close", task_id)
        lease_client = self.nodes[place].get_lease_client(task_id)
        closing: Deferred[Any] = lease_client.close_task(token) if place == holder else lease_client.proposer.close()

        def ended(_: object) -> None:
            lease_client.release()

        record_outcome(history, asked, closing.addCallback(ended))
        self.clock.advance(2 * self.ttl)
        for agent in self.agents:
            self.nodes[agent].get_lease_client(task_id).claim()
        self.clock.advance(2 * self.ttl)

    def _wait_for_command(self, task_id: str, why: str, above: int, since: float, within: float, most: float) -> bool:
        """Wait up to ``most`` s for a command with a token above ``above``.

        The command is due ``within`` s after ``since``.
        """
        started_at = self.clock.seconds()
        self.recorder.history.record(CommandExpected, task_id, why, above, since, within)
        accepted = self.recorder.accepted[task_id]
        while self.clock.seconds() - started_at < most:
            if accepted and accepted[-1][1] > above and accepted[-1][0] >= started_at:
                return True
            self.clock.advance(0.02)
        return False

    # -- faults -----------------------------------------------------------------------------------------------------

    def _begin(self, fault: TimedFault) -> None:
        match fault.kind:
            case "cut":
                self._part(fault.places)
            case "one way":
                self.radio.cut |= {(a, b) for a in fault.places for b in set(range(self.n)).difference(fault.places)}
            case "swizzle":
                order = self._schedule_rng.sample(range(self.n), self.n // 2)
                for number, place in enumerate(order):
                    self.clock.callLater(0.2 * number, self._clog, place)
            case "kill" | "wipe":
                for place in fault.places:
                    self.kill(place)
            case "freeze" | "suspend":
                for place in fault.places:
                    if self.nodes[place].machine.is_alive and not self.nodes[place].machine.is_frozen:
                        self.nodes[place].machine.freeze(fault.kind == "suspend")
            case "change":
                self._change(fault.places[0])
            case "torn change":
                self._change(fault.places[0], is_torn=True)
            case "leave":
                for task_id in self.charters:
                    if self.is_up(fault.places[0]):
                        self.nodes[fault.places[0]].leave(task_id)
            case "air":
                self.radio.quality = LinkQuality(self.air.delay, self.air.jitter, 0.5, 0.3, 5.0)
        self.recorder.record_reachability()

    def _end(self, fault: TimedFault) -> None:
        match fault.kind:
            case "cut" | "one way" | "swizzle" | "torn change":
                self.radio.cut.clear()
            case "kill" | "wipe":
                for place in fault.places:
                    if not self.nodes[place].machine.is_alive:
                        self.nodes[place] = self.start_life(place)
            case "freeze" | "suspend":
                for place in fault.places:
                    if self.nodes[place].machine.is_frozen:
                        self.nodes[place].machine.thaw()
            case "air":
                self.radio.quality = self.air
        self.recorder.record_reachability()

    def _clog(self, *places: int) -> None:
        """Disconnect the nodes with these numbers, unless the phase without faults has begun."""
        if not self._is_well:
            self._part(places)
            self.recorder.record_reachability()

    def _part(self, places: Sequence[int]) -> None:
        rest = [place for place in range(self.n) if place not in places]
        self.radio.cut |= {pair for a in places for b in rest for pair in ((a, b), (b, a))}

    def _change(self, place: int, is_torn: bool = False) -> None:
        """Let a node change the council when it considers the task free or holds the task's lease itself.

        With ``is_torn``, nodes outside the present council are preferred as members, and only the new members and the
        node learn of the change.
        """
        if not self.is_up(place) or not self.has_stores:
            return
        for task_id in self.charters:
            if self._schedule_rng.random() < 0.7:
                for agent in self.agents:
                    if self.is_up(agent) and self._schedule_rng.random() < 0.9:
                        self.nodes[agent].leave(task_id)
            chosen = sorted(self._schedule_rng.sample(range(self.n), 3))
            if is_torn:
                sitting = [self.get_place(member) for member in self.charters[task_id].members]
                chosen = sorted(range(self.n), key=lambda n: n in sitting)[:3]
                self.clock.callLater(0.4 + self.stop_time, self._clog, place, *chosen)
            members = [self.contacts[n] for n in chosen]
            self.clock.callLater(0.5 + self.stop_time, self._change_now, place, task_id, members)

    def _change_now(self, place: int, task_id: str, members: Sequence[Contact]) -> None:
        if self.is_up(place):
            self.recorder.stop_robot(place, task_id)
            changing: Deferred[None] = self.nodes[place].get_lease_client(task_id).change_council(members)
            changing.addErrback(lambda failure: failure.trap(EntangledError))
