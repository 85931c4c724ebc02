"""Tests of the history that simulated clients record."""

from __future__ import annotations

from typing import Any, cast

from twisted.internet.defer import Deferred, fail, succeed
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.errors import NotAcknowledged, Unavailable
from middleware.entangled.identity import Identity
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record
from sim.team.clients import READ, REMOVE, WRITE, Clients
from sim.team.event import Answered, Asked, Unanswered
from sim.team.history import History
from sim.team.invariant.durability import Slot

KEY = b"k" * 32


class Peer:
    """A stub node that returns a given result or error immediately."""

    def __init__(self) -> None:
        self.identity = Identity(b"i" * 32)
        self.puts: list[bytes] = []
        self.answer: Exception | list[Record] = []

    def put(self, key: bytes, name: str, value: bytes, lifetime: str, concern: str) -> Deferred[Any]:
        """Return the result of a write."""
        self.puts.append(value)
        return self.remove(key, name, concern)

    def remove(self, key: bytes, name: str, concern: str) -> Deferred[Any]:
        """Return the result of a removal."""
        return fail(self.answer) if isinstance(self.answer, Exception) else succeed(None)

    def get(self, key: bytes, concern: str) -> Deferred[Any]:
        """Return the result of a read."""
        return fail(self.answer) if isinstance(self.answer, Exception) else succeed(self.answer)


class ClientTests(SynchronousTestCase):
    """Tests of ``Clients``."""

    def setUp(self) -> None:
        """Create clients of one stub node."""
        self.peer = Peer()
        self.node = cast(EntangledNode, self.peer)
        self.slot = Slot(KEY, self.peer.identity.public, "a")
        self.history = History(lambda: 1.0)
        self.clients = Clients(self.history)

    def test_changes_of_a_slot_are_numbered(self) -> None:
        """The writes and removals of a slot are numbered, and the history contains the outcome of each of them."""
        for name, act in (("a", WRITE), ("a", REMOVE), ("b", WRITE), ("a", WRITE)):
            self.clients.write(2, self.node, KEY, name, act=act)
        self.assertEqual(self.peer.puts, [b"1", b"1", b"3"])
        self.assertEqual(self.history.events[2:4], [Asked(1.0, 2, 2, REMOVE, self.slot, 2), Answered(1.0, 2)])
        self.assertEqual([slot.name for slot in self.clients.list_slots(self.slot.owner)], ["a", "b"])
        self.assertEqual(self.clients.list_slots(b"somebody else"), [])

    def test_reads(self) -> None:
        """A read returns the records.

        The history contains, for each slot, the number of the write that was read, and 0 for an empty slot.
        """
        owner = self.peer.identity.public
        self.peer.answer = [
            Record(KEY, name, owner, 1, "team", 60.0, value, b"") for name, value in (("a", b"3"), ("b", None))
        ]
        found = self.successResultOf(self.clients.read(2, 4, self.node, KEY))
        self.assertEqual(found, self.peer.answer)
        shown = {self.slot: 3, Slot(KEY, owner, "b"): 0}
        self.assertEqual(self.history.events, [Asked(1.0, 1, (2, 4), READ, KEY, "majority"), Answered(1.0, 1, shown)])

    def test_what_fails_may_have_been_done(self) -> None:
        """A failed operation may still have been executed; a read without a majority is unavailable.

        Neither is recorded as successful.
        """
        self.peer.answer = NotAcknowledged(1, 3)
        self.clients.write(2, self.node, KEY, "a")
        self.peer.answer = Unavailable(1, 3)
        self.assertEqual(self.successResultOf(self.clients.read(2, 1, self.node, KEY)), [])
        gaps = [event.is_unavailable for event in self.history if isinstance(event, Unanswered)]
        self.assertEqual(gaps, [False, True])
        self.assertEqual((self.clients.request_counts, dict(self.clients.answer_counts)), ({WRITE: 1, READ: 1}, {}))
