"""Probe an address for a node of any team, with the datagrams PROBE and PROBE_REPLY.

Neither datagram is encrypted or contains a secret.  With a probe, a node that cannot find its team learns whether an
address is reachable, which team uses it, the protocol version, the clock difference, and its own external address.
PROBE and PROBE_REPLY have the same length, and replies are rate-limited.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IDelayedCall, IReactorTime

from middleware.entangled.background import cancel
from middleware.entangled.errors import Malformed, NoAnswer
from middleware.entangled.network.network import ADDRESS_BYTES, Address, pack_address, parse_address
from middleware.entangled.token_bucket import TokenBucket
from middleware.entangled.wire.congestion import BACKOFF_FACTOR, INITIAL_TIMEOUT_S, MAX_TIMEOUT_S

T = TypeVar("T")
PROBE, PROBE_REPLY = 0x19, 0x1A
VERSION = 1
TOKEN_BYTES = 16
FINGERPRINT_BYTES = 8
REPLIES_PER_S = 20.0
"""The maximum number of PROBE_REPLY datagrams per second (8 kbit/s): enough for the diagnostics of a whole team."""
_HEADER_BYTES = 1 + TOKEN_BYTES
PROBE_BYTES = _HEADER_BYTES + 1 + FINGERPRINT_BYTES + 8 + ADDRESS_BYTES


class ProbeReply(NamedTuple):
    """The content of a PROBE_REPLY.

    ``fingerprint`` identifies the team (zero: an open team), ``wall`` is the clock of the replying node in Unix seconds
    (0: unknown), ``observed_address`` is the source address of the PROBE.
    """

    token: bytes
    version: int
    fingerprint: bytes
    unix_time_s: float
    observed_address: Address | None


def pack_probe(token: bytes) -> bytes:
    """Return a PROBE; ``token`` (16 bytes) is returned in the PROBE_REPLY."""
    return (bytes([PROBE]) + token).ljust(PROBE_BYTES, b"\0")


def pack_reply(probe: bytes, fingerprint: bytes, wall: float, source: Address) -> bytes:
    """Return the PROBE_REPLY for the PROBE ``probe`` from ``source``; raise ``Malformed`` if it is not a PROBE."""
    if len(probe) != PROBE_BYTES or probe[0] != PROBE:
        raise Malformed("the PROBE has the wrong length")
    moment = max(0, int(1000 * wall)).to_bytes(8, "little")
    return (
        bytes([PROBE_REPLY]) + probe[1:_HEADER_BYTES] + bytes([VERSION]) + fingerprint + moment + pack_address(source)
    )


def parse_reply(datagram: bytes) -> ProbeReply:
    """Decode a PROBE_REPLY; raise ``Malformed``."""
    if len(datagram) != PROBE_BYTES or datagram[0] != PROBE_REPLY:
        raise Malformed("the PROBE_REPLY has the wrong length")
    rest = datagram[_HEADER_BYTES:]
    fingerprint, moment = rest[1 : 1 + FINGERPRINT_BYTES], rest[1 + FINGERPRINT_BYTES : -ADDRESS_BYTES]
    wall = int.from_bytes(moment, "little") / 1000
    return ProbeReply(datagram[1:_HEADER_BYTES], rest[0], fingerprint, wall, parse_address(rest[-ADDRESS_BYTES:]))


class ProbeResponder:
    """Answers up to ``REPLIES_PER_S`` probes per second; ``send`` sends a datagram, ``wall`` returns Unix seconds."""

    def __init__(
        self, send: Callable[[bytes, Address], None], clock: IReactorTime, fingerprint: Callable[[], bytes]
    ) -> None:
        self.unix_time: Callable[[], float] = lambda: 0.0
        self._send = send
        self._clock = clock
        self._fingerprint = fingerprint
        self._bucket = TokenBucket(REPLIES_PER_S)

    def on_probe(self, datagram: bytes, source: Address) -> str:
        """Reply to a PROBE; return a one-word reason if the PROBE was dropped, else an empty string."""
        try:
            answer = pack_reply(datagram, self._fingerprint(), self.unix_time(), source)
        except Malformed:
            return "malformed"
        if not self._bucket.take(self._clock.seconds()):
            return "crowded"
        self._send(answer, source)
        return ""


@dataclass(slots=True, eq=False)
class PendingProbe(Generic[T]):
    """A request to an address outside of any session; successive tries send the ``datagrams`` one after the other."""

    address: Address
    datagrams: Sequence[bytes]
    started_at: float
    deadline: float
    deferred: Deferred[T]
    tries: int = 0
    timer: IDelayedCall | None = None


class ProbeSender(Generic[T]):
    """Resends each probe until it is answered or its timeout expires; ``send`` sends a datagram."""

    failure_text = "no answer"

    def __init__(self, send: Callable[[bytes, Address], None], clock: IReactorTime) -> None:
        self._send = send
        self._clock = clock
        self._pending: dict[bytes, PendingProbe[T]] = {}

    def stop(self, error: Exception) -> None:
        """Fail the pending probes with ``error``."""
        for token in list(self._pending):
            probe = self._forget(token)
            if probe is not None:
                probe.deferred.errback(error)

    def _start(self, token: bytes, address: Address, datagrams: Sequence[bytes], timeout: float) -> Deferred[T]:
        now, deferred = self._clock.seconds(), Deferred[T](lambda _: self._drop(token))
        self._pending[token] = PendingProbe(address, datagrams, now, now + timeout, deferred)
        self._try(token, INITIAL_TIMEOUT_S)
        return deferred

    def _try(self, token: bytes, wait: float) -> None:
        probe = self._pending[token]
        left = probe.deadline - self._clock.seconds()
        if left <= 0:
            self._forget(token)
            probe.deferred.errback(NoAnswer(f"{self.failure_text} at {probe.address}"))
            return
        self._send(probe.datagrams[probe.tries % len(probe.datagrams)], probe.address)
        probe.tries += 1
        wait = min(wait, MAX_TIMEOUT_S)
        probe.timer = self._clock.callLater(min(wait, left), self._try, token, wait * BACKOFF_FACTOR)

    def _drop(self, token: bytes) -> None:
        self._forget(token)

    def _forget(self, token: bytes) -> PendingProbe[T] | None:
        probe = self._pending.pop(token, None)
        if probe is not None:
            cancel(probe.timer)
        return probe


class Prober(ProbeSender[ProbeReply]):
    """Sends PROBE datagrams to addresses; ``send`` sends a datagram."""

    def __init__(self, send: Callable[[bytes, Address], None], clock: IReactorTime, rng: random.Random) -> None:
        super().__init__(send, clock)
        self._rng = rng

    def probe(self, address: Address, timeout: float = 1.5) -> Deferred[ProbeReply]:
        """Probe ``address``; fails with ``NoAnswer`` after ``timeout`` seconds."""
        token = self._rng.randbytes(TOKEN_BYTES)
        return self._start(token, address, [pack_probe(token)], timeout)

    def on_reply(self, datagram: bytes, source: Address) -> str:
        """Process a PROBE_REPLY; return a one-word reason if it was dropped, else an empty string."""
        try:
            answer = parse_reply(datagram)
        except Malformed:
            return "malformed"
        probe = self._pending.get(answer.token)
        if probe is None:
            return "unasked"
        if probe.address == source:
            self._forget(answer.token)
            probe.deferred.callback(answer)
        return ""
