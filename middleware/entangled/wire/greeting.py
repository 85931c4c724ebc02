"""Exchange datagrams without a session: discovery (WHO, HERE) and proof of address (COOKIE).

With WHO and HERE a node learns the public key of the node at an address.  Both are sealed under the team's key alone,
so they prove membership and nothing else; the session that follows proves the key.  HERE and WHO have the same length.

A node under load answers INIT with COOKIE: the initiator must prove that it receives at its source address before the
responder exchanges keys or keeps state (after WireGuard, Donenfeld 2017, section 5.4.7).
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
# A handshake costs the responder about 0.2 ms: 100 per second take 2 % of a core, and a team of 100 that starts at the
# same time still needs no second round trip.
QUIET_RATE = 100.0
# Handshakes with a valid cookie together take at most a fifth of a core.
MOST_RATE = 1000.0
COOKIE_S = 120.0


def who(key: bytes, token: bytes, rng: random.Random) -> bytes:
    """Return a WHO datagram; ``token`` identifies the request and must not be guessable."""
    return _seal_greeting(WHO, key, token + bytes(32), rng)


def here(key: bytes, token: bytes, public: bytes, rng: random.Random) -> bytes:
    """Return the HERE that answers the WHO with ``token``: this node's public key."""
    return _seal_greeting(HERE, key, token + public, rng)


def opened_greeting(key: bytes, datagram: bytes) -> tuple[bytes, bytes]:
    """Decrypt a WHO or HERE; return its token and its public key (32 zero bytes in WHO).  Raises ``Forged``."""
    if len(datagram) != GREETING_BYTES:
        raise Forged("the WHO or HERE has the wrong length")
    nonce, ciphertext = datagram[1 : 1 + _NONCE], datagram[1 + _NONCE :]
    try:
        body = bindings.crypto_aead_xchacha20poly1305_ietf_decrypt(ciphertext, datagram[:1], nonce, key)
    except (CryptoError, ValueError) as error:
        raise Forged("the WHO or HERE is not sealed under this key") from error
    return body[:TOKEN_BYTES], body[TOKEN_BYTES:]


def _seal_greeting(kind: int, key: bytes, body: bytes, rng: random.Random) -> bytes:
    head, nonce = bytes([kind]), rng.randbytes(_NONCE)
    return head + nonce + bindings.crypto_aead_xchacha20poly1305_ietf_encrypt(body, head, nonce, key)


def opened_cookie(key: bytes, datagram: bytes) -> bytes:
    """Decrypt a COOKIE datagram; return its cookie.  Raises ``Forged``."""
    if len(datagram) != COOKIE_BYTES:
        raise Forged("the COOKIE has the wrong length")
    head, nonce, ciphertext = datagram[: 1 + MAC], datagram[1 + MAC :][:_NONCE], datagram[1 + MAC + _NONCE :]
    try:
        return bindings.crypto_aead_xchacha20poly1305_ietf_decrypt(ciphertext, head, nonce, key)
    except (CryptoError, ValueError) as error:
        raise Forged("the COOKIE is not sealed under this key") from error


class Cookies:
    """Limits the rate of key exchanges and generates cookies, without state per initiator.  ``key`` seals the cookies.

    A cookie is a keyed hash of the initiator's address and of the time in steps of ``COOKIE_S``; the cookies of the
    current and the previous step are valid.
    """

    def __init__(self, key: bytes, rng: random.Random) -> None:
        self._key = key
        self._rng = rng
        self._secret = rng.randbytes(32)
        self._limit = TokenBucket(QUIET_RATE)
        self._cookie_limit = TokenBucket(MOST_RATE)

    def is_lawful(self, init: bytes, source: Address, now: float) -> bool:
        """Return whether the last field of an INIT is valid: zero, or made with a cookie of this node."""
        return init[-MAC:] == bytes(MAC) or self._has_valid_cookie(init, source, now)

    def admits(self, init: bytes, source: Address, now: float) -> bool:
        """Return whether the rate limit allows a key exchange for this INIT; call it once per INIT."""
        if self._has_valid_cookie(init, source, now):
            return self._cookie_limit.take(now)
        return self._limit.take(now)

    def reply(self, init: bytes, source: Address, now: float, key: bytes = b"") -> bytes:
        """Return the COOKIE datagram for the sender of this INIT, sealed under ``key`` if given.

        It is shorter than any INIT.
        """
        head, nonce = bytes([COOKIE]) + mac_of(init), self._rng.randbytes(_NONCE)
        cookie = self._cookie(source, int(now / COOKIE_S))
        return head + nonce + bindings.crypto_aead_xchacha20poly1305_ietf_encrypt(cookie, head, nonce, key or self._key)

    def _has_valid_cookie(self, init: bytes, source: Address, now: float) -> bool:
        step = int(now / COOKIE_S)
        return any(has_cookie(init, self._cookie(source, when)) for when in (step, step - 1))

    def _cookie(self, source: Address, step: int) -> bytes:
        return hashlib.blake2s(
            f"{step} {source.port} {source.host}".encode(), key=self._secret, digest_size=16
        ).digest()


class Greeter(Probes[Contact]):
    """Discovers the node at an address, answers discovery requests, and resends INITs with requested cookies.

    It tries each secret in the ring of ``peers`` in turn, the newest first.
    """

    silence = "no node of this team answers"

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
        """Discover the contact at ``address`` within ``timeout`` seconds; fails with ``NoAnswer``."""
        token = self._rng.randbytes(TOKEN_BYTES)
        datagrams = [who(own.greet_key, token, self._rng) for own in self._peers.ring]
        return self._begin(token, address, datagrams, timeout)

    def call(self) -> bytes:
        """Return a WHO for many receivers, such as all nodes of a LAN; probe each sender of a HERE directly then."""
        return who(self._peers.ring[0].greet_key, self._rng.randbytes(TOKEN_BYTES), self._rng)

    def opens(self, datagram: bytes) -> bool:
        """Return whether ``datagram`` is a WHO or HERE of this team."""
        return self._open_greeting(datagram) is not None

    def on_who(self, datagram: bytes, source: Address) -> None:
        """Answer a WHO of this team."""
        found = self._open_greeting(datagram)
        if found is not None:
            own, token, _ = found
            self._send(here(own.greet_key, token, self._public, self._rng), source)

    def on_here(self, datagram: bytes, source: Address) -> None:
        """Process the answer to a WHO of this node."""
        found = self._open_greeting(datagram)
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
            if not self._peers.usual.is_measured:  # an estimate: the HERE may answer a later try
                self._peers.usual.measured(self._clock.seconds() - greeting.begun_at)
            greeting.deferred.callback(contact)

    def on_cookie(self, datagram: bytes, source: Address) -> None:
        """Resend an INIT with the cookie that the responder requested."""
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

    def _open_greeting(self, datagram: bytes) -> tuple[Credentials, bytes, bytes] | None:
        """Decrypt a WHO or HERE; return its credentials, token and key, or count it as forged and return None."""
        for own in self._peers.ring:
            try:
                return own, *opened_greeting(own.greet_key, datagram)
            except Forged:
                continue
        self._counters["forged"] += 1
        return None
