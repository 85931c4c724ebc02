"""Tests of the batcher, which sends a node's records to their replicas in batches."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred

from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError, Refused
from middleware.entangled.identity import Identity
from middleware.entangled.record import TEAM_TTL_S, Record, hash_key
from middleware.entangled.replication.batcher import MAX_LOAD_BYTES, RecordBatcher
from middleware.entangled.replication.replica import Replica
from middleware.entangled.replication.store_reply import StoreReply
from middleware.entangled.wire.requester import TIMEOUT_S
from tests.fleet import EntangledTeam, FleetCase

KEY = hash_key("flood")
FLOOD = 40


class RecordBatcherTests(FleetCase):
    def setUp(self) -> None:
        super().setUp()
        self.world: EntangledTeam = self.fleet(2)
        self.asked: list[int] = []
        writer = self.world.nodes[0]
        self.batcher = RecordBatcher(writer.overlay, writer._background)
        self.there: Contact = self.world.nodes[1].contact

    def record(self, number: int, size: int = 50) -> Record:
        identity: Identity = self.world.nodes[0].identity
        return Record(KEY, f"{number}", identity.public, number + 1, "team", TEAM_TTL_S, b"x" * size).sign(identity)

    def stored(self, *records: Record) -> list[Deferred[object]]:
        return [Deferred.fromCoroutine(self.batcher.store(self.there, record)) for record in records]

    def count_questions(self) -> None:
        replica, answer = self.world.nodes[1].replica, Replica.answer_store

        def counted(peer: Contact, packed: list[object], *left: Any) -> object:
            self.asked.append(len(packed))
            return answer(replica, peer, packed, *left)

        self.world.nodes[1].endpoint.expose("store", counted, changes=True, idempotent=True)

    def test_a_flood_shares_questions(self) -> None:
        """The first of forty records is sent alone and immediately.

        The others are batched in requests of one datagram.
        """
        self.count_questions()
        replies = self.stored(*[self.record(number) for number in range(FLOOD)])
        self.world.run(0.1)
        self.assertEqual([self.successResultOf(reply) for reply in replies], [0] * FLOOD)
        self.assertEqual(self.asked, [1] + [MAX_LOAD_BYTES // self.record(1).message_bytes] * 6 + [3])
        self.assertEqual(len(self.world.nodes[1].store.get(KEY)), FLOOD)
        self.assertEqual(self.batcher._waiting, {})

    def test_what_is_handed_on_keeps_its_life(self) -> None:
        """A forwarded record keeps the remaining TTL of its sender; the node's own record gets the full TTL."""
        self.count_questions()
        replica, stranger = self.world.nodes[1].replica, Identity(bytes([9]) * 32)
        own, others = self.record(0), Record(KEY, "s", stranger.public, 1, "team", TEAM_TTL_S, b"x").sign(stranger)
        (first,) = self.stored(own)
        handed = Deferred.fromCoroutine(self.batcher.store(self.there, others, 700.0))
        self.world.run(1.0)
        self.assertEqual([self.successResultOf(first), self.successResultOf(handed)], [0, 0])
        self.assertEqual(self.asked, [1, 1])
        self.assertAlmostEqual(replica.remaining_lifetime(others), 699.0, delta=0.1)
        self.assertAlmostEqual(replica.remaining_lifetime(own), TEAM_TTL_S - 1.0, delta=0.1)

    def test_one_that_is_refused_goes_alone(self) -> None:
        """If a replica rejects one record of a batch, it stores the other records."""
        replica, keep = self.world.nodes[1].replica, Replica.store_locally

        def picky(record: Record, left: float | None = None) -> StoreReply:
            if record.name == "3":
                raise Refused("not this one")
            return keep(replica, record, left)

        self.patch(replica, "store_locally", picky)
        replies = self.stored(*[self.record(number) for number in range(6)])
        self.world.run(0.1)
        self.failureResultOf(replies.pop(3), Refused)
        self.assertEqual([self.successResultOf(reply) for reply in replies], [0] * 5)

    def test_a_silent_replica_is_not_asked_in_turn(self) -> None:
        """If the first request gets no reply, all waiting records are sent immediately and fail at the same time."""
        self.world.kill(1)
        replies = self.stored(*[self.record(number) for number in range(FLOOD)])
        self.world.run(2 * TIMEOUT_S + 0.1)
        for reply in replies:
            self.failureResultOf(reply, EntangledError)
        self.assertEqual(self.batcher._waiting, {})

    def test_a_long_record_holds_up_nobody(self) -> None:
        """A record that needs fragments is sent alone, and does not delay a short record after it."""
        self.count_questions()
        replies = self.stored(self.record(0, size=50_000), self.record(1))
        self.world.run(0.5)
        self.assertEqual([self.successResultOf(reply) for reply in replies], [0, 0])
        self.assertEqual(self.asked, [1, 1])
