"""Choose and replace the quorum members of tasks, and create this node's acceptor and its lease clients."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.consensus.lease.charter import CharterVerifier, create_charter, parse_charter
from middleware.consensus.lease.lease_client import LeaseClient
from middleware.consensus.lease.lease_proposer import LeaseProposer
from middleware.consensus.lease.lease_service import LeaseService
from middleware.entangled.contact import Contact
from middleware.entangled.data.store import Store
from middleware.entangled.kademlia.distance import select_closest
from middleware.entangled.node import EntangledNode
from middleware.entangled.quorum.ballot import majority
from middleware.entangled.record import Slot
from middleware.tasks.task import TASKS, Task, group_key

LARGE_TEAM_CONTACTS = 50
"""Minimum number of contacts with which a task has five quorum members instead of three."""
SILENT_S = 10.0
"""Seconds without an answer after which a quorum member is replaced."""


class CouncilManager:
    """Chooses the quorum members of tasks; its requests are sent through ``entangled``.

    ``born_at`` is the time at which the node started.  ``on_change`` is called with a task whose quorum members have
    changed.  ``may_be_member`` returns whether the owner of a key may be a quorum member.
    """

    def __init__(
        self,
        entangled: EntangledNode,
        store: Store,
        clock: IReactorTime,
        rng: random.Random,
        born_at: float,
        on_change: Callable[[Task], object],
        may_be_member: Callable[[bytes], bool],
    ) -> None:
        self._entangled = entangled
        self._clock = clock
        self._rng = rng
        self._on_change = on_change
        self._may_be_member = may_be_member
        self.charter_verifier = CharterVerifier(self._may_publish)
        self.lease_service = LeaseService(
            entangled.endpoint, entangled.identity, store, clock, born_at, self.charter_verifier, self._may_be_member
        )

    async def choose_council(self, task: Task) -> Task:
        """Return a new ``task`` with its quorum members, signed by this node.

        The members are the nodes that are now closest to the task's group key.
        """
        key = group_key(task.task_id)
        found = await self._entangled.find_node(key)
        candidates = [node for node in [*found, self._entangled.contact] if self._may_be_member(node.public)]
        members = take_odd_number(select_closest(candidates, key, self._choose_size(task)))
        charter = create_charter(self._entangled.identity, task.task_id, members)
        return replace(task, council=members, charter=charter.packed)

    def make_proposer(self, task: Task, floor: int = 0) -> LeaseProposer:
        """Return a proposer for the lease of ``task``; its fencing tokens are above ``floor``."""
        ttl = float(task.lease_ttl)

        def ask(member: Contact, method: str, arguments: tuple[Any, ...]) -> Deferred[Any]:
            return self.lease_service.call_member(self._entangled.contact, member, method, arguments, ttl / 3)

        def moved() -> None:
            self._on_change(task.with_council(proposer.charter) if proposer.charter is not None else task)

        pinned = task.task_id, self._entangled.contact.node_id.hex(), ttl, task.council
        read = self.charter_verifier.parse
        proposer = LeaseProposer(
            *pinned, ask, self._clock, self._rng, parse_charter(task.charter), read, task.configuration, floor, moved
        )
        return proposer

    def make_lease_client(self, task: Task, changed: Callable[[], None], floor: int) -> LeaseClient:
        """Create this node's lease client for ``task``; its fencing tokens are above ``floor``."""
        client = LeaseClient(self.make_proposer(task, floor), self._clock, self._rng, changed, task.stop_time)
        self.lease_service.register(client)
        return client

    def has_vacancy(self, task: Task, proposer: LeaseProposer) -> bool:
        """Return whether a quorum member is silent, or there are fewer members than the task should have."""
        return 0 < len(proposer.members) < self._choose_size(task) or bool(proposer.find_silent_members(SILENT_S))

    async def find_successors(self, task: Task, proposer: LeaseProposer) -> tuple[Contact, ...] | None:
        """Return the next quorum members of ``task``: the present members that answer, and the closest other nodes.

        Return None if a change would not be an improvement.  Raises ``EntangledError`` if no node answers.
        """
        key, silent = group_key(task.task_id), proposer.find_silent_members(SILENT_S)
        silent_ids = {member.node_id for member in silent}
        nodes = await self._entangled.find_node(key)
        found = [node for node in nodes if node.node_id not in silent_ids and self._may_be_member(node.public)]
        candidates = select_closest([*found, self._entangled.contact], key, len(found) + 1)
        return choose_successors(proposer.members, silent, candidates, self._choose_size(task))

    def _may_publish(self, public: bytes, task_id: str) -> bool:
        return self._entangled.replica.may_store(Slot(TASKS, public, task_id))

    def _choose_size(self, task: Task) -> int:
        tolerates = max(task.tolerates, 2 if len(self._entangled.overlay.contacts()) >= LARGE_TEAM_CONTACTS else 1)
        return 2 * tolerates + 1


def choose_successors(
    members: Sequence[Contact], silent: Sequence[Contact], candidates: Sequence[Contact], size: int
) -> tuple[Contact, ...] | None:
    """Return the quorum members that should replace ``members``, of which some are ``silent``; None for no change.

    Members that answer remain; ``candidates`` are added in order, up to ``size``.  The members change only if more of
    the answering members may then fail: three members instead of two are an improvement, four instead of three are not.
    """
    silent_ids, member_ids = {member.node_id for member in silent}, {member.node_id for member in members}
    responding = [member for member in members if member.node_id not in silent_ids]
    others = [one for one in candidates if one.node_id not in member_ids]
    following = (*responding, *others)[: max(size, len(responding))]
    following = take_odd_number(following)
    if _count_tolerated_losses(len(following), len(following)) <= _count_tolerated_losses(
        len(responding), len(members)
    ):
        return None
    return following


def take_odd_number(members: Sequence[Contact]) -> tuple[Contact, ...]:
    """Return an odd number of first ``members``: all or all but one, as four tolerate no more failures than three."""
    return tuple(members[: len(members) - 1 + len(members) % 2])


def _count_tolerated_losses(responding: int, size: int) -> int:
    """Return the number of ``responding`` members that may be lost so that a majority of ``size`` remains."""
    return responding - majority(size)
