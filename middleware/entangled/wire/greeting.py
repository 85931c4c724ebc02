"""Greeting: what is said on the doorstep, before any key is exchanged: WHO and HERE, and COOKIE.

By WHO and HERE a node learns the public key of whoever listens at an address.  Both are sealed under the team's key
alone, so they prove membership and nothing else; the session that follows proves the key.  HERE is as long as WHO.

COOKIE is what a node answers to INIT when too many of them come: the initiator must show that it hears at the address
that it writes from, before any key is exchanged or anything is remembered (after WireGuard, Donenfeld 2017, section
5.4.7).
"""

from __future__ import annotations

import hashlib
import random
from collections import Counter

from nacl import bindings
from nacl.exceptions import CryptoError
from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.contact import Contact
from middleware.entangled.errors import Forged
from middleware.entangled.network.network import Address, Network
from middleware.entangled.token_bucket import TokenBucket
from middleware.entangled.wire.hail import Probes
from middleware.entangled.wire.peer import Peers
from middleware.entangled.wire.session import MAC, Credentials, has_cookie, mac_of

WHO = 0x14
HERE = 0x15
COOKIE = 0x16
TOKEN_BYTES = 16
_NONCE = 24
_BODY = TOKEN_BYTES + 32
GREETING_BYTES = 1 + _NONCE + _BODY + 16
COOKIE_BYTES = 1 + MAC + _NONCE + 16 + 16
# A handshake costs the responder about 0.2 ms: 100 a second are 2 % of a core, and a team of 100 that starts at once
# still needs no second round trip.
QUIET_RATE = 100.0
# Even those who show a cookie shall not get more than a fifth of a core together.
MOST_RATE = 1000.0
COOKIE_S = 120.0


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


def opened_cookie(key: bytes, datagram: bytes) -> bytes:
    """The cookie in a COOKIE datagram; raises ``Forged``."""
    if len(datagram) != COOKIE_BYTES:
        raise Forged("a cookie of a wrong length")
    head, nonce, ciphertext = datagram[: 1 + MAC], datagram[1 + MAC :][:_NONCE], datagram[1 + MAC + _NONCE :]
    try:
        return bindings.crypto_aead_xchacha20poly1305_ietf_decrypt(ciphertext, head, nonce, key)
    except (CryptoError, ValueError) as error:
        raise Forged("a cookie that does not open") from error


class Cookies:
    """Decides which INIT is worth a key exchange, and makes cookies; it remembers no initiator.  ``key`` seals them.

    A cookie is a keyed hash of the initiator's address and of the time in steps of ``COOKIE_S``; those of this step and
    of the last one hold.
    """

    def __init__(self, key: bytes, rng: random.Random) -> None:
        self._key = key
        self._rng = rng
        self._secret = rng.randbytes(32)
        self._quiet = TokenBucket(QUIET_RATE)
        self._most = TokenBucket(MOST_RATE)

    def is_lawful(self, init: bytes, source: Address, now: float) -> bool:
        """Whether the last field of an INIT is what it must be: zero, or made with a cookie of ours."""
        return init[-MAC:] == bytes(MAC) or self._is_paid(init, source, now)

    def admits(self, init: bytes, source: Address, now: float) -> bool:
        """Whether to exchange keys with who sent this INIT; call it once for each."""
        if self._is_paid(init, source, now):
            return self._most.take(now)
        return self._quiet.take(now)

    def reply(self, init: bytes, source: Address, now: float, key: bytes = b"") -> bytes:
        """The COOKIE datagram for who sent this INIT, sealed under ``key`` where that is another one.

        It is shorter than any INIT.
        """
        head, nonce = bytes([COOKIE]) + mac_of(init), self._rng.randbytes(_NONCE)
        cookie = self._cookie(source, int(now / COOKIE_S))
        return head + nonce + bindings.crypto_aead_xchacha20poly1305_ietf_encrypt(cookie, head, nonce, key or self._key)

    def _is_paid(self, init: bytes, source: Address, now: float) -> bool:
        step = int(now / COOKIE_S)
        return any(has_cookie(init, self._cookie(source, when)) for when in (step, step - 1))

    def _cookie(self, source: Address, step: int) -> bytes:
        return hashlib.blake2s(
            f"{step} {source.port} {source.host}".encode(), key=self._secret, digest_size=16
        ).digest()


class Greeter(Probes[Contact]):
    """Greets addresses for an endpoint until one answers or the time is up, greets back, and pays with cookies.

    It does so under each secret of the team that ``peers`` goes by, in turn, the newest first.
    """

    silence = "nobody of this team answers"

    def __init__(
        self,
        public: bytes,
        peers: Peers,
        network: Network,
        clock: IReactorTime,
        rng: random.Random,
        counters: Counter[str],
    ) -> None:
        super().__init__(network.send, clock)
        self._public = public
        self._peers = peers
        self._rng = rng
        self._counters = counters

    def greet(self, address: Address, timeout: float) -> Deferred[Contact]:
        """Learn who listens at ``address`` within ``timeout`` seconds; fails with ``NoAnswer``."""
        token = self._rng.randbytes(TOKEN_BYTES)
        datagrams = [who(own.greet_key, token, self._rng) for own in self._peers.ring]
        return self._begin(token, address, datagrams, timeout)

    def call(self) -> bytes:
        """A WHO for many, such as all on a LAN; whose HERE comes is then greeted at its address."""
        return who(self._peers.ring[0].greet_key, self._rng.randbytes(TOKEN_BYTES), self._rng)

    def opens(self, datagram: bytes) -> bool:
        """Whether ``datagram`` is a WHO or HERE of this team."""
        return self._opened(datagram) is not None

    def on_who(self, datagram: bytes, source: Address) -> None:
        """Answer a greeting, if it is one of our team."""
        found = self._opened(datagram)
        if found is not None:
            own, token, _ = found
            self._send(here(own.greet_key, token, self._public, self._rng), source)

    def on_here(self, datagram: bytes, source: Address) -> None:
        """Take the answer to a greeting of ours."""
        found = self._opened(datagram)
        if found is None:
            return
        own, token, public = found
        greeting = self._pending.get(token)
        if greeting is None:
            self._counters["unasked"] += 1
        elif greeting.address != source:
            self._counters["misdirected"] += 1
        else:
            self._forget(token)
            contact = Contact(public, source)
            self._peers.met_under(contact, own)
            if not self._peers.usual.is_measured:  # a guess: it may have been a later try that was answered
                self._peers.usual.measured(self._clock.seconds() - greeting.begun_at)
            greeting.deferred.callback(contact)

    def on_cookie(self, datagram: bytes, source: Address) -> None:
        """Pay with the cookie that the answer to an INIT of ours brings."""
        opening = self._peers.opening_of(datagram[1 : 1 + MAC])
        if opening is None:
            self._counters["stale"] += 1
        elif source not in opening.doors:
            self._counters["misdirected"] += 1
        else:
            try:
                cookie = opened_cookie(opening.invitation.own.cookie_key, datagram)
            except Forged:
                self._counters["forged"] += 1
                return
            self._peers.paid(opening, cookie, source)

    def _opened(self, datagram: bytes) -> tuple[Credentials, bytes, bytes] | None:
        """The token and the key in a greeting, and what it was sealed under; None, and counted, where it opens not."""
        for own in self._peers.ring:
            try:
                return own, *opened_greeting(own.greet_key, datagram)
            except Forged:
                continue
        self._counters["forged"] += 1
        return None
