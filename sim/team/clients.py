"""Clients that write, remove and read slots at the nodes of a team, and record requests and answers.

Clients do not check the results: the checker does, with the history (``sim.team.invariant.durability``). The words
*place* and *life* are explained in ``sim.team.event``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable
from typing import TypeVar

from twisted.internet.defer import Deferred
from twisted.python.failure import Failure

from middleware.entangled.errors import EntangledError, Unavailable
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record
from middleware.entangled.replication.owner import ConsistencyLevel
from middleware.entangled.replication.reader import ReadConsistency
from sim.team.history import History
from sim.team.invariant.durability import Slot

WRITE, REMOVE, READ = "write", "remove", "read"
"""The operations, with the names that the checker uses."""


T = TypeVar("T")


def record_outcome(
    history: History, number: int, work: Deferred[T], shown: Callable[[T], object] = lambda result: None
) -> None:
    """Record the result of the request ``number``, performed by ``work``, as ``shown(result)``, or its failure."""

    def failed(failure: Failure) -> None:
        failure.trap(EntangledError)
        history.record_failure(number, failure.value, failure.check(Unavailable) is not None)

    work.addCallbacks(lambda result: history.record_answer(number, shown(result)), failed)


class Clients:
    """The clients of one run; ``request_counts`` and ``answer_counts`` count operations."""

    def __init__(self, history: History) -> None:
        self.request_counts: Counter[str] = Counter()
        self.answer_counts: Counter[str] = Counter()
        self._history = history
        self._write_counts: Counter[Slot] = Counter()

    def list_slots(self, owner: bytes) -> list[Slot]:
        """Return the slots that the node with this public key has written or removed, in order of first use."""
        return [slot for slot in self._write_counts if slot.owner == owner]

    def write(
        self,
        place: int,
        node: EntangledNode,
        key: bytes,
        name: str,
        concern: ConsistencyLevel = "majority",
        act: str = WRITE,
    ) -> None:
        """Write the next number to a slot of the ``node`` at ``place``; if ``act`` is ``REMOVE``, remove the slot."""
        slot = Slot(key, node.identity.public, name)
        self._write_counts[slot] += 1
        count = self._write_counts[slot]
        number = self._record_request(place, act, slot, count)
        done = node.put(key, name, b"%d" % count, "team", concern) if act == WRITE else node.remove(key, name, concern)
        done.addCallbacks(lambda _: self._record_answer(number, act), self._on_failure, errbackArgs=(number,))

    def read(
        self, place: int, life: int, node: EntangledNode, key: bytes, concern: ReadConsistency = "majority"
    ) -> Deferred[list[Record]]:
        """Read at ``node``, which is the life ``life`` of ``place``; fires with the records, or with [] on failure."""
        # Each life is a separate client, because a restarted node may forget its own reads.
        number = self._record_request((place, life), READ, key, concern)
        return node.get(key, concern).addCallbacks(self._on_records, self._on_failure, (number,), {}, (number,))

    def _record_request(self, client: Hashable, act: str, subject: Hashable, argument: object) -> int:
        self.request_counts[act] += 1
        return self._history.record_request(client, act, subject, argument)

    def _record_answer(self, number: int, act: str, result: object = None) -> None:
        self.answer_counts[act] += 1
        self._history.record_answer(number, result)

    def _on_records(self, records: list[Record], number: int) -> list[Record]:
        self._record_answer(number, READ, {Slot(*record.slot): int(record.value or b"0") for record in records})
        return records

    def _on_failure(self, failure: Failure, number: int) -> list[Record]:
        failure.trap(EntangledError)
        self._history.record_failure(number, failure.value, failure.check(Unavailable) is not None)
        return []
