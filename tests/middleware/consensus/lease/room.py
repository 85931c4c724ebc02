"""Provide a small team for tests of leases, in virtual time: agents 0, 1 and 2, and a council of nodes 3, 4 and 5."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.lease.charter import Charter, sign_change
from middleware.consensus.lease.lease_client import LeaseClient
from middleware.entangled.quorum.ballot import Ballot
from sim.team.leases.team import LeaseTeam

TTL = 1.5
T = "t0"


class LeaseCase(SynchronousTestCase):
    """A test case with agents and council members.

    A new council member grants nothing for one TTL, so ``made`` waits for one TTL.
    """

    def setUp(self) -> None:
        self.room = self.made()

    def made(self, stop_time: float = 0.0, rates: Sequence[float] = (1.0,) * 7, seed: str = "room") -> LeaseTeam:
        """Return a team with a council that can grant leases."""
        room = LeaseTeam(seed, rates, 3, TTL, stop_time)
        room.add_task(T, [3, 4, 5])
        room.clock.advance(TTL + 0.1)
        return room

    def chartered(self, *councils: Sequence[int], signers: int = 2) -> Charter:
        """Return the charter that proves these successive councils of the task."""
        charter, sitting = self.room.charters[T], [3, 4, 5]
        for number, council in enumerate(councils, start=1):
            members = tuple(self.room.contacts[place] for place in council)
            ballot = Ballot(number, "agent")
            signed = [(n, self.room.identities[place]) for n, place in enumerate(sitting[:signers])]
            votes = [(n, 7, sign_change(each, T, number, ballot, members, 7)) for n, each in signed]
            charter, sitting = charter.with_change(members, ballot, tuple(votes)), list(council)
        return charter

    def client(self, place: int) -> LeaseClient:
        """Return the lease client of an agent."""
        return self.room.nodes[place].get_lease_client(T)

    def run_for(self, seconds: float) -> None:
        """Advance the clock."""
        self.room.clock.advance(seconds)

    def wanting(self, place: int, seconds: float = 0.1) -> LeaseClient:
        """Return the lease client of an agent, ``seconds`` after the agent requested the lease."""
        client = self.client(place)
        client.claim()
        self.run_for(seconds)
        return client

    def holders(self) -> list[int]:
        """Return the agents that hold the lease according to their own clocks."""
        return [place for place in self.room.agents if self.client(place).lease is not None]

    def cut(self, place: int, *others: int) -> None:
        """Block the links between the node with index ``place`` and ``others``."""
        self.room.radio.cut |= {pair for other in others for pair in ((place, other), (other, place))}

    def token(self, place: int) -> int:
        """Return the token of the lease that an agent holds."""
        lease = self.client(place).lease
        assert lease is not None, f"{place} holds nothing"
        return lease.token

    def outcome(self, work: Deferred[Any], seconds: float = 1.0) -> Any:
        """Return the result or exception of ``work`` after ``seconds``."""
        got: list[Any] = []
        work.addCallbacks(got.append, lambda failure: got.append(failure.value))
        self.run_for(seconds)
        return got[0] if got else "nothing yet"
