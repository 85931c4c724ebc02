"""Fuzz INIT, RESP and COOKIE of a member with the team's key and arbitrary contents.

The content is a life, a certificate, a message and padding, or random bytes; a RESP may also be a refusal. A refused
handshake changes nothing (R1), and no reply is longer than its request (R3). The first byte of an input selects one of
the three, and a closed team (from 3 on); in an INIT the seed of its ephemeral key follows.
"""

from __future__ import annotations

import random

from nacl import bindings

from middleware.entangled.contact import Contact
from middleware.entangled.identity import Identity, derive_exchange_key
from middleware.entangled.network.network import MAX_DATAGRAM_BYTES, Address
from middleware.entangled.wire.discovery import COOKIE
from middleware.entangled.wire.noise import Initiator, Responder
from middleware.entangled.wire.session import (
    INIT,
    MAC_BYTES,
    PROLOGUE,
    RESP,
    Credentials,
    _keyed_hash,
    derive_key,
    read_mac,
)
from tests.fuzz.ground import STRANGER, TEAM, Ground, Violation
from tests.fuzz.runner import Again, main
from tests.middleware.gate import Gate

OWN = Credentials.derive(Identity(b"m" * 32), TEAM)
AT = Address("10.0.0.3", 3)


class ShortPass(Gate):
    """An admission check with short certificates."""

    def __init__(self) -> None:
        super().__init__(shown=b"pass")
        self.max_pass_bytes = 64


def init(ground: Ground, data: bytes) -> bytes:
    """Return an INIT with a payload; the bytes after the first 600 change the finished datagram."""
    remote = derive_exchange_key(ground.contact.public)
    noise = Initiator(OWN.static, remote, random.Random(data[:1]).randbytes(32), PROLOGUE, OWN.psk)
    payload = data[1:] if data[:1] < b"\x80" else data[1:5] + OWN.public + data[5:]
    bare = bytes([INIT]) + noise.write(payload[: MAX_DATAGRAM_BYTES - 200].ljust(520 + ground.room, b"\0"))
    bare += _keyed_hash(OWN.mac_key, bare)
    return bare + (bytes(MAC_BYTES) if len(data) % 2 else data[-MAC_BYTES:].ljust(MAC_BYTES, b"\0"))


def resp(ground: Ground, asked: bytes, data: bytes) -> bytes:
    """Return a RESP to the target's INIT, with a payload."""
    noise = Responder(OWN.static, bytes(range(32)), PROLOGUE, OWN.psk)
    payload, _ = noise.read(asked[1 : -2 * MAC_BYTES])
    message, _ = noise.write(data[:1300])
    return bytes([RESP]) + payload[:4] + message


def cookie(asked: bytes, data: bytes) -> bytes:
    """Return a COOKIE for the target's INIT, with content of any length."""
    head, nonce = bytes([COOKIE]) + read_mac(asked), bytes(24)
    key = derive_key(TEAM, b"cookie")
    return head + nonce + bindings.crypto_aead_xchacha20poly1305_ietf_encrypt(data[:1300], head, nonce, key)


def shot(ground: Ground, data: bytes) -> None:
    """Send one input; raises ``Violation``."""
    kind, data = data[0] % 3 if data else 0, data[1:]
    source = STRANGER
    if kind:
        asked = ground.target.ask(Contact(OWN.public, AT), "echo", 1)
        asked.addErrback(lambda failure: None)
        sent = [datagram for datagram, to in ground.sent if to == AT and datagram[0] == INIT]
        if not sent:
            return
        source = AT
        datagram = resp(ground, sent[-1], data) if kind == 1 else cookie(sent[-1], data)
    else:
        datagram = init(ground, data)
    counters = ground.target.counters
    refused = counters["forged"] + counters["malformed"]
    before = ground.state()
    sent_bytes = ground.shoot(datagram, source)
    if not kind and sent_bytes > len(datagram):
        raise Violation(f"{sent_bytes} bytes sent for {len(datagram)} received")
    # A RESP opens its session even if its message is invalid; only the message is dropped.
    if kind != 1 and counters["forged"] + counters["malformed"] > refused and ground.state() != before:
        raise Violation("a refused handshake changed the node")
    ground.clock.advance(2.0 if kind else 0.02)


_open, _closed = Again(shot), Again(shot, made=lambda: Ground(ShortPass()))


def check(data: bytes) -> None:
    """Send one input to a node of an open or of a closed team."""
    (_closed if data and data[0] // 3 % 2 else _open)(data)


if __name__ == "__main__":
    main("handshake", check)
