"""Door: whom a node lets in, and what it lets them do; the endpoint asks it, and it knows nothing of wires.

An open team lets in whoever holds its key.  In a closed one each side shows a *pass* in the handshake, and its door
judges the other's.  Which passes hold, and who has which role, is the affair of whoever makes the door; here are only
the names of the refusals, with what to do about each.

A store that was copied makes two nodes with one identity.  So each life of an identity has a number that grows from
start to start, and eight random bytes: of two lives the later one holds, and the other one is told.

Each INIT has a timestamp that grows within a life.  So a recorded INIT is older than the newest one of its sender, or
equal to it, and is refused (after WireGuard, Donenfeld 2017, section 5.1; the life number takes the place of its wall
clock, which a robot may not have).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from middleware.entangled.bounded import keep
from middleware.entangled.record import Slot
from middleware.entangled.token_bucket import TokenBucket

NONCE = 8
MAX_ROOM = 640
"""Bytes of a pass at most: so a handshake has room for a question beside it."""
MAX_LIFE = 2**63 - 1
MAX_LIVES = 4096
"""Identities whose lives are remembered; the one that was heard longest ago goes first."""
MAX_NOTED = 1024
LINES = 20.0

EXPIRED, EARLY, REVOKED, FOREIGN = "expired", "early", "revoked", "foreign"
DOUBLED, SUPERSEDED, ROLE, UNLISTED = "doubled", "superseded", "role", "unlisted"

_REFUSALS = {
    EXPIRED: "the certificate has expired, or one of the two clocks is wrong; look at both clocks (swarm doctor tells"
    " which is off), else have the operator renew that node (swarm renew)",
    EARLY: "the certificate is not valid yet, or one of the two clocks is wrong; look at both clocks (swarm doctor"
    " tells which is off), else wait until it is",
    REVOKED: "the operator revoked the certificate; only a new code lets that node in again (swarm invite, swarm join)",
    FOREIGN: "the certificate is not one of this team; join with a code of this team's operator (swarm join CODE)",
    DOUBLED: "another node runs with the same identity; stop one of them, for each needs a membership or store of"
    " its own; if the files were stolen, have the operator revoke them (swarm revoke, swarm rotate)",
    SUPERSEDED: "a node with the same identity was started later; stop one of them, for each needs a membership or"
    " store of its own; if the files were stolen, have the operator revoke them (swarm revoke, swarm rotate)",
    UNLISTED: "the membership list has no room for it, or its invitation or its gateway was used too often; have the"
    " operator look at the list (swarm members) and revoke those who should not be there (swarm revoke)",
    ROLE: "its role does not allow that; ask the operator for another role",
}


class Life(NamedTuple):
    """One life of an identity: ``number`` grows from start to start (0: nobody counts), ``nonce`` is random."""

    number: int = 0
    nonce: bytes = bytes(NONCE)


UNCOUNTED = Life()


class Authority(NamedTuple):
    """Why the certificate of an owner of records does not hold at present (``refusal``); else its roles and its name.

    ``FOREIGN`` stands for an owner whose certificate this node has not seen.
    """

    refusal: str = ""
    roles: tuple[str, ...] = ()
    name: str = ""

    @property
    def is_final(self) -> bool:
        """Whether no clock and no certificate that is yet to come can make the records good that it does not cover."""
        return self.refusal in ("", REVOKED, ROLE)


class Door(Protocol):
    """Whom a team lets in; the endpoint asks again at each handshake, so what it answers may change.

    ``room`` is the number of bytes that a pass of this team may take, at most ``MAX_ROOM``, and the same for all its
    members; 0 in an open team.  ``shown`` is this node's own pass, ``life`` the life that it lives.  ``fingerprint``
    is what anybody may know of the team, 8 bytes (zero: it does not say).  The methods answer as an open team does.
    """

    @property
    def room(self) -> int:
        """Bytes that a pass of this team may take."""

    @property
    def shown(self) -> bytes:
        """This node's own pass."""

    @property
    def life(self) -> Life:
        """The life that this node lives."""

    @property
    def fingerprint(self) -> bytes:
        """Eight bytes by which strangers tell this team from others; zero where it does not say."""

    def judge(self, public: bytes, shown: bytes) -> str:
        """The name of the refusal of a node with this key that shows this pass; empty where it would be let in.

        Changes nothing: what it judges may be a recording.
        """
        return ""

    def admit(self, public: bytes, shown: bytes) -> str:
        """As ``judge``, of a node that has confirmed its session, so it may be remembered."""
        return ""

    def may(self, public: bytes, method: str) -> bool:
        """Whether ``public`` is the key of a present member that may call ``method``; no, where it is not known."""
        return True

    def may_store(self, slot: Slot) -> bool:
        """Whether the certificate of the owner of ``slot``, as it is at present, allows it to write there."""
        return True

    def may_stay(self, slot: Slot) -> bool:
        """Whether what is held in ``slot``, written when its owner was allowed to, may be held on and shown."""
        return True

    def authority(self, owner: bytes) -> Authority:
        """What ``may_store`` goes by for this owner; it changes when that does."""
        return Authority()

    def roles_of(self, public: bytes) -> frozenset[str] | None:
        """Return the roles that the holder of that key has now, none for a stranger or a revoked or expired member.

        None means that the team is open and restricts nobody.
        """
        return None

    def certificate(self, owner: bytes) -> bytes:
        """The certificate of an owner by which other nodes can judge its records; empty where it is unknown."""
        return b""

    def learn(self, owner: bytes, certificate: bytes) -> bool:
        """Take in the certificate of an owner that another node showed; whether it holds."""
        return False


class OpenDoor(Door):
    """The door of an open team: who holds the key is in, and may do everything."""

    room = 0
    shown = b""
    life = UNCOUNTED
    fingerprint = bytes(8)


OPEN = OpenDoor()
UNPROTECTED = (
    "whoever knows its team_key is a member and may do everything, nobody can be put out, and who records the wire"
    " and learns the key later can pretend to be any newcomer; docs/explanation/trust-model.md says more"
)
"""What an open team does not protect."""


def meaning(code: str) -> str:
    """What a refusal means and what to do about it, in words; the code itself where nobody knows it."""
    return _REFUSALS.get(code, code)


def is_refusal(code: str) -> bool:
    """Whether ``code`` can be the name of a refusal: 1 to 32 printable ASCII characters."""
    return 0 < len(code) <= 32 and code.isascii() and code.isprintable()


def next_life(last: int, wall: float) -> int:
    """The number of the life after ``last`` (0: none is known), begun at ``wall`` seconds.

    It is a moment where that is later, so that a node that lost its store is not taken for an older copy of itself.
    """
    return min(max(last + 1, int(wall)), MAX_LIFE)


class Lives:
    """Which life of each identity was met last; bounded, and empty after a restart."""

    def __init__(self) -> None:
        self._known: dict[bytes, tuple[Life, Life]] = {}  # the last one, and the one before it

    def __len__(self) -> int:
        return len(self._known)

    def judge(self, public: bytes, life: Life) -> str:
        """The name of the refusal of this life, empty where it is the last one or a later one; remembers nothing."""
        last, before = self._known.get(public, (life, life))
        if life == last or life.number > last.number or not life.number:
            return ""
        return SUPERSEDED if life == before else DOUBLED

    def met(self, public: bytes, life: Life) -> bool:
        """Take note of a life that was proved and not refused; whether it follows another one."""
        if not life.number:
            return False
        last, before = self._known.get(public, (life, life))
        keep(self._known, public, (last, before) if life == last else (life, last), MAX_LIVES)
        return life != last

    def forget(self, public: bytes) -> None:
        """Forget what is known of an identity."""
        self._known.pop(public, None)


class Stamps:
    """The newest INIT of each identity that was let in; bounded, and empty after a restart."""

    def __init__(self) -> None:
        self._newest: dict[bytes, tuple[Life, int]] = {}

    def __len__(self) -> int:
        return len(self._newest)

    def take(self, public: bytes, life: Life, stamp: int) -> bool:
        """Whether an INIT is newer than every one before it of its sender; it is the newest one then.

        An INIT may be noted before its session is confirmed: a recording is never newer than what its sender sends
        next.  Without a life or a timestamp it counts as new.
        """
        if not life.number or not stamp:
            return True
        last, newest = self._newest.get(public, (UNCOUNTED, 0))
        if life.number < last.number or (life == last and stamp <= newest):
            return False
        keep(self._newest, public, (life, stamp), MAX_LIVES)
        return True


class Noted:
    """Which refusals were logged, so that each is said once and not for each datagram; bounded.

    Who invents keys can have no more lines written than ``LINES`` at once and one a second.
    """

    def __init__(self) -> None:
        self._said: dict[tuple[object, ...], None] = {}
        self._lines = TokenBucket(1.0, LINES)

    def is_new(self, now: float, *what: object) -> bool:
        """Whether to log ``what``; noted it is then."""
        is_new = what not in self._said
        if is_new and not self._lines.take(now):
            return False
        keep(self._said, what, None, MAX_NOTED)
        return is_new


def checked_secrets(secrets: Sequence[bytes]) -> tuple[bytes, ...]:
    """The secrets of a team, newest first; raises ``ValueError`` where there is none or one has not 32 bytes."""
    if not secrets or any(len(secret) != 32 for secret in secrets):
        raise ValueError("a team has at least one secret, each of 32 bytes")
    return tuple(dict.fromkeys(secrets))
