"""Greeting: the WHO and HERE datagrams, by which a node learns the public key of whoever listens at an address.

Both are sealed under the team's key alone, so they prove membership and nothing else; the session that follows proves
the key.  HERE is exactly as long as WHO.
"""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import dataclass

from nacl import bindings
from nacl.exceptions import CryptoError
from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IDelayedCall, IReactorTime

from middleware.entangled.errors import Forged, NoAnswer
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.network.network import Address, Network
from middleware.entangled.wire.roundtrip import BACK_OFF, FIRST_GUESS, LONGEST

WHO = 0x14
HERE = 0x15
TOKEN_BYTES = 16
_NONCE = 24
_BODY = TOKEN_BYTES + 32
GREETING_BYTES = 1 + _NONCE + _BODY + 16


def who(key: bytes, token: bytes, rng: random.Random) -> bytes:
    """The question; ``token`` is the asker's and must not be guessable."""
    return _sealed(WHO, key, token + bytes(32), rng)


def here(key: bytes, token: bytes, public: bytes, rng: random.Random) -> bytes:
    """The answer to the WHO that carried ``token``: this node's public key."""
    return _sealed(HERE, key, token + public, rng)


def opened_greeting(key: bytes, datagram: bytes) -> tuple[bytes, bytes]:
    """The token and the public key (32 zero bytes in WHO) of either datagram; raises ``Forged``."""
    if len(datagram) != GREETING_BYTES:
        raise Forged("a greeting of a wrong length")
    nonce, ciphertext = datagram[1 : 1 + _NONCE], datagram[1 + _NONCE :]
    try:
        body = bindings.crypto_aead_xchacha20poly1305_ietf_decrypt(ciphertext, datagram[:1], nonce, key)
    except (CryptoError, ValueError) as error:
        raise Forged("a greeting that does not open") from error
    return body[:TOKEN_BYTES], body[TOKEN_BYTES:]


def _sealed(kind: int, key: bytes, body: bytes, rng: random.Random) -> bytes:
    head, nonce = bytes([kind]), rng.randbytes(_NONCE)
    return head + nonce + bindings.crypto_aead_xchacha20poly1305_ietf_encrypt(body, head, nonce, key)


class Greeter:
    """Greets addresses for an endpoint, again and again until one answers or the time is up, and greets back."""

    def __init__(
        self,
        public: bytes,
        key: bytes,
        network: Network,
        clock: IReactorTime,
        rng: random.Random,
        counters: Counter[str],
    ) -> None:
        self._public = public
        self._key = key
        self._network = network
        self._clock = clock
        self._rng = rng
        self._counters = counters
        self._pending: dict[bytes, _Greeting] = {}

    def greet(self, address: Address, timeout: float) -> Deferred[Contact]:
        """Learn who listens at ``address`` within ``timeout`` seconds; fails with ``NoAnswer``."""
        token = self._rng.randbytes(TOKEN_BYTES)
        deferred: Deferred[Contact] = Deferred(lambda _: self._cancelled(token))
        datagram = who(self._key, token, self._rng)
        self._pending[token] = _Greeting(address, datagram, self._clock.seconds() + timeout, deferred)
        self._send(token, FIRST_GUESS)
        return deferred

    def stop(self, error: Exception) -> None:
        """Fail what is pending with ``error``."""
        for token in list(self._pending):
            greeting = self._forget(token)
            if greeting is not None:
                greeting.deferred.errback(error)

    def on_who(self, datagram: bytes, source: Address) -> None:
        """Answer a greeting, if it is one of our team."""
        try:
            token, _ = opened_greeting(self._key, datagram)
        except Forged:
            self._counters["forged"] += 1
            return
        self._network.send(here(self._key, token, self._public, self._rng), source)

    def on_here(self, datagram: bytes, source: Address) -> None:
        """Take the answer to a greeting of ours."""
        try:
            token, public = opened_greeting(self._key, datagram)
        except Forged:
            self._counters["forged"] += 1
            return
        greeting = self._pending.get(token)
        if greeting is None:
            self._counters["unasked"] += 1
        elif greeting.address != source:
            self._counters["misdirected"] += 1
        else:
            self._forget(token)
            greeting.deferred.callback(Contact(public, source))

    def _send(self, token: bytes, wait: float) -> None:
        greeting = self._pending[token]
        left = greeting.deadline - self._clock.seconds()
        if left <= 0:
            self._forget(token)
            greeting.deferred.errback(NoAnswer(f"nobody of this team answers at {greeting.address}"))
            return
        self._network.send(greeting.datagram, greeting.address)
        wait = min(wait, LONGEST)
        greeting.timer = self._clock.callLater(min(wait, left), self._send, token, wait * BACK_OFF)

    def _cancelled(self, token: bytes) -> None:
        self._forget(token)

    def _forget(self, token: bytes) -> _Greeting | None:
        greeting = self._pending.pop(token, None)
        if greeting is not None and greeting.timer is not None and greeting.timer.active():
            greeting.timer.cancel()
        return greeting


@dataclass(slots=True, eq=False)
class _Greeting:
    address: Address
    datagram: bytes
    deadline: float
    deferred: Deferred[Contact]
    timer: IDelayedCall | None = None
