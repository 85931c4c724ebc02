"""Provide acceptors for tests that apply to both protocols built on Paxos: tuple takes and leases.

A ``Use`` describes one of these protocols.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from middleware.consensus.lease import lease_codec
from middleware.consensus.lease.lease_codec import EARLY_PROMISE_SHARE
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.quorum.acceptor import Acceptor, AcceptorSettings
from middleware.entangled.quorum.acceptor_log import Codec, RegisterLog
from middleware.entangled.quorum.ballot import FIRST_CONFIGURATION, Ballot
from middleware.entangled.quorum.register import Reply
from middleware.entangled.space import take_acceptor, take_codec
from middleware.entangled.space.tuple_record import TupleId
from tests.middleware.consensus.lease.test_lease_codec import MEMBERS

TTL = 10.0


@dataclass(frozen=True)
class Use:
    """A protocol built on Paxos, with the register key, the proposers and the values for its tests."""

    key: Any
    codec: Codec[Any]
    terms: AcceptorSettings
    names: tuple[Any, ...]
    values: tuple[Any, ...]

    def ballot(self, number: int, name: int) -> Ballot:
        """Return the ballot of a proposer that was never restarted."""
        return Ballot(number * self.codec.lives, self.names[name])


TAKE = Use(
    TupleId(b"k" * 20, b"o" * 32, "t", b"m" * 8),
    take_codec.CODEC,
    take_acceptor.TERMS,
    (b"a", b"b", b"c"),
    (b"x", b"y", b"z"),
)
LEASE = Use(
    "t",
    lease_codec.CODEC,
    AcceptorSettings(EARLY_PROMISE_SHARE),
    ("a", "b", "c"),
    (MEMBERS[:3], MEMBERS[1:4], MEMBERS[2:5]),
)


class Member:
    """An acceptor for one use, with a store that survives restarts."""

    def __init__(self, use: Use) -> None:
        self.use = use
        self.store = MemoryStore()
        self.restart(0.0)

    def restart(self, now: float) -> None:
        self.acceptor = Acceptor(RegisterLog(self.store, self.use.codec, lambda *_: False, now), self.use.terms)

    def prepare(
        self, ballot: Ballot, now: float, reserve: float = 0.0, configuration: int = FIRST_CONFIGURATION
    ) -> Reply:
        return self.acceptor.prepare(self.use.key, configuration, ballot, TTL, now, reserve)

    def lease(self, ballot: Ballot, token: int, now: float, configuration: int = FIRST_CONFIGURATION) -> Reply:
        return self.acceptor.lease(self.use.key, configuration, ballot, token, TTL, now)

    def accept(self, ballot: Ballot, value: Any, now: float, configuration: int = FIRST_CONFIGURATION) -> Reply:
        return self.acceptor.accept(self.use.key, configuration, ballot, value, now)

    def release(self, ballot: Ballot, now: float, rest: float = 0.0) -> Reply:
        return self.acceptor.release(self.use.key, ballot, now, rest)
