"""Exchange datagrams without a session: discovery (DISCOVERY, DISCOVERY_REPLY) and proof of address (COOKIE).

With DISCOVERY and DISCOVERY_REPLY a node learns the public key of the node at an address.  Both datagrams are encrypted
only under the team's key, so they prove only that the sender has this key; the session that follows proves the node's
own key.  DISCOVERY_REPLY and DISCOVERY have the same length.

A node under load answers INIT with COOKIE: the initiator must prove that it receives datagrams at its source address
before the responder exchanges keys or stores state (after WireGuard, Donenfeld 2017, section 5.4.7).
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
from middleware.entangled.wire.peer import Peers
from middleware.entangled.wire.probe import ProbeSender
from middleware.entangled.wire.session import MAC_BYTES, Credentials, has_cookie, read_mac

DISCOVERY = 0x14
DISCOVERY_REPLY = 0x15
COOKIE = 0x16
TOKEN_BYTES = 16
_NONCE_BYTES = 24
_BODY_BYTES = TOKEN_BYTES + 32
DISCOVERY_BYTES = 1 + _NONCE_BYTES + _BODY_BYTES + 16
COOKIE_BYTES = 1 + MAC_BYTES + _NONCE_BYTES + 16 + 16
# A handshake costs the responder about 0.2 ms, so 100 handshakes per second take 2 % of a core.  When a team of 100
# nodes starts at the same time, no handshake needs a second round trip.
MAX_HANDSHAKES_PER_S = 100.0
# All handshakes with a valid cookie together take at most a fifth of a core.
MAX_COOKIE_HANDSHAKES_PER_S = 1000.0
COOKIE_S = 120.0


def pack_discovery(key: bytes, token: bytes, rng: random.Random) -> bytes:
    """Return a DISCOVERY datagram; ``token`` identifies the request and must not be guessable."""
    return _seal_discovery(DISCOVERY, key, token + bytes(32), rng)


def pack_discovery_reply(key: bytes, token: bytes, public: bytes, rng: random.Random) -> bytes:
    """Return a DISCOVERY_REPLY with the public key ``public``, in reply to the DISCOVERY with ``token``."""
    return _seal_discovery(DISCOVERY_REPLY, key, token + public, rng)


def open_discovery(key: bytes, datagram: bytes) -> tuple[bytes, bytes]:
    """Decrypt a DISCOVERY or DISCOVERY_REPLY; return its token and public key (zero in DISCOVERY); raise ``Forged``."""
    if len(datagram) != DISCOVERY_BYTES:
        raise Forged("the DISCOVERY or DISCOVERY_REPLY has the wrong length")
    nonce, ciphertext = datagram[1 : 1 + _NONCE_BYTES], datagram[1 + _NONCE_BYTES :]
    try:
        body = bindings.crypto_aead_xchacha20poly1305_ietf_decrypt(ciphertext, datagram[:1], nonce, key)
    except (CryptoError, ValueError) as error:
        raise Forged("the DISCOVERY or DISCOVERY_REPLY is not encrypted under this key") from error
    return body[:TOKEN_BYTES], body[TOKEN_BYTES:]


def _seal_discovery(kind: int, key: bytes, body: bytes, rng: random.Random) -> bytes:
    head, nonce = bytes([kind]), rng.randbytes(_NONCE_BYTES)
    return head + nonce + bindings.crypto_aead_xchacha20poly1305_ietf_encrypt(body, head, nonce, key)


def open_cookie(key: bytes, datagram: bytes) -> bytes:
    """Decrypt a COOKIE datagram; return its cookie.  Raises ``Forged``."""
    if len(datagram) != COOKIE_BYTES:
        raise Forged("the COOKIE has the wrong length")
    head, nonce, ciphertext = (
        datagram[: 1 + MAC_BYTES],
        datagram[1 + MAC_BYTES :][:_NONCE_BYTES],
        datagram[1 + MAC_BYTES + _NONCE_BYTES :],
    )
    try:
        return bindings.crypto_aead_xchacha20poly1305_ietf_decrypt(ciphertext, head, nonce, key)
    except (CryptoError, ValueError) as error:
        raise Forged("the COOKIE is not encrypted under this key") from error


class CookieCheck:
    """Limits the rate of key exchanges, and generates cookies without state per initiator.

    ``key`` encrypts the COOKIE datagrams.  A cookie is a keyed hash of the initiator's address and of the time in steps
    of ``COOKIE_S`` seconds.  The cookies of the current step and of the previous step are valid.
    """

    def __init__(self, key: bytes, rng: random.Random) -> None:
        self._key = key
        self._rng = rng
        self._secret = rng.randbytes(32)
        self._limit = TokenBucket(MAX_HANDSHAKES_PER_S)
        self._cookie_limit = TokenBucket(MAX_COOKIE_HANDSHAKES_PER_S)

    def is_valid(self, init: bytes, source: Address, now: float) -> bool:
        """Return whether the last field of an INIT is valid: zero, or a hash with a cookie of this node."""
        return init[-MAC_BYTES:] == bytes(MAC_BYTES) or self._has_valid_cookie(init, source, now)

    def admits(self, init: bytes, source: Address, now: float) -> bool:
        """Return whether the rate limit allows a key exchange for this INIT; call it once per INIT."""
        if self._has_valid_cookie(init, source, now):
            return self._cookie_limit.take(now)
        return self._limit.take(now)

    def pack_cookie(self, init: bytes, source: Address, now: float, key: bytes = b"") -> bytes:
        """Return the COOKIE datagram for the sender of this INIT, encrypted under ``key`` if given.

        A COOKIE is shorter than any INIT.
        """
        head, nonce = bytes([COOKIE]) + read_mac(init), self._rng.randbytes(_NONCE_BYTES)
        cookie = self._make_cookie(source, int(now / COOKIE_S))
        return head + nonce + bindings.crypto_aead_xchacha20poly1305_ietf_encrypt(cookie, head, nonce, key or self._key)

    def _has_valid_cookie(self, init: bytes, source: Address, now: float) -> bool:
        step = int(now / COOKIE_S)
        return any(has_cookie(init, self._make_cookie(source, when)) for when in (step, step - 1))

    def _make_cookie(self, source: Address, step: int) -> bytes:
        return hashlib.blake2s(
            f"{step} {source.port} {source.host}".encode(), key=self._secret, digest_size=16
        ).digest()


class Discoverer(ProbeSender[Contact]):
    """Discovers the node at an address, answers discovery requests, and resends INITs with the requested cookies.

    Discovery tries each secret in the ring of ``peers`` in turn, the newest first.
    """

    failure_text = "no node of this team answers"

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

    def discover(self, address: Address, timeout: float) -> Deferred[Contact]:
        """Discover the contact at ``address`` within ``timeout`` seconds; fails with ``NoAnswer``."""
        token = self._rng.randbytes(TOKEN_BYTES)
        datagrams = [pack_discovery(own.discovery_key, token, self._rng) for own in self._peers.ring]
        return self._start(token, address, datagrams, timeout)

    def make_multicast(self) -> bytes:
        """Return a DISCOVERY for many receivers, for example on a LAN.

        After a reply, discover the address of its sender directly.
        """
        return pack_discovery(self._peers.ring[0].discovery_key, self._rng.randbytes(TOKEN_BYTES), self._rng)

    def is_of_team(self, datagram: bytes) -> bool:
        """Return whether ``datagram`` is a DISCOVERY or DISCOVERY_REPLY of this team."""
        return self._open_discovery(datagram) is not None

    def on_discovery(self, datagram: bytes, source: Address) -> None:
        """Answer a DISCOVERY of this team."""
        found = self._open_discovery(datagram)
        if found is not None:
            own, token, _ = found
            self._send(pack_discovery_reply(own.discovery_key, token, self._public, self._rng), source)

    def on_discovery_reply(self, datagram: bytes, source: Address) -> None:
        """Process the reply to a DISCOVERY of this node."""
        found = self._open_discovery(datagram)
        if found is None:
            return
        own, token, public = found
        pending = self._pending.get(token)
        if pending is None:
            self._counters["unasked"] += 1
        elif pending.address != source:
            self._counters["misdirected"] += 1
        else:
            self._forget(token)
            contact = Contact(public, source)
            self._peers.record_credentials(contact, own)
            if not self._peers.overall_round_trip.is_measured:  # the reply may belong to a later try
                self._peers.overall_round_trip.add_sample(self._clock.seconds() - pending.started_at)
            pending.deferred.callback(contact)

    def on_cookie(self, datagram: bytes, source: Address) -> None:
        """Resend an INIT with the cookie that the responder requested."""
        opening = self._peers.find_handshake_by_mac(datagram[1 : 1 + MAC_BYTES])
        if opening is None:
            self._counters["stale"] += 1
        elif source not in opening.cookies:
            self._counters["misdirected"] += 1
        else:
            try:
                cookie = open_cookie(opening.initiator.credentials.cookie_key, datagram)
            except Forged:
                self._counters["forged"] += 1
                return
            self._peers.resend_with_cookie(opening, cookie, source)

    def _open_discovery(self, datagram: bytes) -> tuple[Credentials, bytes, bytes] | None:
        """Return the credentials, token and key of a DISCOVERY or DISCOVERY_REPLY, or None; count a forged datagram."""
        for own in self._peers.ring:
            try:
                return own, *open_discovery(own.discovery_key, datagram)
            except Forged:
                continue
        self._counters["forged"] += 1
        return None
