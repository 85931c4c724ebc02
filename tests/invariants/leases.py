"""The workload of leases: agents claim, keep, lose and give back tasks under every fault, with E1 to E3, E5, E8, E9.

It is a world of its own, light enough for a thousand schedules in two minutes: the protocol's classes, simulated
machines and a simulated link.  What agents select is left to dice: commitment must hold whatever selection says.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from twisted.internet.defer import Deferred
from twisted.python.failure import Failure

from drivers.driver import Permit
from drivers.errors import StaleCommand
from drivers.gate import Gate
from middleware.commitment.ballot import FIRST, quorum
from middleware.commitment.council import Council
from middleware.entangled.clock import HeapClock
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.errors import EntangledError
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.network.network import Address
from tests.invariants.bidder import WIRE, Bidder
from tests.invariants.ether import CALM, Air, Ether
from tests.invariants.machine import Machine

TTL = 1.5
SLACK = 0.8
"""E3: seconds beyond the ttl within which another executes when the executor is gone and the rest is well."""
LEAVE = 0.2
"""Seconds within which a stand-by holds what was given back, beside the time to stop."""
ROUGH = 0.06
"""E1: by this share of the ttl a device's count of a duration may differ from a clock that is 5 % off."""
KINDS = (
    "cut", "cut", "one way", "swizzle", "kill", "kill", "wipe", "freeze", "freeze", "suspend", "change", "change",
    "change", "leave", "air", "step", "blackout",
)  # fmt: skip


@dataclass(frozen=True)
class Trouble:
    """Something that happens at ``at`` and ends at ``until``."""

    at: float
    until: float
    kind: str
    places: tuple[int, ...]

    def __str__(self) -> str:
        return f"{self.at:.1f}-{self.until:.1f} {self.kind} {','.join(map(str, self.places))}"


class Leases:
    """The run of ``seed``: everything follows from it."""

    def __init__(self, seed: int, ttl: float = TTL) -> None:
        self.seed = seed
        self.ttl = ttl
        self.clock = HeapClock()
        self.found: list[str] = []
        dice = self._dice = random.Random(f"leases/{seed}")
        self.n = dice.choice([4, 5, 5, 6, 7])
        self.agents = list(range(dice.choice([2, 3, 3, 4])))
        self.stop_time = dice.choice([0.0, 0.0, 0.3])
        self.drift = dice.choice([0.0, 0.01, 0.01, 0.01, 0.05])
        # Without stores a restarted member has forgotten everything: then councils stay, and tokens may fall back.
        self.has_stores = dice.random() < 0.7
        self.air = Air(
            dice.choice([0.001, 0.005, 0.02, 0.05, 0.2]),
            dice.choice([0.0, 0.01, 0.05]),
            dice.choice([0.0, 0.05, 0.1, 0.2, 0.3, 0.5]),
            dice.choice([0.0, 0.1, 0.3]),
            dice.choice([1.0, 1.0, 5.0]),
        )
        self.ether = Ether(self.clock, random.Random(f"leases/{seed}/ether"))
        self.contacts = [
            Contact(random.Random(f"leases/{seed}/{n}").randbytes(32), Address("10.0.0.1", 7000 + n))
            for n in range(self.n)
        ]
        self.gates: dict[str, Gate] = {}
        self.troubles = self._troubles()
        self._places = {contact.public: n for n, contact in enumerate(self.contacts)}
        self._by_id = {contact.node_id.hex(): n for n, contact in enumerate(self.contacts)}
        self._rates = [1.0 + dice.uniform(-1, 1) * self.drift for _ in range(self.n)]
        if self.drift:
            # The worst that is allowed must come up often: a slow holder, fast members.
            self._rates = [1.0 + dice.choice([-1, 1]) * self.drift for _ in range(self.n)]
        self._stores = [MemoryStore() for _ in range(self.n)]
        self._lives = 0
        self._councils: dict[str, tuple[tuple[Contact, ...], int]] = {}
        self._highest: dict[str, int] = {}
        self._won: dict[tuple[str, int], tuple[int, int]] = {}
        self._rest_at: dict[tuple[str, int], float] = {}
        self._accepted: dict[str, list[tuple[float, int, int]]] = {}
        self._over: dict[str, float] = {}
        self._unreachable_since: dict[tuple[str, int], float] = {}
        self._is_amnesiac = False
        self._is_well = False
        self.bidders = [self._born(place) for place in range(self.n)]
        for task_id in ["t0", "t1"][: dice.choice([1, 1, 2])]:
            size = 5 if self.n >= 5 and dice.random() < 0.25 else 3
            members = tuple(self.contacts[place] for place in sorted(dice.sample(range(self.n), size)))
            self._councils[task_id] = members, FIRST
            self.gates[task_id] = Gate()
            self._accepted[task_id] = []
            self._highest[task_id] = 0

    # -- what bidders need ------------------------------------------------------------------------------------------

    def place_of(self, contact: Contact) -> int:
        """Where a contact is."""
        return self._places[contact.public]

    def council_for(self, place: int, task_id: str) -> tuple[tuple[Contact, ...], int]:
        """The council as the task's record names it."""
        return self._councils[task_id]

    def moved(self, task_id: str, council: Council) -> None:
        """Let the record name a newer council."""
        if council.configuration > self._councils[task_id][1]:
            self._councils[task_id] = council.members, council.configuration
            self._look_at_cuts()

    def ask(
        self, asker: Bidder | int, to: int, method: str, arguments: tuple[Any, ...], answered: Callable[[object], object]
    ) -> None:
        """Carry a question and its answer."""
        me = asker if isinstance(asker, Bidder) else self.bidders[asker]

        def arrive() -> None:
            peer = self.bidders[to]

            def run() -> None:
                answer = peer.answer(me.place, method, arguments)
                if answer is not None:
                    self.ether.send(to, me.place, me.machine.take, answered, answer)

            peer.machine.take(run)

        self.ether.send(me.place, to, arrive)

    def tell_freed(self, source: int, agent: str, task_id: str) -> None:
        """Carry the news that a lease was given back."""
        to = self._by_id[agent]

        def hear() -> None:
            lessee = self.bidders[to].lessees.get(task_id)
            if lessee is not None:
                lessee.freed(0)

        self.ether.send(source, to, lambda: self.bidders[to].machine.take(hear))

    # -- what is watched --------------------------------------------------------------------------------------------

    def on_change(self, bidder: Bidder, task_id: str) -> None:
        """E2 and the motion, looked at whenever a lease is won or renewed: whatever overlaps, overlaps then."""
        lease = bidder.lessees[task_id].lease
        if lease is None:
            return
        now = self.clock.seconds()
        mine = (task_id, bidder.place)
        is_new = self._won.get(mine) != (lease.token, id(bidder))
        self._won[mine] = lease.token, id(bidder)
        if self.drift <= 0.01:
            self._check_alone(bidder, task_id, now)
        if not is_new:
            return
        self.ether.note("won", task_id, bidder.place, lease.token, now)
        highest = self._highest[task_id]
        if lease.token <= highest and not self._is_amnesiac:
            self._say("E1", f"token {lease.token} of {task_id} is granted to {bidder.place} after {highest}")
        self._highest[task_id] = max(highest, lease.token)
        since = self._unreachable_since.get((task_id, bidder.place))
        if since is not None and now > since + self.ttl / 3 + self.air.delay + 10 * self.air.jitter + 0.1:
            self._say("E9", f"{bidder.place} wins {task_id} at {now:.2f}, cut from the majority since {since:.2f}")

    def _check_alone(self, bidder: Bidder, task_id: str, now: float) -> None:
        for other in self.bidders:
            lessee = other.lessees.get(task_id)
            if other is bidder:
                continue
            if lessee is not None and lessee.lease is not None and other.machine.is_alive:
                self._say("E2", f"{bidder.place} and {other.place} hold {task_id} at {now:.2f}")
            if self._rest_at.get((task_id, other.place), 0.0) > now + 1e-6:
                self._say("E2", f"the robot of {other.place} moves for {task_id} at {now:.2f}, {bidder.place} holds it")

    def on_issue(self, bidder: Bidder, task_id: str, permit: Permit) -> None:
        """E8: what an agent sends is under a lease that is in force, also when it has just been thawed."""
        now, end = self.clock.seconds(), bidder.machine.at(permit.deadline)
        real = self._true_deadline(bidder, permit)
        if self.drift <= 0.01 and now > max(end, real) + 1e-6 or now > real + ROUGH * self.ttl:
            self._say("E8", f"{bidder.place} commands for {task_id} at {now:.2f}, its lease ended at {real:.2f}")

    def _true_deadline(self, bidder: Bidder, permit: Permit) -> float:
        """When the lease ends on a clock of that rate that never stood still."""
        machine = bidder.machine
        return (permit.deadline - machine.offset) / machine.rate

    def on_command(self, bidder: Bidder, task_id: str, permit: Permit, told: float, remaining: float) -> None:
        """E1 and E5: the device, shared by all, takes a command or refuses it."""
        now, gate = self.clock.seconds(), self.gates[task_id]
        deadline = min(told, now) + remaining
        accepted = self._accepted[task_id]
        before = accepted[-1][1] if accepted else 0
        try:
            gate.admit(Permit(permit.token, deadline), now)
        except StaleCommand:
            if gate.token is not None and permit.token < gate.token and bidder.machine.is_alive:
                bidder.machine.take(bidder.lessees[task_id].outrank, gate.token)
            return
        real = self._true_deadline(bidder, permit)
        if permit.token < before:
            self._say("E1", f"the device of {task_id} takes token {permit.token} after {before}")
        if now > real + ROUGH * self.ttl:
            self._say("E1", f"the device of {task_id} takes a command {now - real:.2f} s after its lease ended")
        over_at = self._over.get(task_id)
        if over_at is not None:
            self._say("E5", f"the device of {task_id} obeys {bidder.place} at {now:.2f}, it ended at {over_at:.2f}")
        since = self._unreachable_since.get((task_id, bidder.place))
        if since is not None and now > since + self.ttl * 1.1 + self.air.delay + 10 * self.air.jitter:
            self._say("E9", f"{bidder.place} acts on {task_id} at {now:.2f}, cut from the majority since {since:.2f}")
        accepted.append((now, permit.token, bidder.place))
        self._rest_at[task_id, bidder.place] = deadline + self.stop_time

    def floor(self, place: int, task_id: str) -> int:
        """The highest token that the robot of a place has obeyed, and tells its agent."""
        return max((token for _, token, one in self._accepted[task_id] if one == place), default=0)

    def stop(self, place: int, task_id: str) -> None:
        """The agent stops its robot, which comes to rest; on the wire a stop does not overtake a command."""
        self.clock.callLater(WIRE, self._stop, place, task_id)

    def _stop(self, place: int, task_id: str) -> None:
        rest_at = self._rest_at.get((task_id, place), 0.0)
        self._rest_at[task_id, place] = min(rest_at, self.clock.seconds() + self.stop_time)

    def _say(self, invariant: str, text: str) -> None:
        line = f"{invariant}: {text}"
        if line not in self.found and len(self.found) < 20:
            self.found.append(line)

    # -- the run ----------------------------------------------------------------------------------------------------

    @property
    def title(self) -> str:
        """What the schedule was."""
        stores = "stores" if self.has_stores else "no stores"
        return f"n={self.n} agents={len(self.agents)} drift={self.drift} stop={self.stop_time} {stores} {self.air} " + (
            "; ".join(map(str, self.troubles))
        )

    def run(self) -> list[str]:
        """Troubles, then health; the violations, a line each."""
        self.clock.advance(self.ttl + 0.1)
        self.ether.air = self.air
        ahead = sorted(
            [(t.at, 0, n) for n, t in enumerate(self.troubles)] + [(t.until, 1, n) for n, t in enumerate(self.troubles)]
        )
        end = self._dice.choice([8.0, 12.0, 16.0])
        began = self.clock.seconds()
        while self.clock.seconds() - began < end:
            while ahead and ahead[0][0] <= self.clock.seconds() - began:
                _, is_end, number = ahead.pop(0)
                (self._end if is_end else self._begin)(self.troubles[number])
            self._choose()
            self.clock.advance(0.25)
        self._heal()
        for task_id in self._councils:
            self._verify_health(task_id)
        return self.found

    def _choose(self) -> None:
        """Selection, as dice: now and then another agent is to act, or nobody."""
        for task_id in self._councils:
            for place in self.agents:
                bidder = self.bidders[place]
                if bidder.machine.is_still or not bidder.machine.is_alive or self._dice.random() > 0.25:
                    continue
                fate = self._dice.random()
                if fate < 0.35:
                    bidder.lessee(task_id).want()
                elif fate < 0.75:
                    bidder.lessee(task_id).stand_by(self._dice.choice([1, 1, 2, 3]))
                elif fate < 0.85:
                    bidder.leave(task_id)
                elif fate < 0.9:
                    bidder.lessee(task_id).suspect()

    def _heal(self) -> None:
        self._is_well = True
        self.ether.cut.clear()
        self._look_at_cuts()
        self.ether.air = CALM
        for place, bidder in enumerate(self.bidders):
            if bidder.machine.is_still:
                bidder.machine.thaw()
            if not bidder.machine.is_alive:
                self.bidders[place] = self._born(place)

    def _verify_health(self, task_id: str) -> None:
        """E3, the graceful leave and E5, when everything is well and one after the other goes."""
        for rank, place in enumerate(self._dice.sample(self.agents, len(self.agents))):
            lessee = self.bidders[place].lessee(task_id)
            if rank:
                lessee.stand_by(rank)
            else:
                lessee.want()
        # A restarted member keeps silent for a ttl; a device may have to tell its token first.
        first = self._wait_for_command(task_id, 0, 2 * self.ttl + SLACK + 1.0)
        if first is None:
            return self._say("E3", f"nobody executes {task_id} though all is well")
        self.clock.advance(self._dice.uniform(0.7, 1.3) * self.ttl)
        _, token, holder = self._accepted[task_id][-1]
        self._depart_politely(task_id, token, holder)
        self.clock.advance(self._dice.uniform(0.7, 1.3) * self.ttl)
        _, token, holder = self._accepted[task_id][-1]
        self._depart_suddenly(task_id, token, holder)
        self._conclude(task_id)

    def _depart_politely(self, task_id: str, token: int, holder: int) -> None:
        left_at = self.clock.seconds()
        self.bidders[holder].leave(task_id)
        won_at = self._wait_for_command(task_id, token, 2 * self.ttl + SLACK)
        if won_at is None or won_at - left_at > self.stop_time + LEAVE + 0.1 + 0.1 * len(self.agents):
            late = "never" if won_at is None else f"{won_at - left_at:.2f} s later"
            self._say("E3", f"{holder} gives {task_id} back, another acts {late}")
        self.bidders[holder].lessee(task_id).stand_by(len(self.agents))

    def _depart_suddenly(self, task_id: str, token: int, holder: int) -> None:
        """The executor is killed, frozen or cut off; one member of the council goes with it."""
        gone_at, dice = self.clock.seconds(), self._dice
        members = [self.place_of(member) for member in self._councils[task_id][0]]
        spare = [place for place in members if place not in self.agents]
        also = [dice.choice(spare)] if spare and holder not in members else []
        how = dice.choice(["kill", "freeze", "suspend", "cut"])
        self._begin(Trouble(0, 0, how, (holder, *also)))
        others = [place for place in self.agents if place != holder]
        if len(others) > 1 and dice.random() < 0.5:
            # Selection names one agent when the lease ends, and thinks better of it.
            fickle = dice.choice(others)
            self.bidders[fickle].leave(task_id)
            self.clock.advance(dice.uniform(0.8, 1.0) * self.ttl)
            self.bidders[fickle].lessee(task_id).want()
            while self.clock.seconds() < gone_at + 1.1 * self.ttl and self._accepted[task_id][-1][1] <= token:
                self.clock.advance(dice.choice([0.004, 0.011, 0.017]))
                if dice.random() < 0.1:
                    break
            self.bidders[fickle].leave(task_id)
        won_at = self._wait_for_command(task_id, token, 3 * self.ttl + SLACK)
        if won_at is None or won_at - gone_at > self.ttl / (1.0 - self.drift) + SLACK:
            late = "never" if won_at is None else f"{won_at - gone_at:.2f} s later"
            self._say("E3", f"{holder} is gone ({how}); another acts on {task_id} {late}")
        self._heal()

    def _conclude(self, task_id: str) -> None:
        """The executor is done, or an operator cancels: from the acknowledgement on nothing moves."""
        _, token, holder = self._accepted[task_id][-1]
        place = self._dice.choice([holder, self.n - 1])
        if place == holder:
            self.stop(holder, task_id)
        closing = self.bidders[place].lessee(task_id).council.close(token if place == holder else 0)
        if place == holder:
            self.bidders[holder].lessee(task_id).release()

        def closed(_: object) -> None:
            self._over[task_id] = self.clock.seconds() + WIRE

        def failed(failure: Failure) -> None:
            failure.trap(EntangledError)
            self._say("E5", f"the end of {task_id} is not recorded: {failure.value}")

        closing.addCallbacks(closed, failed)
        self.clock.advance(2 * self.ttl)
        for agent in self.agents:
            self.bidders[agent].lessee(task_id).want()
        self.clock.advance(2 * self.ttl)
        if task_id not in self._over and not self.found:
            self._say("E5", f"the end of {task_id} is never acknowledged")

    def _wait_for_command(self, task_id: str, above: int, most: float) -> float | None:
        """When a command with a token higher than ``above`` is accepted, if that is within ``most`` seconds."""
        began = self.clock.seconds()
        accepted = self._accepted[task_id]
        while self.clock.seconds() - began < most:
            if accepted and accepted[-1][1] > above and accepted[-1][0] >= began:
                return accepted[-1][0]
            self.clock.advance(0.02)
        return None

    # -- troubles ---------------------------------------------------------------------------------------------------

    def _troubles(self) -> list[Trouble]:
        troubles = []
        for _ in range(self._dice.choice([1, 2, 3, 3, 4, 6])):
            at = self._dice.uniform(0.5, 12.0)
            kind = self._dice.choice(KINDS)
            seconds = self._dice.choice([0.5, 1.0, 2.0, 2.0, 3.0, 5.0, 10.0])
            count = self._dice.choice([1, 1, 2, 3]) if kind in ("kill", "wipe", "freeze", "cut") else 1
            places = tuple(self._dice.sample(range(self.n), min(count, self.n - 1)))
            if self._dice.random() < 0.4:
                places = (self._dice.choice(self.agents), *places[1:])
            if kind == "blackout":
                kind, places = "kill", tuple(range(self.n))
            if kind == "wipe" and self.has_stores:
                kind = "kill"
            troubles.append(Trouble(at, at + seconds, kind, places))
        return troubles

    def _begin(self, trouble: Trouble) -> None:
        rest = [place for place in range(self.n) if place not in trouble.places]
        match trouble.kind:
            case "cut":
                self.ether.cut |= {pair for a in trouble.places for b in rest for pair in ((a, b), (b, a))}
            case "one way":
                self.ether.cut |= {(a, b) for a in trouble.places for b in rest}
            case "swizzle":
                order = self._dice.sample(range(self.n), self.n // 2)
                for number, place in enumerate(order):
                    self.clock.callLater(0.2 * number, self._clog, place)
            case "kill" | "wipe":
                for place in trouble.places:
                    self._kill(place)
            case "freeze" | "suspend":
                for place in trouble.places:
                    if self.bidders[place].machine.is_alive and not self.bidders[place].machine.is_still:
                        self.bidders[place].machine.freeze(trouble.kind == "suspend")
            case "change":
                self._change(trouble.places[0])
            case "leave":
                for task_id in self._councils:
                    if self._is_up(trouble.places[0]):
                        self.bidders[trouble.places[0]].leave(task_id)
            case "air":
                self.ether.air = Air(self.air.delay, self.air.jitter, 0.5, 0.3, 5.0)
        self._look_at_cuts()

    def _end(self, trouble: Trouble) -> None:
        match trouble.kind:
            case "cut" | "one way" | "swizzle":
                self.ether.cut.clear()
            case "kill" | "wipe":
                for place in trouble.places:
                    if not self.bidders[place].machine.is_alive:
                        self.bidders[place] = self._born(place)
            case "freeze" | "suspend":
                for place in trouble.places:
                    if self.bidders[place].machine.is_still:
                        self.bidders[place].machine.thaw()
            case "air":
                self.ether.air = self.air
        self._look_at_cuts()

    def _clog(self, place: int) -> None:
        if self._is_well:
            return
        self.ether.cut |= {pair for b in range(self.n) if b != place for pair in ((place, b), (b, place))}
        self._look_at_cuts()

    def _change(self, place: int) -> None:
        """Somebody has another council chosen, at a moment when the task may be free."""
        if not self._is_up(place) or not self.has_stores:
            return
        for task_id in self._councils:
            if self._dice.random() < 0.7:
                for agent in self.agents:
                    if self._is_up(agent) and self._dice.random() < 0.9:
                        self.bidders[agent].leave(task_id)
            members = [self.contacts[n] for n in sorted(self._dice.sample(range(self.n), 3))]
            self.clock.callLater(0.5 + self.stop_time, self._change_now, place, task_id, members)

    def _change_now(self, place: int, task_id: str, members: Sequence[Contact]) -> None:
        if self._is_up(place):
            changing: Deferred[None] = self.bidders[place].lessee(task_id).council.change(members)
            changing.addErrback(lambda failure: failure.trap(EntangledError))

    def _is_up(self, place: int) -> bool:
        return self.bidders[place].machine.is_alive and not self.bidders[place].machine.is_still

    def _kill(self, place: int) -> None:
        self.bidders[place].machine.die()
        if not self.has_stores:
            self._stores[place] = MemoryStore()
            self._is_amnesiac = True

    def _born(self, place: int) -> Bidder:
        """The next life at a place."""
        self._lives += 1
        rng = random.Random(f"leases/{self.seed}/{place}/{self._lives}")
        return Bidder(self, place, Machine(self.clock, self._rates[place], rng.uniform(0.0, 1e4)), self._stores[place], rng)

    def _look_at_cuts(self) -> None:
        """Note who cannot reach a majority of the council, both ways, and since when."""
        now = self.clock.seconds()
        for task_id, (members, _) in self._councils.items():
            places = [self.place_of(member) for member in members]
            for agent in self.agents:
                near = [p for p in places if not {(agent, p), (p, agent)} & self.ether.cut]
                if len(near) >= quorum(len(places)):
                    self._unreachable_since.pop((task_id, agent), None)
                else:
                    self._unreachable_since.setdefault((task_id, agent), now)

