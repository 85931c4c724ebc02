"""Handshake: the INIT and RESP datagrams that open a session in one round trip.

INIT carries a message of the initiator, RESP the responder's; INIT is padded so that RESP need never be larger.  A
keyed hash at the end of INIT lets a node drop what outsiders make up for a microsecond instead of three key
exchanges.
"""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import dataclass

from middleware.entangled.errors import Forged
from middleware.entangled.identity import Identity, exchange_key
from middleware.entangled.network.network import MAX_DATAGRAM
from middleware.entangled.wire.noise import (
    FIRST_OVERHEAD,
    KEY,
    SECOND_OVERHEAD,
    Initiator,
    KeyPair,
    Responder,
    TransportKeys,
    key_pair,
)
from middleware.entangled.wire.session import INDEX_BYTES

INIT = 0x11
RESP = 0x12
PROLOGUE = b"swarm-wire-1"
ANSWER_ROOM = 512
_MAC = 16
_PAYLOAD = INDEX_BYTES + KEY + 2
_INIT_BARE = 1 + FIRST_OVERHEAD + _PAYLOAD + _MAC
_RESP_BARE = 1 + INDEX_BYTES + SECOND_OVERHEAD + INDEX_BYTES
INIT_LEAST = _RESP_BARE + ANSWER_ROOM
MAX_RIDER = MAX_DATAGRAM - _INIT_BARE


def derived_key(team_key: bytes, purpose: bytes) -> bytes:
    """The team's key for one purpose (32 bytes)."""
    return hashlib.blake2s(PROLOGUE + b" " + purpose, key=team_key).digest()


@dataclass(frozen=True)
class Credentials:
    """What a node needs to open and to accept sessions."""

    public: bytes
    static: KeyPair
    psk: bytes
    mac_key: bytes

    @classmethod
    def of(cls, identity: Identity, team_key: bytes) -> Credentials:
        """The credentials of ``identity`` in the team that holds ``team_key`` (32 bytes)."""
        return cls(
            identity.public,
            key_pair(identity.exchange_secret),
            derived_key(team_key, b"psk"),
            derived_key(team_key, b"mac"),
        )


class Invitation:
    """The initiator's half of a handshake; ``datagram`` is the INIT, which may be sent again unchanged."""

    def __init__(
        self, own: Credentials, remote_static: bytes, ephemeral_secret: bytes, local_index: int, rider: bytes
    ) -> None:
        self._noise = Initiator(own.static, remote_static, ephemeral_secret, PROLOGUE, own.psk)
        self.local_index = local_index
        payload = local_index.to_bytes(INDEX_BYTES, "little") + own.public + len(rider).to_bytes(2, "little") + rider
        payload = payload.ljust(_PAYLOAD + INIT_LEAST - _INIT_BARE, b"\0")
        bare = bytes([INIT]) + self._noise.write(payload)
        self.datagram = bare + _mac(own.mac_key, bare)

    def accepted(self, datagram: bytes) -> tuple[int, bytes, TransportKeys]:
        """The responder's session index, its message (perhaps empty) and the keys in a RESP; raises ``Forged``.

        A failed reading spoils the state only if the datagram was forged by somebody who saw the INIT; so each reading
        works on a copy.
        """
        payload, keys = self._noise.copy().read(datagram[1 + INDEX_BYTES :])
        if len(payload) < INDEX_BYTES:
            raise Forged("a RESP without a session index")
        return int.from_bytes(payload[:INDEX_BYTES], "little"), payload[INDEX_BYTES:], keys


class Acceptance:
    """The responder's half: reads an INIT, then makes its RESP.

    ``public`` is the initiator's Ed25519 key, proved; ``rider`` its message; ``answer_room`` the bytes that the RESP
    may carry.  Raises ``Forged`` where anything is not as it must be.
    """

    def __init__(self, own: Credentials, datagram: bytes, ephemeral_secret: bytes) -> None:
        self._noise = Responder(own.static, ephemeral_secret, PROLOGUE, own.psk)
        payload, static = self._noise.read(datagram[1:-_MAC])
        self.remote_index = int.from_bytes(payload[:INDEX_BYTES], "little")
        self.public = payload[INDEX_BYTES : INDEX_BYTES + KEY]
        length = int.from_bytes(payload[_PAYLOAD - 2 : _PAYLOAD], "little")
        try:
            proved = exchange_key(self.public) == static
        except (ValueError, RuntimeError, TypeError):
            proved = False
        if not proved or len(payload) < _PAYLOAD + length:
            raise Forged("an INIT whose key is not its sender's, or that is cut short")
        self.rider = payload[_PAYLOAD : _PAYLOAD + length]
        self.answer_room = len(datagram) - _RESP_BARE

    def accept(self, local_index: int, answer: bytes) -> tuple[bytes, TransportKeys]:
        """The RESP datagram that carries ``answer`` (at most ``answer_room`` bytes), and the keys."""
        message, keys = self._noise.write(local_index.to_bytes(INDEX_BYTES, "little") + answer)
        return bytes([RESP]) + self.remote_index.to_bytes(INDEX_BYTES, "little") + message, keys


def is_init_of_team(own: Credentials, datagram: bytes) -> bool:
    """Whether an INIT has a lawful size and was made by somebody who holds the team's key."""
    if not INIT_LEAST <= len(datagram) <= MAX_DATAGRAM:
        return False
    return hmac.compare_digest(_mac(own.mac_key, datagram[:-_MAC]), datagram[-_MAC:])


def ephemeral_of(init: bytes) -> bytes:
    """The initiator's ephemeral key, by which a repeated INIT is known."""
    return init[1 : 1 + KEY]


def _mac(key: bytes, data: bytes) -> bytes:
    return hashlib.blake2s(data, key=key, digest_size=_MAC).digest()
