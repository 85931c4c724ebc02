"""Probe an address for a node of any team, with HAIL and ECHO; neither is encrypted or contains a secret.

A node that finds no team, or not its own, learns from it whether an address is reachable, which team is there, the
protocol version, the clock difference, and its own external address.  HAIL and ECHO have the same length, and ECHOs are
rate-limited.
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
from middleware.entangled.network.network import ADDRESS, Address, address_of, packed_address
from middleware.entangled.token_bucket import TokenBucket
from middleware.entangled.wire.congestion import BACK_OFF, FIRST_GUESS, LONGEST

T = TypeVar("T")
HAIL, ECHO = 0x19, 0x1A
VERSION = 1
TOKEN = 16
FINGERPRINT = 8
RATE = 20.0
"""ECHOs per second: enough for the diagnostics of a whole team, and 8 kbit/s at most."""
_HEAD = 1 + TOKEN
HAIL_BYTES = _HEAD + 1 + FINGERPRINT + 8 + ADDRESS


class Echo(NamedTuple):
    """The content of an ECHO.

    ``fingerprint`` identifies the team (zero: an open team), ``wall`` is the clock of its node in Unix seconds (0:
    unknown), ``seen`` is the source address of the HAIL.
    """

    token: bytes
    version: int
    fingerprint: bytes
    wall: float
    seen: Address | None


def hail(token: bytes) -> bytes:
    """Return a HAIL; ``token`` (16 bytes) is returned in the ECHO."""
    return (bytes([HAIL]) + token).ljust(HAIL_BYTES, b"\0")


def echo(asked: bytes, fingerprint: bytes, wall: float, source: Address) -> bytes:
    """Return the ECHO for the HAIL ``asked`` from ``source``; raise ``Malformed`` if it is no HAIL."""
    if len(asked) != HAIL_BYTES or asked[0] != HAIL:
        raise Malformed("the HAIL has the wrong length")
    moment = max(0, int(1000 * wall)).to_bytes(8, "little")
    return bytes([ECHO]) + asked[1:_HEAD] + bytes([VERSION]) + fingerprint + moment + packed_address(source)


def echo_of(datagram: bytes) -> Echo:
    """Decode an ECHO; raise ``Malformed``."""
    if len(datagram) != HAIL_BYTES or datagram[0] != ECHO:
        raise Malformed("the ECHO has the wrong length")
    rest = datagram[_HEAD:]
    fingerprint, moment = rest[1 : 1 + FINGERPRINT], rest[1 + FINGERPRINT : -ADDRESS]
    wall = int.from_bytes(moment, "little") / 1000
    return Echo(datagram[1:_HEAD], rest[0], fingerprint, wall, address_of(rest[-ADDRESS:]))


class Echoer:
    """Answers up to ``RATE`` HAILs per second; ``send`` sends a datagram, ``wall`` returns Unix seconds."""

    def __init__(
        self, send: Callable[[bytes, Address], None], clock: IReactorTime, fingerprint: Callable[[], bytes]
    ) -> None:
        self.wall: Callable[[], float] = lambda: 0.0
        self._send = send
        self._clock = clock
        self._fingerprint = fingerprint
        self._bucket = TokenBucket(RATE)

    def on_hail(self, datagram: bytes, source: Address) -> str:
        """Answer a HAIL; return the reason in one word if it was dropped."""
        try:
            answer = echo(datagram, self._fingerprint(), self.wall(), source)
        except Malformed:
            return "malformed"
        if not self._bucket.take(self._clock.seconds()):
            return "crowded"
        self._send(answer, source)
        return ""


@dataclass(slots=True, eq=False)
class Probe(Generic[T]):
    """A request to an address without a session; ``datagrams`` are sent in turn."""

    address: Address
    datagrams: Sequence[bytes]
    begun_at: float
    deadline: float
    deferred: Deferred[T]
    tries: int = 0
    timer: IDelayedCall | None = None


class Probes(Generic[T]):
    """Resends each probe until it is answered or its timeout expires; ``send`` sends a datagram."""

    silence = "no answer"

    def __init__(self, send: Callable[[bytes, Address], None], clock: IReactorTime) -> None:
        self._send = send
        self._clock = clock
        self._pending: dict[bytes, Probe[T]] = {}

    def stop(self, error: Exception) -> None:
        """Fail the pending probes with ``error``."""
        for token in list(self._pending):
            probe = self._forget(token)
            if probe is not None:
                probe.deferred.errback(error)

    def _begin(self, token: bytes, address: Address, datagrams: Sequence[bytes], timeout: float) -> Deferred[T]:
        now, deferred = self._clock.seconds(), Deferred[T](lambda _: self._drop(token))
        self._pending[token] = Probe(address, datagrams, now, now + timeout, deferred)
        self._try(token, FIRST_GUESS)
        return deferred

    def _try(self, token: bytes, wait: float) -> None:
        probe = self._pending[token]
        left = probe.deadline - self._clock.seconds()
        if left <= 0:
            self._forget(token)
            probe.deferred.errback(NoAnswer(f"{self.silence} at {probe.address}"))
            return
        self._send(probe.datagrams[probe.tries % len(probe.datagrams)], probe.address)
        probe.tries += 1
        wait = min(wait, LONGEST)
        probe.timer = self._clock.callLater(min(wait, left), self._try, token, wait * BACK_OFF)

    def _drop(self, token: bytes) -> None:
        self._forget(token)

    def _forget(self, token: bytes) -> Probe[T] | None:
        probe = self._pending.pop(token, None)
        if probe is not None:
            cancel(probe.timer)
        return probe


class Hailer(Probes[Echo]):
    """Sends HAILs to addresses; ``send`` sends a datagram."""

    def __init__(self, send: Callable[[bytes, Address], None], clock: IReactorTime, rng: random.Random) -> None:
        super().__init__(send, clock)
        self._rng = rng

    def hail(self, address: Address, timeout: float = 1.5) -> Deferred[Echo]:
        """Probe ``address``; fails with ``NoAnswer`` after ``timeout`` seconds."""
        token = self._rng.randbytes(TOKEN)
        return self._begin(token, address, [hail(token)], timeout)

    def on_echo(self, datagram: bytes, source: Address) -> str:
        """Process an ECHO; return the reason in one word if it was dropped."""
        try:
            answer = echo_of(datagram)
        except Malformed:
            return "malformed"
        probe = self._pending.get(answer.token)
        if probe is None:
            return "unasked"
        if probe.address == source:
            self._forget(answer.token)
            probe.deferred.callback(answer)
        return ""
