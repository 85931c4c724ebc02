"""Tests of ``middleware.consensus.lease.lease_service`` between the nodes of a team."""

from __future__ import annotations

from collections.abc import Sequence

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.lease.lease_client import LeaseClient
from middleware.consensus.lease.lease_service import MAX_WAIT_S, propose_when_free
from middleware.entangled.clock import HeapClock
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.quorum.register import Reply, ReplyKind
from middleware.tasks.task import Task
from tests.fleet import FleetCase, SwarmTeam

TASK = Task("t1", "search", "Find it")


class SlowStore(MemoryStore):
    """A store that completes writes only when the test calls ``write``."""

    def __init__(self) -> None:
        super().__init__()
        self.owed: list[Deferred[None]] = []
        self.is_slow = False

    def wait_for_write(self) -> Deferred[None]:
        """Return a Deferred that fires immediately, or with the next ``write``."""
        if not self.is_slow:
            return super().wait_for_write()
        self.owed.append(Deferred())
        return self.owed[-1]

    def write(self) -> None:
        """Complete all pending writes."""
        owed, self.owed = self.owed, []
        for waiting in owed:
            waiting.callback(None)


class LeaseServiceTests(FleetCase):
    def team(self, n: int = 4) -> tuple[SwarmTeam, Task, list[LeaseClient]]:
        """Return a team that can grant leases, a task, and the lease client of each node."""
        fleet = self.swarm(n)
        fleet.run(TASK.lease_ttl)
        task = self.done(fleet, Deferred.fromCoroutine(fleet.nodes[0].submit(TASK)), 1.0)
        return fleet, task, [node.make_lease_client(task, lambda: None, 0) for node in fleet.nodes]

    def holders(self, clients: Sequence[LeaseClient]) -> list[int]:
        """Return the nodes that hold the lease."""
        return [place for place, client in enumerate(clients) if client.lease is not None]

    def end(self, fleet: SwarmTeam, clients: Sequence[LeaseClient]) -> None:
        """Release all claims, which cancels the timers."""
        for client in clients:
            client.release()
        fleet.run(2.0)

    def test_polite_leave_is_heard_by_those_that_stand_by(self) -> None:
        """The council notifies a standby of a release, and the standby acts long before its next poll."""
        fleet, _, clients = self.team()
        clients[1].claim()
        fleet.run(0.3)
        clients[2].stand_by()
        fleet.run(2.02)
        self.assertEqual(self.holders(clients), [1])
        clients[1].release()
        fleet.run(0.1)
        self.assertEqual(self.holders(clients), [2])
        self.end(fleet, clients)

    def test_heirs_are_told_by_the_holder(self) -> None:
        """The holder notifies its first standbys of its release, even if they have never polled the council."""
        fleet, _, clients = self.team()
        clients[1].claim()
        fleet.run(0.3)
        clients[3].stand_by(3)
        clients[1].release([fleet.nodes[3].entangled.contact])
        fleet.run(0.7)
        self.assertEqual(self.holders(clients), [3])
        self.end(fleet, clients)

    def test_answers_wait_for_the_disk(self) -> None:
        """A member sends a promise only after the promise is stored durably."""
        fleet = self.swarm(4)
        stores = [SlowStore() for _ in range(4)]
        for node, store in zip(fleet.nodes, stores, strict=True):
            node.council_manager.lease_service._store = store
        fleet.run(TASK.lease_ttl)
        task = self.done(fleet, Deferred.fromCoroutine(fleet.nodes[0].submit(TASK)), 1.0)
        for store in stores:
            store.is_slow = True
        client = fleet.nodes[1].make_lease_client(task, lambda: None, 0)
        client.claim()
        fleet.run(0.2)
        self.assertIsNone(client.lease)
        for _ in range(30):
            fleet.run(0.02)
            for store in stores:
                store.write()
        self.assertIsNotNone(client.lease)
        for store in stores:
            store.is_slow = False
            store.write()
        self.end(fleet, [client])

    def test_council_changes_over_the_wire(self) -> None:
        """Real nodes decide a change of the council and the end of the task, and redirect a client."""
        fleet, task, clients = self.team(5)
        outsiders = [n.entangled.contact for n in fleet.nodes if n.entangled.contact not in task.council]
        following = [task.council[0], *outsiders[:2]]
        self.assertIsNone(self.done(fleet, clients[0].proposer.change_members(following), 1.0))
        clients[1].claim()
        fleet.run(0.5)
        self.assertEqual(self.holders(clients), [1])
        self.assertEqual((list(clients[1].proposer.members), clients[1].proposer.configuration), (following, 2))
        self.assertIsNone(self.done(fleet, clients[2].proposer.close(), 3.0))
        self.assertEqual((self.holders(clients), clients[1].is_over), ([], True))
        self.end(fleet, clients)

    def test_news_for_nobody(self) -> None:
        """A notice of a release for an unknown or deleted claim is ignored."""
        fleet, task, clients = self.team()
        to = fleet.nodes[2].entangled.contact
        self.assertIsNone(
            self.done(
                fleet, fleet.nodes[1].entangled.endpoint.ask(to, "lease.freed", "other", 0, 0.0, changes=True), 0.5
            )
        )
        self.end(fleet, clients)


class InTimeTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.clock = HeapClock()
        self.until = 1.0

    def proposed(self) -> Reply:
        """Return the reply of a member that grants no lease before ``until``."""
        left = self.until - self.clock.seconds()
        return Reply(ReplyKind.HELD, remaining=left) if left > 0.0 else Reply(ReplyKind.GRANTED)

    def test_answers_when_the_lease_ends(self) -> None:
        """A proposal shortly before the end of a lease is not rejected, but waits for this end and is granted."""
        self.clock.advance(1.0 - MAX_WAIT_S + 0.01)
        answer = propose_when_free(self.proposed, self.clock)
        self.clock.advance(MAX_WAIT_S - 0.02)
        self.assertNoResult(answer)
        self.clock.advance(0.01)
        self.assertEqual(self.successResultOf(answer).kind, ReplyKind.GRANTED)

    def test_a_lease_that_is_renewed(self) -> None:
        """If the holder renews its lease, a waiting proposal is rejected when the lease would have ended."""
        self.clock.advance(0.95)
        answer = propose_when_free(self.proposed, self.clock)
        self.until = 2.0
        self.clock.advance(0.05)
        self.assertEqual(self.successResultOf(answer).kind, ReplyKind.HELD)

    def test_answers_at_once(self) -> None:
        """A reply is returned immediately unless a lease ends soon."""
        for reply in (
            Reply(ReplyKind.GRANTED),
            Reply(ReplyKind.OUTBID),
            Reply(ReplyKind.HELD, remaining=MAX_WAIT_S + 0.01),
        ):
            self.assertEqual(self.successResultOf(propose_when_free(lambda reply=reply: reply, self.clock)), reply)  # type: ignore[misc]

    def test_nobody_waits_any_more(self) -> None:
        """A cancelled wait leaves no timer and grants nothing."""
        self.clock.advance(0.95)
        answer = propose_when_free(self.proposed, self.clock)
        answer.addErrback(lambda _: None)
        answer.cancel()
        self.assertEqual(self.clock.getDelayedCalls(), [])
