"""Fuzz INIT, RESP and COOKIE datagrams that a member encrypts with the team's key, with arbitrary contents.

The content of an INIT or RESP should be an incarnation number, a certificate, a message and padding; here it is
arbitrary, and a RESP may also contain a rejection. A rejected handshake must change nothing, and no reply may be longer
than its request.

The first byte of an input selects the kind: INIT, RESP and COOKIE are 0 to 2 for an open team and 3 to 5 for a closed
team. For an INIT, the next byte is the seed of its ephemeral key.
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
    """An admission check that permits certificates of at most 64 bytes."""

    def __init__(self) -> None:
        super().__init__(shown=b"pass")
        self.max_pass_bytes = 64


def init(ground: Ground, data: bytes) -> bytes:
    """Return an INIT with ``data`` as its content.

    If the length of ``data`` is even, its last bytes replace the second MAC.
    """
    remote = derive_exchange_key(ground.contact.public)
    noise = Initiator(OWN.static, remote, random.Random(data[:1]).randbytes(32), PROLOGUE, OWN.psk)
    payload = data[1:] if data[:1] < b"\x80" else data[1:5] + OWN.public + data[5:]
    bare = bytes([INIT]) + noise.write(payload[: MAX_DATAGRAM_BYTES - 200].ljust(520 + ground.room, b"\0"))
    bare += _keyed_hash(OWN.mac_key, bare)
    return bare + (bytes(MAC_BYTES) if len(data) % 2 else data[-MAC_BYTES:].ljust(MAC_BYTES, b"\0"))


def resp(ground: Ground, asked: bytes, data: bytes) -> bytes:
    """Return a RESP that contains ``data``, in reply to the target's INIT ``asked``."""
    noise = Responder(OWN.static, bytes(range(32)), PROLOGUE, OWN.psk)
    payload, _ = noise.read(asked[1 : -2 * MAC_BYTES])
    message, _ = noise.write(data[:1300])
    return bytes([RESP]) + payload[:4] + message


def cookie(asked: bytes, data: bytes) -> bytes:
    """Return a COOKIE in reply to the target's INIT ``asked``, with content of any length."""
    head, nonce = bytes([COOKIE]) + read_mac(asked), bytes(24)
    key = derive_key(TEAM, b"cookie")
    return head + nonce + bindings.crypto_aead_xchacha20poly1305_ietf_encrypt(data[:1300], head, nonce, key)


def shot(ground: Ground, data: bytes) -> None:
    """Send one input to the target; raises ``Violation``."""
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
    # A valid RESP opens its session even if the message in it is invalid; only the message is dropped.
    if kind != 1 and counters["forged"] + counters["malformed"] > refused and ground.state() != before:
        raise Violation("a refused handshake changed the node")
    ground.clock.advance(2.0 if kind else 0.02)


_open, _closed = Again(shot), Again(shot, made=lambda: Ground(ShortPass()))


def check(data: bytes) -> None:
    """Send one input to a node of an open or of a closed team; raises ``Violation``."""
    (_closed if data and data[0] // 3 % 2 else _open)(data)


if __name__ == "__main__":
    main("handshake", check)
