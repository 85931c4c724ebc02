"""Replace the network between complete agents: groups, results and leases of a team in memory.

Reports are delayed, repeated, reordered and lost. Presence is a lease, results are stored by a majority, and a council
grants a task's lease to one of the agents that reach it. A schedule takes milliseconds.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

from twisted.internet.defer import Deferred, fail, succeed

from middleware.consensus.deployed_modules import DeployedModules
from middleware.consensus.guarded_strategy import GuardedStrategy
from middleware.consensus.lease.lease_client import Lease
from middleware.consensus.strategy_registry import StrategyRegistry
from middleware.entangled.clock import HeapClock
from middleware.entangled.errors import Unavailable
from middleware.entangled.record import Record
from middleware.tasks.order import Order
from middleware.tasks.task import ORDER, RESULT, TASKS, Member, Result, Task, group_key

PRESENCE = 1.0
REPEAT = 0.5
OPERATOR = 0
"""The place of the operator's node, which has no robot."""


@dataclass
class NetworkConditions:
    """The delay of messages in seconds, and their rates of loss and duplication."""

    delay: float = 0.02
    loss: float = 0.0
    duplicate: float = 0.0


@dataclass
class Replica:
    """The data that one node has received; it survives the node's process."""

    tasks: dict[str, Task] = field(default_factory=dict)
    results: dict[str, dict[tuple[int, str, str], Result]] = field(default_factory=dict)
    orders: dict[str, Order] = field(default_factory=dict)
    members: dict[str, dict[str, tuple[Member, float]]] = field(default_factory=dict)


class Ether:
    """The network between the nodes 0 (the operator's node) to ``n``; all nodes except 0 have robots."""

    def __init__(self, clock: HeapClock, rng: random.Random, n: int) -> None:
        self.clock = clock
        self.rng = rng
        self.conditions = NetworkConditions()
        self.side: dict[int, int] = {}
        """The partition of each node; nodes in different partitions cannot reach each other."""
        self.replicas = [Replica() for _ in range(n + 1)]
        self.nodes: dict[int, Node] = {}
        self.acknowledged: dict[str, tuple[Result, float]] = {}
        self.holders: dict[str, tuple[int, int, float]] = {}
        self.tokens: dict[str, int] = {}
        clock.callLater(REPEAT, self._repeat)

    def reaches(self, one: int, other: int) -> bool:
        """Return whether messages between the two nodes (given by their numbers) can arrive."""
        return self.side.get(one, 0) == self.side.get(other, 0)

    def send(self, source: int, target: int, deliver: Callable[[], None]) -> None:
        """Send a message; the present network conditions may delay, lose or duplicate it."""
        for _ in range(1 + (self.rng.random() < self.conditions.duplicate)):
            lost = self.rng.random() < self.conditions.loss or not self.reaches(source, target)
            if not lost:
                self.clock.callLater(self.conditions.delay * self.rng.uniform(0.2, 3.0), deliver)

    def everywhere(self, source: int, change: Callable[[int], None]) -> None:
        """Apply a change at the node ``source`` immediately, and at every other node when its message arrives."""
        change(source)
        for target in range(len(self.replicas)):
            if target != source:
                self.send(source, target, lambda target=target: change(target))  # type: ignore[misc]

    def submit(self, task: Task) -> None:
        """Publish a task."""
        self.everywhere(OPERATOR, lambda place: self._task(place, task))

    def conclude(self, place: int, task_id: str, result: Result) -> Deferred[None]:
        """Record an outcome.

        After 0.3 s the write succeeds if a majority has stored the outcome, and fails otherwise.
        """
        done: Deferred[None] = Deferred()
        self.everywhere(place, lambda target: self._result(target, task_id, result))

        def count() -> None:
            have = sum(
                result.rank in replica.results.get(task_id, {}) and self.reaches(place, target)
                for target, replica in enumerate(self.replicas)
            )
            if 2 * have > len(self.replicas):
                before = self.acknowledged.get(task_id)
                if before is None or result.rank > before[0].rank:
                    self.acknowledged[task_id] = result, self.clock.seconds()
                done.callback(None)
            else:
                done.errback(Unavailable(have, len(self.replicas)))

        self.clock.callLater(0.3, count)
        return done

    def order(self, task_id: str, order: Order) -> None:
        """Publish a pause or resume order."""
        self.everywhere(OPERATOR, lambda place: self._order(place, task_id, order))

    def forget(self, task_id: str) -> None:
        """Remove the record of the outcome from all nodes, but keep the record of the task."""
        for place, replica in enumerate(self.replicas):
            replica.results.pop(task_id, None)
            self.changed(place, task_id)
            self.listed(place)

    def report(self, place: int, task_id: str, member: Member | None) -> None:
        """Send a report to all nodes; None withdraws the report."""
        for target in range(1, len(self.replicas)):
            self.send(place, target, lambda target=target: self._member(target, place, task_id, member))  # type: ignore[misc]

    def results(self, place: int, task_id: str) -> list[Record]:
        """Return the outcomes that the node with this number knows, as records."""
        known = self.replicas[place].results.get(task_id, {})
        return [
            Record(group_key(task_id), RESULT, bytes(32), 1, "team", 1.0, result.pack(), bytes(64))
            for _, result in sorted(known.items())
        ]

    def outcome(self, place: int, task_id: str) -> Result | None:
        """Return the outcome of a task as the node with this number knows it."""
        known = self.replicas[place].results.get(task_id, {})
        return known[max(known)] if known else None

    def changed(self, place: int, task_id: str) -> None:
        """Notify the followers of the task at the node."""
        node = self.nodes.get(place)
        if node is None:
            return
        now = self.clock.seconds()
        members = self.replicas[place].members.setdefault(task_id, {})
        for uuid in [uuid for uuid, (_, until) in members.items() if until < now]:
            del members[uuid]
        for heard, ordered in list(node.groups.get(task_id, [])):
            heard([member for member, _ in members.values()], self.outcome(place, task_id))
            order = self.replicas[place].orders.get(task_id)
            packed = [] if order is None else [order.pack()]
            ordered([Record(group_key(task_id), ORDER, bytes(32), 1, "team", 1.0, one, bytes(64)) for one in packed])

    def listed(self, place: int) -> None:
        """Notify the agent of the node of the current tasks."""
        node = self.nodes.get(place)
        if node is not None and node.on_tasks is not None:
            tasks = self.replicas[place].tasks
            node.on_tasks(
                [
                    Record(TASKS, name, bytes(32), 1, "team", 1.0, task.pack(), bytes(64))
                    for name, task in sorted(tasks.items())
                ]
            )

    def _task(self, place: int, task: Task) -> None:
        if self.replicas[place].tasks.get(task.task_id) != task:
            self.replicas[place].tasks[task.task_id] = task
            self.listed(place)

    def _result(self, place: int, task_id: str, result: Result) -> None:
        known = self.replicas[place].results.setdefault(task_id, {})
        if result.rank not in known:
            known[result.rank] = result
            self.changed(place, task_id)

    def _order(self, place: int, task_id: str, order: Order) -> None:
        known = self.replicas[place].orders.get(task_id)
        if known is None or order.at > known.at:
            self.replicas[place].orders[task_id] = order
            self.changed(place, task_id)

    def _member(self, place: int, source: int, task_id: str, member: Member | None) -> None:
        members = self.replicas[place].members.setdefault(task_id, {})
        if member is None:
            members.pop(f"{source:040x}", None)
        else:
            members[member.uuid] = member, self.clock.seconds() + PRESENCE
        self.changed(place, task_id)

    def _repeat(self) -> None:
        """Send all reports again, exchange data with a random node, and remove silent members."""
        self.clock.callLater(REPEAT, self._repeat)
        for place, node in sorted(self.nodes.items()):
            for task_id, member in sorted(node.reports.items()):
                self.report(place, task_id, member)
        for place, replica in enumerate(self.replicas):
            target = self.rng.randrange(len(self.replicas))
            self.send(place, target, lambda here=replica, target=target: self._meet(here, target))  # type: ignore[misc]
            for task_id in sorted(replica.members):
                self.changed(place, task_id)

    def _meet(self, here: Replica, target: int) -> None:
        for task in list(here.tasks.values()):
            self._task(target, task)
        for task_id, results in list(here.results.items()):
            for result in list(results.values()):
                self._result(target, task_id, result)
        for task_id, order in list(here.orders.items()):
            self._order(target, task_id, order)


class ProposerStub:
    """A proposer for a council that consists of the operator's node and never changes."""

    def learn_charter(self, packed: bytes) -> None:
        """Ignore the record."""

    def ping_members(self) -> None:
        """Do nothing, because the only member is always present."""


class LeaseClientStub:
    """A lease client for a council that consists of the operator's node."""

    TTL = 1.5
    proposer = ProposerStub()

    def __init__(self, ether: Ether, place: int, task_id: str, changed: Callable[[], None], floor: int) -> None:
        self._ether, self._place, self._task_id, self._changed, self._floor = ether, place, task_id, changed, floor
        self.token = 0
        self._deadline = 0.0
        self._wanted = False
        self._life = 0

    @property
    def lease(self) -> Lease | None:
        """Return the lease if it is held now."""
        is_held = self.token and self._ether.clock.seconds() < self._deadline
        return Lease(self._task_id, self.token, self._deadline) if is_held else None

    def on_higher_token(self, token: int) -> None:
        """From now on, use only tokens higher than this token."""
        self._floor = max(self._floor, token)

    def claim(self) -> None:
        """Claim the lease, and then renew it."""
        if not self._wanted:
            self._wanted = True
            self._ether.clock.callLater(0.02, self._claim, self._life)

    def suspect_holder(self) -> None:
        """Do nothing, because claims are repeated often enough."""

    def close_task(self, token: int) -> Deferred[bytes]:
        """Allow the task to end."""
        return succeed(b"")

    def stand_by(self, rank: int = 1) -> None:
        """Do nothing: this council does not notify standbys, so each client polls it."""

    def release(self, standbys: object = (), rest: float = 0.0) -> Deferred[object]:
        """Return the lease. If the robot is still moving, let the lease expire instead."""
        self._wanted, self._deadline = False, 0.0
        self._life += 1
        holder = self._ether.holders.get(self._task_id)
        is_ours = self.token and holder is not None and holder[1] == self.token
        if is_ours and not rest and self._reached():
            del self._ether.holders[self._task_id]
        self.token = 0
        return succeed(None)

    def _reached(self) -> bool:
        ether = self._ether
        return self._place in ether.nodes and ether.reaches(self._place, OPERATOR)

    def _claim(self, life: int) -> None:
        if life != self._life or self._place not in self._ether.nodes:
            return
        ether, now = self._ether, self._ether.clock.seconds()
        holder = ether.holders.get(self._task_id)
        is_mine = holder is not None and holder[1] == self.token and self.lease is not None
        if (
            self._reached()
            and ether.rng.random() >= ether.conditions.loss
            and (holder is None or is_mine or holder[2] <= now)
        ):
            if not is_mine:
                self.token = max(ether.tokens.get(self._task_id, 0), self._floor) + 1
                ether.tokens[self._task_id] = self.token
            self._deadline = now + self.TTL * 0.96
            ether.holders[self._task_id] = self._place, self.token, now + self.TTL
            self._changed()
        ether.clock.callLater(0.3, self._claim, life)


class Node:
    """The part of a node that the node's agent uses."""

    def __init__(self, ether: Ether, place: int) -> None:
        self.ether = ether
        self.place = place
        self.uuid = f"{place:040x}"
        self.wall = ether.clock.seconds
        self.joined: Deferred[None] = succeed(None)
        self.presence = SimpleNamespace(
            device=SimpleNamespace(name=f"dog{place}"), add_message=lambda *_: None, change=lambda **_: None
        )
        self.entangled = SimpleNamespace(get=self._get)
        self.find_contacts = lambda uuids: ()
        self.council_manager = SimpleNamespace(
            make_proposer=lambda task: ProposerStub(), has_vacancy=lambda task, council: False
        )
        self.stop_state = SimpleNamespace(
            subscribe=lambda listener: None, request_stops=lambda: None, is_motion_forbidden=False, is_known=True
        )
        self.deployed: DeployedModules = {}
        self.strategies = StrategyRegistry()
        self.groups: dict[str, list[tuple[Any, Any]]] = {}
        self.reports: dict[str, Member] = {}
        self.on_tasks: Callable[[list[Record]], None] | None = None

    def publish_decision_record(self, verdict: object) -> None:
        """Ignore the decision record."""

    def get_strategy(self, name: str) -> GuardedStrategy:
        """Return the strategy of this name."""
        return self.strategies.get(name, self.deployed)

    def watch_tasks(self, changed: Callable[[list[Record]], None]) -> None:
        """Watch the tasks."""
        self.on_tasks = changed
        self.ether.listed(self.place)

    def join_group(self, task: Task, heard: Any, ordered: Any, panel: Any = None) -> Any:
        """Return a membership in the group of a task; all members write reports."""
        task_id = task.task_id
        followers = self.groups.setdefault(task_id, [])
        followers.append((heard, ordered))
        place, ether = self.place, self.ether

        def report(member: Member) -> None:
            self.reports[task_id] = member
            ether.report(place, task_id, member)

        def withdraw() -> None:
            self.reports.pop(task_id, None)
            ether.report(place, task_id, None)

        ether.clock.callLater(0.0, ether.changed, place, task_id)
        return SimpleNamespace(
            report=report,
            withdraw=withdraw,
            leave=lambda: followers.remove((heard, ordered)),
            conclude=lambda result, proof: ether.conclude(place, task_id, result),
        )

    def make_lease_client(self, task: Task, changed: Callable[[], None], floor: int) -> LeaseClientStub:
        """Return the lease client of a task."""
        return LeaseClientStub(self.ether, self.place, task.task_id, changed, floor)

    def _get(self, key: bytes) -> Deferred[list[Record]]:
        """Return the records that the reachable nodes know; fail if these nodes are not a majority."""
        reached = [place for place in range(len(self.ether.replicas)) if self.ether.reaches(self.place, place)]
        if 2 * len(reached) <= len(self.ether.replicas) or self.ether.rng.random() < self.ether.conditions.loss:
            return fail(Unavailable(len(reached), len(self.ether.replicas)))
        tasks = self.ether.replicas[self.place].tasks
        task_id = next(name for name in tasks if group_key(name) == key)
        return succeed([record for place in reached for record in self.ether.results(place, task_id)])
