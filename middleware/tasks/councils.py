"""Councils: those of the tasks of one node, in which it sits, which it asks, and which it has filled up."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.consensus.lease.charter import Judge, charter_of, pin
from middleware.consensus.lease.council import Council
from middleware.consensus.lease.desk import Desk
from middleware.consensus.lease.lessee import Lessee
from middleware.entangled.contact import Contact
from middleware.entangled.data.store import Store
from middleware.entangled.kademlia.distance import closest
from middleware.entangled.node import EntangledNode
from middleware.entangled.quorum.ballot import majority
from middleware.entangled.record import Slot
from middleware.tasks.task import TASKS, Task, group_key

LARGE = 50
"""Members from which on a council has five instead of three."""
SILENT = 10.0
"""Seconds of silence after which another takes the seat of a council member."""


class Councils:
    """The councils of tasks, as ``entangled`` reaches them.

    ``born_at`` is when the node began; ``moved`` is told a task whose council has changed, with the new one;
    ``may_sit`` says whether the holder of a key may be a member of a council.
    """

    def __init__(
        self,
        entangled: EntangledNode,
        store: Store,
        clock: IReactorTime,
        rng: random.Random,
        born_at: float,
        moved: Callable[[Task], object],
        may_sit: Callable[[bytes], bool],
    ) -> None:
        self._entangled = entangled
        self._clock = clock
        self._rng = rng
        self._moved = moved
        self._may_sit = may_sit
        self.judge = Judge(self._may_publish)
        self.desk = Desk(entangled.endpoint, entangled.identity, store, clock, born_at, self.judge, self._may_sit)

    async def pinned(self, task: Task) -> Task:
        """A new ``task`` with its council: the nodes closest to its key now (consensus rule 1), signed by this node."""
        key = group_key(task.task_id)
        found = await self._entangled.find_node(key)
        candidates = [node for node in [*found, self._entangled.contact] if self._may_sit(node.public)]
        members = odd(closest(candidates, key, self._seats(task)))
        charter = pin(self._entangled.identity, task.task_id, members)
        return replace(task, council=members, charter=charter.packed)

    def of(self, task: Task, floor: int = 0) -> Council:
        """The council of ``task``, asked in this node's name; what is claimed lies above the token ``floor``."""
        ttl = float(task.lease_ttl)

        def ask(member: Contact, method: str, arguments: tuple[Any, ...]) -> Deferred[Any]:
            return self.desk.ask(self._entangled.contact, member, method, arguments, ttl / 3)

        def moved() -> None:
            self._moved(task.with_council(council.charter) if council.charter is not None else task)

        pinned = task.task_id, self._entangled.contact.node_id.hex(), ttl, task.council
        read = self.judge.read
        council = Council(
            *pinned, ask, self._clock, self._rng, charter_of(task.charter), read, task.configuration, floor, moved
        )
        return council

    def lessee(self, task: Task, changed: Callable[[], None], floor: int) -> Lessee:
        """The claimant of the right to act on ``task``, in this node's name, with tokens above ``floor``."""
        lessee = Lessee(self.of(task, floor), self._clock, self._rng, changed, task.stop_time)
        self.desk.enter(lessee)
        return lessee

    def has_vacancy(self, task: Task, council: Council) -> bool:
        """Whether a seat of ``council`` is empty, or was never taken for want of nodes."""
        return 0 < len(council.members) < self._seats(task) or bool(council.silent(SILENT))

    async def successors(self, task: Task, council: Council) -> tuple[Contact, ...] | None:
        """Who should be the council of ``task`` from now on: those of it that are there, and the closest of the others.

        None where there is nobody who would make it better.  Fails with ``EntangledError`` where nobody answers.
        """
        key, silent = group_key(task.task_id), council.silent(SILENT)
        gone = {member.node_id for member in silent}
        nodes = await self._entangled.find_node(key)
        found = [node for node in nodes if node.node_id not in gone and self._may_sit(node.public)]
        candidates = closest([*found, self._entangled.contact], key, len(found) + 1)
        return filled(council.members, silent, candidates, self._seats(task))

    def _may_publish(self, public: bytes, task_id: str) -> bool:
        return self._entangled.replica.may_store(Slot(TASKS, public, task_id))

    def _seats(self, task: Task) -> int:
        tolerates = max(task.tolerates, 2 if len(self._entangled.overlay.contacts()) >= LARGE else 1)
        return 2 * tolerates + 1


def filled(
    members: Sequence[Contact], silent: Sequence[Contact], candidates: Sequence[Contact], size: int
) -> tuple[Contact, ...] | None:
    """The council that should follow that of ``members``, of whom some are ``silent``; None where it may stay.

    Who is there stays; ``candidates`` take the other seats in their order, up to ``size``.  A council changes only
    where more of those that are there could be lost after than before: three for two, but never four for three.
    """
    gone, seated = {member.node_id for member in silent}, {member.node_id for member in members}
    here = [member for member in members if member.node_id not in gone]
    others = [one for one in candidates if one.node_id not in seated]
    following = (*here, *others)[: max(size, len(here))]
    following = odd(following)
    if _spare(len(following), len(following)) <= _spare(len(here), len(members)):
        return None
    return following


def odd(members: Sequence[Contact]) -> tuple[Contact, ...]:
    """So many of the first ``members`` that their number is odd: of four no more may be lost than of three."""
    return tuple(members[: len(members) - 1 + len(members) % 2])


def _spare(here: int, size: int) -> int:
    """How many of those that are ``here`` may be lost before no majority of ``size`` is left."""
    return here - majority(size)
