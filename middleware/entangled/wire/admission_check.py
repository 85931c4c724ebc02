"""Decide which nodes a team admits and which methods they may call, independently of the transport.

An open team admits every node that holds its key.  In a closed team each side shows a *pass* in the handshake, and the
admission check (``AdmissionCheck``) of the other side judges it.  The implementation of ``AdmissionCheck`` decides
which passes are valid and which roles they grant; this module defines only the refusal codes, with a remedy for each.

A copied store makes two nodes with one identity.  Therefore each incarnation (``Incarnation``) of an identity has a
number that grows from start to start, and eight random bytes: of two incarnations the later one is admitted, and the
other is refused.

Each INIT has a timestamp that grows within an incarnation.  A replayed INIT is older than the newest one of its sender,
or equal to it, and is dropped (after WireGuard, Donenfeld 2017, section 5.1; the incarnation number replaces its wall
clock, which a robot may not have).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from middleware.entangled.bounded import put_bounded
from middleware.entangled.record import Slot
from middleware.entangled.token_bucket import TokenBucket

NONCE_BYTES = 8
MAX_PASS_BYTES = 640
"""The maximum length of a pass in bytes, which leaves room for a request in the handshake."""
MAX_INCARNATION = 2**63 - 1
MAX_IDENTITIES = 4096
"""The number of identities with a remembered incarnation; the least recently met one is deleted first."""
MAX_LOGGED = 1024
LOG_BURST = 20.0

EXPIRED, EARLY, REVOKED, FOREIGN = "expired", "early", "revoked", "foreign"
DOUBLED, SUPERSEDED, ROLE, UNLISTED = "doubled", "superseded", "role", "unlisted"

_EXPLANATIONS = {
    EXPIRED: "the certificate has expired, or one of the two clocks is wrong; check both clocks (swarm doctor shows"
    " which is wrong), else have the operator renew that node's certificate (swarm renew)",
    EARLY: "the certificate is not valid yet, or one of the two clocks is wrong; check both clocks (swarm doctor"
    " shows which is wrong), else wait until it is valid",
    REVOKED: "the operator revoked the certificate; admit the node again with a new code (swarm invite, swarm join)",
    FOREIGN: "the certificate belongs to another team; join with a code of this team's operator (swarm join CODE)",
    DOUBLED: "another node runs with the same identity; stop one of them, because each needs a separate membership or"
    " store; if the files were stolen, have the operator revoke them (swarm revoke, swarm rotate)",
    SUPERSEDED: "a node with the same identity was started later; stop one of them, because each needs a separate"
    " membership or store; if the files were stolen, have the operator revoke them (swarm revoke, swarm rotate)",
    UNLISTED: "the membership list is full, or the invitation or the gateway of the node was used too often; have the"
    " operator check the list (swarm members) and revoke unwanted members (swarm revoke)",
    ROLE: "the role of the node does not allow this call; ask the operator for another role",
}


class Incarnation(NamedTuple):
    """One incarnation of an identity: ``number`` grows from start to start (0: not counted), ``nonce`` is random."""

    number: int = 0
    nonce: bytes = bytes(NONCE_BYTES)


UNNUMBERED = Incarnation()


class Authority(NamedTuple):
    """The roles and name of an owner of records, or the ``refusal`` that applies to its certificate at present.

    An owner has the refusal FOREIGN while this node has not seen its certificate.
    """

    refusal: str = ""
    roles: tuple[str, ...] = ()
    name: str = ""

    @property
    def is_final(self) -> bool:
        """Whether neither time nor a later certificate can validate records that this authority does not cover."""
        return self.refusal in ("", REVOKED, ROLE)


class AdmissionCheck(Protocol):
    """The admission check of a team; the endpoint repeats it at each handshake, so its results may change.

    ``max_pass_bytes`` is the maximum length of a pass in this team, at most ``MAX_PASS_BYTES`` and equal for all
    members; 0 in an open team.  ``shown`` is this node's pass, ``life`` its current incarnation.  ``fingerprint`` is
    the public identifier of the team, 8 bytes (zero: none).  The default methods behave as in an open team.
    """

    @property
    def max_pass_bytes(self) -> int:
        """The maximum length of a pass of this team in bytes."""

    @property
    def own_pass(self) -> bytes:
        """This node's pass."""

    @property
    def incarnation(self) -> Incarnation:
        """The current incarnation of this node."""

    @property
    def fingerprint(self) -> bytes:
        """Eight bytes that distinguish this team from others without its key; zero if it has none."""

    def find_refusal(self, public: bytes, peer_pass: bytes) -> str:
        """Return the refusal code of a node with this key that shows this pass; empty if it would be admitted.

        It changes no state, because the handshake may be a replay.
        """
        return ""

    def admit(self, public: bytes, peer_pass: bytes) -> str:
        """Like ``find_refusal``, for a node that has confirmed its session and may be recorded."""
        return ""

    def may_call(self, public: bytes, method: str) -> bool:
        """Return whether ``public`` is the key of a present member that may call ``method``; False if unknown."""
        return True

    def may_store(self, slot: Slot) -> bool:
        """Return whether the current certificate of the owner of ``slot`` allows it to write there."""
        return True

    def may_keep(self, slot: Slot) -> bool:
        """Return whether a record in ``slot`` that was allowed when it was written may still be stored and returned."""
        return True

    def find_authority(self, owner: bytes) -> Authority:
        """Return the authority of this owner, on which ``may_store`` is based."""
        return Authority()

    def roles_of(self, public: bytes) -> frozenset[str] | None:
        """Return the present roles of the holder of a key; empty for a stranger or a revoked or expired member.

        None means that the team is open and restricts no node.
        """
        return None

    def find_certificate(self, owner: bytes) -> bytes:
        """Return the certificate of an owner, by which other nodes can check its records; empty if it is unknown."""
        return b""

    def add_certificate(self, owner: bytes, certificate: bytes) -> bool:
        """Store the certificate of an owner that another node showed; return whether it is valid."""
        return False


class OpenAdmission(AdmissionCheck):
    """The admission check of an open team: every node with the team key is admitted and may call everything."""

    max_pass_bytes = 0
    own_pass = b""
    incarnation = UNNUMBERED
    fingerprint = bytes(8)


OPEN_ADMISSION = OpenAdmission()
OPEN_TEAM_WARNING = (
    "every node that knows the team_key is a member with all rights, no member can be revoked, and an attacker who"
    " records the traffic and learns the key later can impersonate any newcomer; see docs/explanation/trust-model.md"
)
"""The security limits of an open team."""


def explain(code: str) -> str:
    """Return the meaning and the remedy of a refusal code; the code itself if it is unknown."""
    return _EXPLANATIONS.get(code, code)


def is_refusal(code: str) -> bool:
    """Return whether ``code`` is a well-formed refusal code: 1 to 32 printable ASCII characters."""
    return 0 < len(code) <= 32 and code.isascii() and code.isprintable()


def next_incarnation(last: int, wall: float) -> int:
    """Return the number of the incarnation after ``last`` (0: unknown) that starts at ``wall`` seconds of Unix time.

    It is ``wall`` if that is higher, so that a node that lost its store does not appear as an older copy of itself.
    """
    return min(max(last + 1, int(wall)), MAX_INCARNATION)


class Incarnations:
    """The latest incarnation of each identity; bounded, and empty after a restart."""

    def __init__(self) -> None:
        self._known: dict[bytes, tuple[Incarnation, Incarnation]] = {}  # the latest one, and the one before it

    def __len__(self) -> int:
        return len(self._known)

    def find_refusal(self, public: bytes, incarnation: Incarnation) -> str:
        """Return the refusal code of this incarnation; empty if it is the latest or a later one.  Changes no state."""
        last, before = self._known.get(public, (incarnation, incarnation))
        if incarnation == last or incarnation.number > last.number or not incarnation.number:
            return ""
        return SUPERSEDED if incarnation == before else DOUBLED

    def record(self, public: bytes, incarnation: Incarnation) -> bool:
        """Record an incarnation that was verified and admitted; return whether it replaces another one."""
        if not incarnation.number:
            return False
        last, before = self._known.get(public, (incarnation, incarnation))
        put_bounded(self._known, public, (last, before) if incarnation == last else (incarnation, last), MAX_IDENTITIES)
        return incarnation != last

    def forget(self, public: bytes) -> None:
        """Forget the incarnations of an identity."""
        self._known.pop(public, None)


class InitTimestamps:
    """The newest INIT of each admitted identity; bounded, and empty after a restart."""

    def __init__(self) -> None:
        self._newest: dict[bytes, tuple[Incarnation, int]] = {}

    def __len__(self) -> int:
        return len(self._newest)

    def accept(self, public: bytes, incarnation: Incarnation, timestamp: int) -> bool:
        """Return whether an INIT is newer than every earlier one of its sender, and record it.

        An INIT may be recorded before its session is confirmed: a replay is never newer than the next INIT of its
        sender.  An INIT without an incarnation or a timestamp counts as new.
        """
        if not incarnation.number or not timestamp:
            return True
        last, newest = self._newest.get(public, (UNNUMBERED, 0))
        if incarnation.number < last.number or (incarnation == last and timestamp <= newest):
            return False
        put_bounded(self._newest, public, (incarnation, timestamp), MAX_IDENTITIES)
        return True


class LogLimiter:
    """Refusals that were logged, so that each is logged once instead of for each datagram; bounded.

    A sender that invents keys causes at most ``LOG_BURST`` log lines at once and one per second.
    """

    def __init__(self) -> None:
        self._logged: dict[tuple[object, ...], None] = {}
        self._rate_limit = TokenBucket(1.0, LOG_BURST)

    def should_log(self, now: float, *what: object) -> bool:
        """Return whether to log ``what``, and record it then."""
        is_new = what not in self._logged
        if is_new and not self._rate_limit.take(now):
            return False
        put_bounded(self._logged, what, None, MAX_LOGGED)
        return is_new


def check_secrets(secrets: Sequence[bytes]) -> tuple[bytes, ...]:
    """Return the secrets of a team, newest first; raise ``ValueError`` if there is none or one is not 32 bytes long."""
    if not secrets or any(len(secret) != 32 for secret in secrets):
        raise ValueError("a team has at least one secret, each of 32 bytes")
    return tuple(dict.fromkeys(secrets))
