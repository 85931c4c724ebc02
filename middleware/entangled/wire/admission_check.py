"""Decide which nodes a team admits and which methods they may call, independently of the transport.

An open team admits every node that has the team's key.  In a closed team each side sends an admission credential in the
handshake, and the other side checks this credential with its ``AdmissionCheck``.  The implementation of
``AdmissionCheck`` decides which credentials are valid and which roles they grant; this module defines only the refusal
codes, with a remedy for each.

Two nodes have the same identity if a store was copied.  Each run of a node from start to stop is an incarnation
(``Incarnation``) of its identity.  An incarnation has a number that grows from start to start, and eight random bytes.
Of two incarnations the later one is admitted and the earlier one is refused.

Each INIT has a timestamp that grows within an incarnation.  An INIT that is not newer than the newest INIT of its
sender is a replay and is dropped (after WireGuard, Donenfeld 2017, section 5.1).  WireGuard uses the wall clock for
this; here the incarnation number replaces it, because a robot may not have a wall clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from middleware.entangled.bounded import put_bounded
from middleware.entangled.record import Slot
from middleware.entangled.token_bucket import TokenBucket

NONCE_BYTES = 8
MAX_PASS_BYTES = 640
"""The maximum length of an admission credential in bytes; it leaves space for a request in the handshake."""
MAX_INCARNATION = 2**63 - 1
MAX_IDENTITIES = 4096
"""The number of identities with a remembered incarnation; the least recently used identity is deleted first."""
MAX_LOGGED = 1024
LOG_BURST = 20.0

EXPIRED, EARLY, REVOKED, FOREIGN = "expired", "early", "revoked", "foreign"
DOUBLED, SUPERSEDED, ROLE, UNLISTED = "doubled", "superseded", "role", "unlisted"

_EXPLANATIONS = {
    EXPIRED: "the certificate has expired, or one of the two clocks is wrong; check both clocks (swarm doctor shows"
    " which is wrong); if both are right, ask the operator to renew that node's certificate (swarm renew)",
    EARLY: "the certificate is not valid yet, or one of the two clocks is wrong; check both clocks (swarm doctor"
    " shows which is wrong); if both are right, wait until the certificate is valid",
    REVOKED: "the operator revoked the certificate; admit the node again with a new code (swarm invite, swarm join)",
    FOREIGN: "the certificate belongs to another team; join with a code of this team's operator (swarm join CODE)",
    DOUBLED: "another node runs with the same identity; stop one of the two nodes: each needs its own membership and"
    " store; if the files were stolen, ask the operator to revoke this membership (swarm revoke, swarm rotate)",
    SUPERSEDED: "a node with the same identity was started later; stop one of the two nodes: each needs its own"
    " membership and store; if the files were stolen, ask the operator to revoke this membership (swarm revoke, swarm"
    " rotate)",
    UNLISTED: "the membership list is full, or the invitation or the gateway of the node was used too often; ask the"
    " operator to check the list (swarm members) and to revoke unwanted members (swarm revoke)",
    ROLE: "the role of the node does not allow this call; ask the operator for another role",
}


class Incarnation(NamedTuple):
    """One incarnation of an identity: ``number`` grows from start to start (0: unknown), ``nonce`` is random."""

    number: int = 0
    nonce: bytes = bytes(NONCE_BYTES)


UNNUMBERED = Incarnation()


class Authority(NamedTuple):
    """The roles and name of an owner of records, or the current ``refusal`` of the owner's certificate.

    The refusal is FOREIGN as long as this node has not received the owner's certificate.
    """

    refusal: str = ""
    roles: tuple[str, ...] = ()
    name: str = ""

    @property
    def is_final(self) -> bool:
        """Whether records that this authority does not allow can never become valid later.

        If the refusal is not final, they may become valid with time, or by a later certificate.
        """
        return self.refusal in ("", REVOKED, ROLE)


class AdmissionCheck(Protocol):
    """The admission check of a team; the endpoint repeats the check at each handshake, so the results may change.

    ``max_pass_bytes`` is the maximum length of an admission credential in this team: at most ``MAX_PASS_BYTES``, equal
    for all members, and 0 in an open team.  ``own_pass`` is this node's credential, ``incarnation`` its current
    incarnation.  ``fingerprint`` is the public identifier of the team, 8 bytes (zero: none).  The default methods
    behave as in an open team.
    """

    @property
    def max_pass_bytes(self) -> int:
        """The maximum length of an admission credential of this team in bytes."""

    @property
    def own_pass(self) -> bytes:
        """This node's admission credential."""

    @property
    def incarnation(self) -> Incarnation:
        """The current incarnation of this node."""

    @property
    def fingerprint(self) -> bytes:
        """Eight bytes that identify this team publicly, without its key; zero in an open team."""

    def find_refusal(self, public: bytes, peer_pass: bytes) -> str:
        """Return the refusal code for a node with this key and admission credential; empty if it would be admitted.

        This method changes no state, because the handshake may be a replay.
        """
        return ""

    def admit(self, public: bytes, peer_pass: bytes) -> str:
        """Return the same as ``find_refusal``, for a node with a confirmed session; this method may record the node."""
        return ""

    def may_call(self, public: bytes, method: str) -> bool:
        """Return whether ``public`` is the key of a current member that may call ``method``."""
        return True

    def may_store(self, slot: Slot) -> bool:
        """Return whether the current certificate of the owner of ``slot`` allows the owner to write there."""
        return True

    def may_keep(self, slot: Slot) -> bool:
        """Return whether a record in ``slot`` that was allowed when it was written may still be stored and returned."""
        return True

    def find_authority(self, owner: bytes) -> Authority:
        """Return the authority of this owner; ``may_store`` depends on this authority."""
        return Authority()

    def roles_of(self, public: bytes) -> frozenset[str] | None:
        """Return the current roles of the node with a key; empty for an unknown node or a revoked or expired member.

        None: the team is open, and every node may do everything.
        """
        return None

    def find_certificate(self, owner: bytes) -> bytes:
        """Return the certificate with which other nodes can check the records of ``owner``; empty if it is unknown."""
        return b""

    def add_certificate(self, owner: bytes, certificate: bytes) -> bool:
        """Store the certificate of an owner, received from another node; return whether the certificate is valid."""
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

    The number is ``last`` + 1, or ``wall`` if that is higher.  A node that lost its store therefore does not look like
    an older copy of itself.
    """
    return min(max(last + 1, int(wall)), MAX_INCARNATION)


class Incarnations:
    """The latest incarnation of each identity; bounded, and empty after a restart."""

    def __init__(self) -> None:
        self._known: dict[bytes, tuple[Incarnation, Incarnation]] = {}  # the latest incarnation and the previous one

    def __len__(self) -> int:
        return len(self._known)

    def find_refusal(self, public: bytes, incarnation: Incarnation) -> str:
        """Return the code with which this incarnation is refused, or an empty string if no later incarnation is known.

        This method changes no state.
        """
        last, before = self._known.get(public, (incarnation, incarnation))
        if incarnation == last or incarnation.number > last.number or not incarnation.number:
            return ""
        return SUPERSEDED if incarnation == before else DOUBLED

    def record(self, public: bytes, incarnation: Incarnation) -> bool:
        """Record an incarnation that was verified and admitted; return whether it replaces an earlier incarnation."""
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
        """Return whether an INIT is newer than all INITs received from its sender, and record it.

        An INIT may be recorded before its session is confirmed: a replay is never newer than the next INIT of its
        sender.  An INIT that has no incarnation or no timestamp is treated as new.
        """
        if not incarnation.number or not timestamp:
            return True
        last, newest = self._newest.get(public, (UNNUMBERED, 0))
        if incarnation.number < last.number or (incarnation == last and timestamp <= newest):
            return False
        put_bounded(self._newest, public, (incarnation, timestamp), MAX_IDENTITIES)
        return True


class LogLimiter:
    """Limits the log of refusals: each refusal is logged once instead of for each datagram; bounded.

    A sender that invents keys causes at most a burst of ``LOG_BURST`` log lines, and then one line per second.
    """

    def __init__(self) -> None:
        self._logged: dict[tuple[object, ...], None] = {}
        self._rate_limit = TokenBucket(1.0, LOG_BURST)

    def should_log(self, now: float, *what: object) -> bool:
        """Return whether to log ``what``; if so, record it as logged."""
        is_new = what not in self._logged
        if is_new and not self._rate_limit.take(now):
            return False
        put_bounded(self._logged, what, None, MAX_LOGGED)
        return is_new


def check_secrets(secrets: Sequence[bytes]) -> tuple[bytes, ...]:
    """Return a team's secrets, newest first; raise ``ValueError`` if there is none or one does not have 32 bytes."""
    if not secrets or any(len(secret) != 32 for secret in secrets):
        raise ValueError("the team secrets are invalid: at least one is needed, and each must have 32 bytes")
    return tuple(dict.fromkeys(secrets))
