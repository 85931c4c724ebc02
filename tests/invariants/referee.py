"""Referee: sees every lease, command and motion of a lease schedule at once, and calls what must not be (E1 to E9)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drivers.driver import Permit
from drivers.errors import StaleCommand
from drivers.gate import Gate
from middleware.commitment.ballot import quorum
from tests.invariants.bidder import WIRE, Bidder

if TYPE_CHECKING:
    from tests.invariants.team import Team

ROUGH = 0.06
"""E1: by this share of the ttl a device's count of a duration may differ from a clock that is 5 % off."""


class Referee:
    """What is known of each task: its device's gate, what that accepted, who won, whose robot still moves."""

    def __init__(self, world: Team) -> None:
        self.found: list[str] = []
        self.gates: dict[str, Gate] = {}
        self.accepted: dict[str, list[tuple[float, int, int]]] = {}
        self.is_amnesiac = False
        self.wins = 0
        self._world = world
        self._highest: dict[str, int] = {}
        self._won: dict[tuple[str, int], tuple[int, int]] = {}
        self._rest_at: dict[tuple[str, int], float] = {}
        self._over: dict[str, float] = {}
        self._unreachable_since: dict[tuple[str, int], float] = {}

    def add(self, task_id: str) -> None:
        """Watch one more task."""
        self.gates[task_id] = Gate()
        self.accepted[task_id] = []
        self._highest[task_id] = 0

    def ended(self, task_id: str) -> None:
        """The end of a task is acknowledged: what is on the wire to the device may still arrive."""
        self._over[task_id] = self._world.clock.seconds() + WIRE

    def is_over(self, task_id: str) -> bool:
        """Whether the end of a task was acknowledged."""
        return task_id in self._over

    def on_change(self, bidder: Bidder, task_id: str) -> None:
        """E2 and the motion, looked at whenever a lease is won or renewed: whatever overlaps, overlaps then."""
        lease = bidder.lessees[task_id].lease
        if lease is None:
            return
        now = self._world.clock.seconds()
        mine = (task_id, bidder.place)
        is_new = self._won.get(mine) != (lease.token, id(bidder))
        self._won[mine] = lease.token, id(bidder)
        if self._world.drift <= 0.01:
            self._check_alone(bidder, task_id, now)
        if not is_new:
            return
        self.wins += 1
        self._world.radio.note("won", task_id, bidder.place, lease.token, now)
        highest = self._highest[task_id]
        if lease.token <= highest and not self.is_amnesiac:
            self.say("E1", f"token {lease.token} of {task_id} is granted to {bidder.place} after {highest}")
        self._highest[task_id] = max(highest, lease.token)
        since = self._unreachable_since.get((task_id, bidder.place))
        if since is not None and now > since + self._world.ttl / 3 + self._world.radio.longest_way + 0.1:
            self.say("E9", f"{bidder.place} wins {task_id} at {now:.2f}, cut from the majority since {since:.2f}")

    def _check_alone(self, bidder: Bidder, task_id: str, now: float) -> None:
        for other in self._world.bidders:
            lessee = other.lessees.get(task_id)
            if other is bidder:
                continue
            if lessee is not None and lessee.lease is not None and other.machine.is_alive:
                self.say("E2", f"{bidder.place} and {other.place} hold {task_id} at {now:.2f}")
            if self._rest_at.get((task_id, other.place), 0.0) > now + 1e-6:
                self.say("E2", f"the robot of {other.place} moves for {task_id} at {now:.2f}, {bidder.place} holds it")

    def on_issue(self, bidder: Bidder, task_id: str, permit: Permit) -> None:
        """E8: what an agent sends is under a lease that is in force, also when it has just been thawed."""
        now, end = self._world.clock.seconds(), bidder.machine.at(permit.deadline)
        real = self._true_deadline(bidder, permit)
        if self._world.drift <= 0.01 and now > max(end, real) + 1e-6 or now > real + ROUGH * self._world.ttl:
            self.say("E8", f"{bidder.place} commands for {task_id} at {now:.2f}, its lease ended at {real:.2f}")

    def _true_deadline(self, bidder: Bidder, permit: Permit) -> float:
        """When the lease ends on a clock of that rate that never stood still."""
        machine = bidder.machine
        return (permit.deadline - machine.offset) / machine.rate

    def on_command(self, bidder: Bidder, task_id: str, permit: Permit, told: float, remaining: float) -> None:
        """E1 and E5: the device, shared by all, takes a command or refuses it."""
        now, gate = self._world.clock.seconds(), self.gates[task_id]
        deadline = min(told, now) + remaining
        accepted = self.accepted[task_id]
        before = accepted[-1][1] if accepted else 0
        try:
            gate.admit(Permit(permit.token, deadline), now)
        except StaleCommand:
            if gate.token is not None and permit.token < gate.token and bidder.machine.is_alive:
                bidder.machine.take(bidder.lessees[task_id].outrank, gate.token)
            return
        real = self._true_deadline(bidder, permit)
        if permit.token < before:
            self.say("E1", f"the device of {task_id} takes token {permit.token} after {before}")
        if now > real + ROUGH * self._world.ttl:
            self.say("E1", f"the device of {task_id} takes a command {now - real:.2f} s after its lease ended")
        over_at = self._over.get(task_id)
        if over_at is not None:
            self.say("E5", f"the device of {task_id} obeys {bidder.place} at {now:.2f}, it ended at {over_at:.2f}")
        since = self._unreachable_since.get((task_id, bidder.place))
        if since is not None and now > since + self._world.ttl * 1.1 + self._world.radio.longest_way:
            self.say("E9", f"{bidder.place} acts on {task_id} at {now:.2f}, cut from the majority since {since:.2f}")
        accepted.append((now, permit.token, bidder.place))
        self._rest_at[task_id, bidder.place] = deadline + self._world.stop_time

    def floor(self, place: int, task_id: str) -> int:
        """The highest token that the robot of a place has obeyed, and tells its agent."""
        return max((token for _, token, one in self.accepted[task_id] if one == place), default=0)

    def stop(self, place: int, task_id: str) -> None:
        """The agent stops its robot, which comes to rest; on the wire a stop does not overtake a command."""
        self._world.clock.callLater(WIRE, self._stop, place, task_id)

    def _stop(self, place: int, task_id: str) -> None:
        rest_at = self._rest_at.get((task_id, place), 0.0)
        self._rest_at[task_id, place] = min(rest_at, self._world.clock.seconds() + self._world.stop_time)

    def say(self, invariant: str, text: str) -> None:
        """Note a violation."""
        line = f"{invariant}: {text}"
        if line not in self.found and len(self.found) < 20:
            self.found.append(line)

    def look_at_cuts(self) -> None:
        """Note who cannot reach a majority of the council, both ways, and since when."""
        now = self._world.clock.seconds()
        for task_id, (members, _) in self._world.councils.items():
            places = [self._world.place_of(member) for member in members]
            for agent in self._world.agents:
                near = [p for p in places if not {(agent, p), (p, agent)} & self._world.radio.cut]
                if len(near) >= quorum(len(places)):
                    self._unreachable_since.pop((task_id, agent), None)
                else:
                    self._unreachable_since.setdefault((task_id, agent), now)
