"""Peer: what an endpoint remembers of another one: its sessions, its round trips, what is asked of it."""

from __future__ import annotations

from dataclasses import dataclass, field

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IDelayedCall

from middleware.entangled.network.network import Address
from middleware.entangled.wire.handshake import Invitation
from middleware.entangled.wire.roundtrip import RoundTrip
from middleware.entangled.wire.session import Session

MAX_SESSIONS = 3
SESSION_LIFE_S = 3600.0
SESSION_END_S = SESSION_LIFE_S + 600.0


@dataclass(slots=True, eq=False)
class Inquiry:
    """A question of ours that waits for its answer; ``is_patient`` where the caller gave a longer time-out."""

    number: int
    method: str
    peer: Peer
    address: Address
    message: bytes
    changes: bool
    asked_at: float
    deadline: float
    is_patient: bool
    deferred: Deferred[object]
    tries: int = 0
    sent_at: float = 0.0
    timer: IDelayedCall | None = None


@dataclass(slots=True, eq=False)
class Opening:
    """A handshake of ours that waits for its RESP; ``rider`` is the question that travels in its INIT."""

    invitation: Invitation
    peer: Peer
    address: Address
    rider: Inquiry | None
    started_at: float
    tries: int = 0
    timer: IDelayedCall | None = None


@dataclass(slots=True, eq=False)
class Peer:
    """One peer, known by its public key; ``static`` is the X25519 key that follows from it."""

    public: bytes
    static: bytes
    sessions: list[Session] = field(default_factory=list)
    opening: Opening | None = None
    round_trip: RoundTrip = field(default_factory=RoundTrip)
    tells: list[bytes] = field(default_factory=list)
    inquiries: dict[int, Inquiry] = field(default_factory=dict)

    @property
    def session(self) -> Session | None:
        """The session that is used for sending: the newest one."""
        return self.sessions[-1] if self.sessions else None

    @property
    def is_idle(self) -> bool:
        """Whether nobody waits for anything from this peer."""
        return self.opening is None and not self.inquiries
