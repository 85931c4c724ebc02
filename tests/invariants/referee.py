"""Referee: sees every lease, command and motion of a lease schedule at once, and writes them down (E1 to E9)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from drivers.driver import Permit
from drivers.errors import StaleCommand
from drivers.gate import Gate
from middleware.entangled.quorum.ballot import majority
from sim.team.checker import check
from sim.team.event import Commanded, Halted, Held, Issued, Reached, Terms, Won
from sim.team.history import History
from tests.invariants.bidder import WIRE, Bidder

if TYPE_CHECKING:
    from tests.invariants.team import Team


class Referee:
    """The history of a team, and of each task its device's gate, what that accepted, and who won."""

    def __init__(self, world: Team) -> None:
        self.history = History(world.clock.seconds)
        self.gates: dict[str, Gate] = {}
        self.accepted: dict[str, list[tuple[float, int, int]]] = {}
        self.wins = 0
        self._world = world
        self._won: dict[tuple[str, int], tuple[int, int]] = {}
        self._is_cut: set[tuple[str, int]] = set()

    @property
    def found(self) -> list[str]:
        """Every violation so far, a line each."""
        return check(self.history)

    def agree(self) -> None:
        """Write down what is assumed from now on."""
        world = self._world
        self.history.note(Terms, world.ttl, world.drift, world.stop_time, world.radio.longest_way)

    def add(self, task_id: str) -> None:
        """Watch one more task."""
        self.gates[task_id] = Gate()
        self.accepted[task_id] = []

    def on_change(self, bidder: Bidder, task_id: str) -> None:
        """A lease was won or renewed: write down who else holds it by his own clock."""
        lease = bidder.lessees[task_id].lease
        if lease is None:
            return
        mine = (task_id, bidder.place)
        is_new = self._won.get(mine) != (lease.token, id(bidder))
        self._won[mine] = lease.token, id(bidder)
        others = [other.place for other in self._world.bidders if other is not bidder and other.holds(task_id)]
        self.history.note(Held, task_id, bidder.place, tuple(others))
        if is_new:
            self.wins += 1
            self._world.radio.note("won", task_id, bidder.place, lease.token, self._world.clock.seconds())
            self.history.note(Won, task_id, bidder.place, lease.token)

    def on_issue(self, bidder: Bidder, task_id: str, permit: Permit) -> None:
        """An agent sends a command under its lease, perhaps when it has just been thawed."""
        truly = bidder.machine.truly(permit.deadline)
        self.history.note(Issued, task_id, bidder.place, bidder.machine.at(permit.deadline), truly)

    def on_command(self, bidder: Bidder, task_id: str, permit: Permit, told: float, remaining: float) -> None:
        """The device, shared by all, takes a command or refuses it."""
        now, gate = self._world.clock.seconds(), self.gates[task_id]
        deadline = min(told, now) + remaining
        truly, is_accepted = bidder.machine.truly(permit.deadline), True
        try:
            gate.admit(Permit(permit.token, deadline), now)
        except StaleCommand:
            is_accepted = False
            if gate.token is not None and permit.token < gate.token and bidder.machine.is_alive:
                bidder.machine.take(bidder.lessees[task_id].outrank, gate.token)
        else:
            self.accepted[task_id].append((now, permit.token, bidder.place))
        self.history.note(Commanded, task_id, bidder.place, permit.token, is_accepted, deadline, truly)

    def floor(self, place: int, task_id: str) -> int:
        """The highest token that the robot of a place has obeyed, and tells its agent."""
        return max((token for _, token, one in self.accepted[task_id] if one == place), default=0)

    def stop(self, place: int, task_id: str) -> None:
        """The agent stops its robot, which comes to rest; on the wire a stop does not overtake a command."""
        self._world.clock.callLater(WIRE, self._stop, place, task_id)

    def _stop(self, place: int, task_id: str) -> None:
        self.history.note(Halted, task_id, place, self._world.clock.seconds() + self._world.stop_time)

    def look_at_cuts(self) -> None:
        """Note who no longer reaches a majority of the council, both ways, and who does again."""
        for task_id, charter in self._world.councils.items():
            places = [self._world.place_of(member) for member in charter.members]
            for agent in self._world.agents:
                near = [p for p in places if not {(agent, p), (p, agent)} & self._world.radio.cut]
                is_reached, mine = len(near) >= majority(len(places)), (task_id, agent)
                if is_reached == (mine in self._is_cut):
                    self._is_cut ^= {mine}
                    self.history.note(Reached, *mine, is_reached)
