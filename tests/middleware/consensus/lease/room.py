"""Room: a calm team for tests of leases: agents 0, 1, 2 and a council of 3, 4, 5, all on one turned clock."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.lease.charter import Charter, sign_change
from middleware.consensus.lease.lessee import Lessee
from middleware.entangled.quorum.ballot import Ballot
from sim.team.leases.team import LeaseTeam

TTL = 1.5
T = "t0"


class RoomCase(SynchronousTestCase):
    """Agents and council members; members are born silent, so a ttl passes first."""

    def setUp(self) -> None:
        self.room = self.made()

    def made(self, stop_time: float = 0.0, rates: Sequence[float] = (1.0,) * 7, seed: str = "room") -> LeaseTeam:
        """A team whose council may grant."""
        room = LeaseTeam(seed, rates, 3, TTL, stop_time)
        room.add_task(T, [3, 4, 5])
        room.clock.advance(TTL + 0.1)
        return room

    def chartered(self, *councils: Sequence[int], signers: int = 2) -> Charter:
        """The proof that the council of the task became these, one after the other."""
        charter, sitting = self.room.councils[T], [3, 4, 5]
        for number, council in enumerate(councils, start=1):
            members = tuple(self.room.contacts[place] for place in council)
            ballot = Ballot(number, "agent")
            signed = [(n, self.room.identities[place]) for n, place in enumerate(sitting[:signers])]
            votes = [(n, 7, sign_change(each, T, number, ballot, members, 7)) for n, each in signed]
            charter, sitting = charter.extended(members, ballot, tuple(votes)), list(council)
        return charter

    def lessee(self, place: int) -> Lessee:
        """The claim of an agent."""
        return self.room.bidders[place].lessee(T)

    def run_for(self, seconds: float) -> None:
        """Let time pass."""
        self.room.clock.advance(seconds)

    def wanting(self, place: int, seconds: float = 0.1) -> Lessee:
        """An agent that has wanted the lease for some seconds."""
        lessee = self.lessee(place)
        lessee.want()
        self.run_for(seconds)
        return lessee

    def holders(self) -> list[int]:
        """Who holds the lease by its own clock."""
        return [place for place in self.room.agents if self.lessee(place).lease is not None]

    def cut(self, place: int, *others: int) -> None:
        """Let a place and others not hear each other."""
        self.room.radio.cut |= {pair for other in others for pair in ((place, other), (other, place))}

    def token(self, place: int) -> int:
        """The token that an agent holds."""
        lease = self.lessee(place).lease
        assert lease is not None, f"{place} holds nothing"
        return lease.token

    def outcome(self, work: Deferred[Any], seconds: float = 1.0) -> Any:
        """What came of it in time: a result, or the exception."""
        got: list[Any] = []
        work.addCallbacks(got.append, lambda failure: got.append(failure.value))
        self.run_for(seconds)
        return got[0] if got else "nothing yet"
