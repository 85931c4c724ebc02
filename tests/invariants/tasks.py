"""The workload of tasks: complete agents over a network in memory, with all their decisions and actions.

The workload checks the invariants E4 to E7 and needs no team of nodes. ``python -m tests.invariants --only tasks`` runs
only this workload, in milliseconds per schedule.
"""

from __future__ import annotations

import hashlib
import random
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from typing import Any

from agents.behaviour import KINDS
from agents.decision import Decision
from agents.loop import Agent
from agents.state import State
from middleware.consensus.strategy import ConsensusAlgorithm
from middleware.entangled.clock import HeapClock
from middleware.tasks.order import PAUSE, RESUME, Order
from middleware.tasks.task import CANCELLED, Member, Result, Task
from sim.team.checker import find_violations
from sim.team.event import ActiveTasks, Born, Decided, Died, FaultFree, OpenTask, OutcomeExpired, OutcomeStored, Report
from sim.team.history import History
from sim.team.shrinking import NO_REDUCTION, Reduction
from tests.invariants.ether import OPERATOR, Ether, LeaseClientStub, NetworkConditions, Node
from tests.invariants.walk import Robot, restarted

STEP = 0.25
FAULTS_S = 20.0
SETTLE_S = 40.0
HEARD = 3.0
"""The time in seconds without faults after which all agents have received all reports."""


class Tasks:
    """One schedule of agents, tasks and faults; ``seed`` determines the whole schedule."""

    def __init__(self, seed: int, trim: Reduction = NO_REDUCTION) -> None:
        self.rng = random.Random(f"tasks/{seed}")
        self.clock = HeapClock()
        self.n = self.rng.choice([2, 3, 3, 4, 5])
        self.ether = Ether(self.clock, random.Random(f"ether/{seed}"), self.n)
        self.robots = {place: Robot(self.clock, self.rng.uniform(-3.0, 3.0)) for place in range(1, self.n + 1)}
        self.agents: dict[int, Agent] = {}
        self.tasks: dict[str, Task] = {}
        self.history = History(self.clock.seconds)
        self.is_calm = self.rng.random() < 0.3
        self.trace: list[str] = []
        self.faults: list[str] = []
        self.seconds = trim.limit_duration(FAULTS_S)
        self._trim = trim
        self._acting: dict[str, tuple[int, int]] = {}
        self._acknowledged: dict[str, tuple[Result, float]] = {}
        if self.is_calm:
            self.history.record(FaultFree, HEARD + LeaseClientStub.TTL)
        for place in range(1, self.n + 1):
            self.birth(place)

    def run(self) -> list[str]:
        """Run the schedule and return the violations."""
        with self._recorded():
            if not self.is_calm:
                delay, loss, double = (
                    self.rng.choice(some) for some in ([0.005, 0.05, 0.15], [0.0, 0.1, 0.3], [0.0, 0.2])
                )
                self.ether.conditions = (
                    NetworkConditions(delay) if self._trim.calm else NetworkConditions(delay, loss, double)
                )
            while self.clock.seconds() < self.seconds:
                self.step()
                self.live(STEP)
            self.heal()
            settled = self.clock.seconds() + SETTLE_S
            while self.clock.seconds() < settled and not self.is_settled():
                self.live(1.0)
            self.live(1.0)
            self.late()
            self.live(2.0)
        self.verdict()
        return find_violations(self.history)

    def __str__(self) -> str:
        """Describe the schedule."""
        calm = ", calm" if self.is_calm else ""
        return f"{self.n} agents, {len(self.tasks)} tasks{calm}, faults: {'; '.join(self.faults)}"

    @property
    def digest(self) -> str:
        """Return a hash of all assignments with their times."""
        return hashlib.blake2s("".join(self.trace).encode(), digest_size=8).hexdigest()

    # -- events -----------------------------------------------------------------------------------------------------

    def birth(self, place: int) -> None:
        """Start an agent."""
        self.history.record(Born, place)
        self.robots[place] = restarted(self.robots[place], self.clock)
        node: Any = Node(self.ether, place)
        self.ether.nodes[place] = node
        driver: Any = self.robots[place]
        agent = self.agents[place] = Agent(node, driver, self.clock, random.Random(place))
        agent.startService()

    def death(self, place: int) -> None:
        """End an agent without notifying the other agents."""
        self.history.record(Died, place)
        del self.ether.nodes[place]
        self.agents.pop(place).stopService()

    def step(self) -> None:
        """Run random events."""
        rng = self.rng.random
        if rng() < 0.12 and len(self.tasks) < 4:
            self.submit()
        open_ = [name for name in self.tasks if name not in self.ether.acknowledged]
        if open_ and rng() < 0.03:
            self.ether.conclude(OPERATOR, self.rng.choice(open_), Result(CANCELLED, "operator")).addErrback(lambda _: 0)
        if open_ and rng() < 0.05:
            order = Order(self.rng.choice([PAUSE, RESUME]), "operator", self.clock.seconds())
            self.ether.order(self.rng.choice(open_), order)
        if open_ and rng() < 0.03:
            name = self.rng.choice(open_)
            self.tasks[name] = faded(self.tasks[name], priority=self.rng.choice([0, 5]))
            self.ether.submit(self.tasks[name])
        if rng() < 0.2:
            self.robots[self.rng.randint(1, self.n)].drift = self.rng.choice([0.0, 0.0, 1.0, 2.0])
        if not self.is_calm:
            self.fault()

    def fault(self) -> None:
        """Stop or restart a member, or change the partition."""
        rng = self.rng.random()
        place = self.rng.randint(1, self.n)
        if rng >= 0.09:
            return
        number = len(self.faults)
        self.faults.append(f"{self.clock.seconds():.1f} {'dog' if rng < 0.06 else 'cut'}{place}")
        if not self._trim.keeps(number):
            return
        if rng >= 0.06:
            self.ether.side = {place: 1} if not self.ether.side else {}
        elif place in self.agents:
            self.death(place)
        else:
            self.birth(place)

    def submit(self) -> None:
        """Submit a random task."""
        self.enter(self.any_task())

    def enter(self, task: Task) -> None:
        """Add ``task`` to the tasks of the schedule."""
        self.tasks[task.task_id] = task
        self.history.record_request("operator", "submit", task.task_id)
        self.ether.submit(task)

    def any_task(self) -> Task:
        """Return the next task, with random target, priority and deadline."""
        rng = self.rng
        name = f"t{len(self.tasks)}"
        return Task(
            name,
            "walk",
            name,
            parameters={"target": rng.choice([-4.0, 0.0, 4.0])},
            waiting_period=1.0,
            created=self.clock.seconds(),
            priority=rng.choice([0, 0, 5]),
            preemptible=rng.random() < 0.5,
            deadline=rng.choice([0.0, 0.0, 0.0, 6.0]),
        )

    def heal(self) -> None:
        """End all faults and restart absent agents."""
        self.ether.conditions, self.ether.side = NetworkConditions(), {}
        for place in range(1, self.n + 1):
            if place not in self.agents:
                self.birth(place)
            self.robots[place].drift = 0.0
        for name in self.tasks:
            self.ether.order(name, Order(RESUME, "operator", self.clock.seconds()))

    def is_settled(self) -> bool:
        """Return whether all agents and the operator know the outcome of each task."""
        if any(self.ether.outcome(OPERATOR, name) is None for name in self.tasks):
            return False
        task_queues = [agent._task_queue for agent in self.agents.values()]
        return not any(task_queue.open_ids or any(map(task_queue.is_new, self.tasks)) for task_queue in task_queues)

    def late(self) -> None:
        """Let the record of each outcome expire although the task is still listed."""
        for name in self.tasks:
            if self.ether.outcome(OPERATOR, name) is not None:
                self.history.record(OutcomeExpired, name)
                self.ether.forget(name)

    def live(self, seconds: float) -> None:
        """Let time pass, and inspect the agents."""
        until = self.clock.seconds() + seconds
        while self.clock.seconds() < until - 1e-9:
            self.clock.advance(0.1)
            self.watch()

    # -- observations -----------------------------------------------------------------------------------------------

    def watch(self) -> None:
        """Inspect each agent, and record acknowledged outcomes."""
        now = self.clock.seconds()
        for name, known in self.ether.acknowledged.items():
            if self._acknowledged.get(name) is not known:
                self._acknowledged[name] = known
                self.history.record(OutcomeStored, name, known[0].outcome)
        for place, agent in sorted(self.agents.items()):
            acting = [
                name
                for name, part in agent._participations.items()
                if part.engagement.state_machine.state is State.EXECUTING
            ]
            holding = self.holding(agent)
            if acting or len(holding) > 1:
                self.history.record(ActiveTasks, place, tuple(acting), holding)
            for name in acting:
                token = agent._participations[name].engagement.me.token
                before = self._acting.get(name)
                if before is None or before[1] < token:
                    self._acting[name] = place, token
                    self.trace.append(f"{now:.2f} {name} dog{place} {token}")

    def holding(self, agent: Agent) -> tuple[str, ...]:
        """Return no tasks: this workload does not check which leases an agent holds."""
        return ()

    @contextmanager
    def _recorded(self) -> Iterator[None]:
        """Record each decision of each agent."""
        place: Any = import_module("agents.decider")
        original = place.decide

        def decide(
            members: Iterable[Member],
            strategy: ConsensusAlgorithm,
            hysteresis: float,
            period: float,
            since: float | None,
            has_word: bool | None,
        ) -> Decision:
            listed = list(members)
            decision: Decision = original(listed, strategy, hysteresis, period, since, has_word)
            self.decided(listed, decision, hysteresis)
            return decision

        place.decide = decide
        KINDS["walk"] = "tests.invariants.walk:Walk"
        try:
            yield
        finally:
            place.decide = original
            del KINDS["walk"]

    def decided(self, members: list[Member], decision: Decision, hysteresis: float) -> None:
        """Record a decision and its reports."""
        me = members[0]
        group = ",".join(sorted(name for name, one in self.tasks.items() if one.title == self._title(me)))
        reports = tuple(Report(m.uuid, m.name, m.epoch, m.serial, m.cost) for m in members)
        holders = decision.basis[2]
        holder = holders[0][1] if isinstance(holders, tuple) and holders else None
        place = int(me.uuid, 16)
        self.history.record(Decided, place, group, reports, decision.basis, decision.assigned, holder, hysteresis)

    def _title(self, me: Member) -> str:
        agent = self.agents[int(me.uuid, 16)]
        return next(name for name, part in agent._participations.items() if part.engagement.me is me)

    def verdict(self) -> None:
        """Record the tasks that are still open at each agent."""
        for place, agent in self.agents.items():
            for name in self.tasks:
                state = (
                    str(agent._participations[name].engagement.state_machine) if name in agent._participations else ""
                )
                is_docketed = name in agent._task_queue.open_ids
                if state or is_docketed:
                    self.history.record(OpenTask, name, place, state, is_docketed)


class Groups(Tasks):
    """The workload of groups: tasks that are assigned jointly, and the leases that agents hold (E8)."""

    def submit(self) -> None:
        """Submit one to three tasks, most of them in one group, all with the strategy of the schedule."""
        rng = self.rng
        strategy = ("group_optimal", "cbba", "nearest")[self.n % 3]
        for _ in range(rng.choice([1, 2, 3])):
            task = self.any_task()
            self.enter(replace(task, strategy=strategy, group=rng.choice(["g", "g", "g", ""])))

    def holding(self, agent: Agent) -> tuple[str, ...]:
        """Return the tasks for which an agent holds the lease."""
        lease_clients = {name: part.engagement.lease_client for name, part in agent._participations.items()}
        return tuple(
            name
            for name, lease_client in lease_clients.items()
            if lease_client is not None and lease_client.lease is not None
        )


def faded(task: Task, **changes: Any) -> Task:
    """Return the task after an operator's change has been applied."""
    return replace(task, generation=task.generation + 1, **changes)
