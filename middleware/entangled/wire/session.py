"""Session: the datagrams that open one (INIT, RESP) and those that it carries (DATA).

INIT carries a message of the initiator, RESP the responder's; INIT is padded so that RESP need never be larger.  A
keyed hash near the end of INIT lets a node drop what outsiders make up for a microsecond instead of four key exchanges;
a second one, made with a cookie that the responder gave, is asked for when too many come (see ``greeting``).

A DATA datagram is: type (1), the receiver's index of the session (4), counter (8), then the sealed message with its tag
(16): 29 bytes more than the message.  The 13 bytes in front are authenticated too.
"""

from __future__ import annotations

import hashlib
import hmac
from collections import OrderedDict
from dataclasses import dataclass

from middleware.entangled.errors import Forged
from middleware.entangled.identity import Identity, exchange_key
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.network.network import MAX_DATAGRAM
from middleware.entangled.wire.noise import (
    FIRST_OVERHEAD,
    KEY,
    SECOND_OVERHEAD,
    TAG,
    Initiator,
    KeyPair,
    Responder,
    TransportKeys,
    key_pair,
    opened,
    sealed,
)

INIT = 0x11
RESP = 0x12
DATA = 0x13
PROLOGUE = b"swarm-wire-1"
INDEX_BYTES = 4
MAC = 16
ANSWER_ROOM = 512
_PAYLOAD = INDEX_BYTES + KEY + 2
_INIT_BARE = 1 + FIRST_OVERHEAD + _PAYLOAD + 2 * MAC
_RESP_BARE = 1 + INDEX_BYTES + SECOND_OVERHEAD + INDEX_BYTES
RESP_LEAST = _RESP_BARE
INIT_LEAST = _RESP_BARE + ANSWER_ROOM
MAX_RIDER = MAX_DATAGRAM - _INIT_BARE

_HEADER = 1 + INDEX_BYTES + 8
OVERHEAD = _HEADER + TAG
MAX_PLAIN = MAX_DATAGRAM - OVERHEAD  # what one datagram carries; longer messages go as parcels
WINDOW = 1024
MAX_UNCONFIRMED = 512
UNCONFIRMED_S = 10.0
MAX_RESPONSES = 512
RESPONSES_S = 30.0
_WINDOW_MASK = (1 << WINDOW) - 1


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
    """The initiator's half of a handshake; ``mac`` is the first of the two hashes in its INIT."""

    def __init__(
        self, own: Credentials, remote_static: bytes, ephemeral_secret: bytes, local_index: int, rider: bytes
    ) -> None:
        self._noise = Initiator(own.static, remote_static, ephemeral_secret, PROLOGUE, own.psk)
        self.local_index = local_index
        payload = local_index.to_bytes(INDEX_BYTES, "little") + own.public + len(rider).to_bytes(2, "little") + rider
        payload = payload.ljust(_PAYLOAD + INIT_LEAST - _INIT_BARE, b"\0")
        bare = bytes([INIT]) + self._noise.write(payload)
        self.mac = _hashed(own.mac_key, bare)
        self._proven = bare + self.mac

    def datagram(self, cookie: bytes = b"") -> bytes:
        """The INIT, which may be sent again unchanged, or with a ``cookie`` that the responder asked for."""
        return self._proven + (_hashed(cookie, self._proven) if cookie else bytes(MAC))

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
        payload, static = self._noise.read(datagram[1 : -2 * MAC])
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
    return hmac.compare_digest(_hashed(own.mac_key, datagram[: -2 * MAC]), mac_of(datagram))


def mac_of(init: bytes) -> bytes:
    """The hash in an INIT that shows the team's key."""
    return init[-2 * MAC : -MAC]


def has_cookie(init: bytes, cookie: bytes) -> bool:
    """Whether the INIT was made with ``cookie``."""
    return hmac.compare_digest(_hashed(cookie, init[:-MAC]), init[-MAC:])


def ephemeral_of(init: bytes) -> bytes:
    """The initiator's ephemeral key, by which a repeated INIT is known."""
    return init[1 : 1 + KEY]


def _hashed(key: bytes, data: bytes) -> bytes:
    return hashlib.blake2s(data, key=key, digest_size=MAC).digest()


class Session:
    """One agreed pair of keys with one peer.

    ``local_index`` is the number under which we find the session, ``remote_index`` the one under which the peer does.
    ``contact`` is the peer with the address from which its newest datagram came.  ``is_confirmed`` says that the peer
    has shown to hold the keys at that address; until then nothing may be sent.  Moments are seconds of the endpoint's
    clock.
    """

    __slots__ = (
        "contact",
        "local_index",
        "remote_index",
        "is_confirmed",
        "opened_at",
        "heard_at",
        "_sending",
        "_receiving",
        "_sent",
        "_highest",
        "_seen",
        "_header",
    )

    def __init__(
        self, contact: Contact, local_index: int, remote_index: int, keys: TransportKeys, now: float, is_confirmed: bool
    ) -> None:
        self.contact = contact
        self.local_index = local_index
        self.remote_index = remote_index
        self.is_confirmed = is_confirmed
        self.opened_at = now
        self.heard_at = now
        self._sending = keys.sending
        self._receiving = keys.receiving
        self._sent = 0
        self._highest = -1
        self._seen = 0  # bit n: the counter n below the highest has been here
        self._header = bytes([DATA]) + remote_index.to_bytes(INDEX_BYTES, "little")

    def seal(self, message: bytes) -> bytes:
        """The next DATA datagram, with ``message`` of at most ``MAX_PLAIN`` bytes inside."""
        counter = self._sent
        self._sent = counter + 1
        header = self._header + counter.to_bytes(8, "little")
        return header + sealed(self._sending, counter, message, header)

    @property
    def sent(self) -> int:
        """How many datagrams were sealed."""
        return self._sent

    def is_replay(self, datagram: bytes) -> bool:
        """Whether the counter of a DATA datagram has been here, or is too old to tell; costs no decryption."""
        behind = self._highest - int.from_bytes(datagram[5:_HEADER], "little")
        return behind >= 0 and (behind >= WINDOW or bool(self._seen >> behind & 1))

    def open(self, datagram: bytes) -> tuple[bytes, bool]:
        """The message inside a DATA datagram, and whether it is the newest so far.

        Raises ``Forged`` where the datagram does not open or was here before; the session is then as it was.
        """
        if len(datagram) < OVERHEAD or self.is_replay(datagram):
            raise Forged("a datagram that was here before, or is too short")
        header = datagram[:_HEADER]
        counter = int.from_bytes(header[5:], "little")
        message = opened(self._receiving, counter, datagram[_HEADER:], header)
        ahead = counter - self._highest
        if ahead > 0:
            # A counter may leap by up to 2**64: shifting by more than the window would only cost memory.
            self._seen = ((self._seen << ahead) & _WINDOW_MASK if ahead < WINDOW else 0) | 1
            self._highest = counter
        else:
            self._seen |= 1 << -ahead
        return message, ahead > 0


def index_of(datagram: bytes) -> int:
    """The receiver's session index in a DATA or RESP datagram."""
    return int.from_bytes(datagram[1 : 1 + INDEX_BYTES], "little")


class HalfOpen:
    """The sessions whose initiators have not confirmed them, and the RESPs of the last ``RESPONSES_S`` seconds.

    ``sessions`` is the endpoint's table, in which the former stand too.
    """

    def __init__(self, sessions: dict[int, Session]) -> None:
        self._sessions = sessions
        self._unconfirmed: OrderedDict[int, Session] = OrderedDict()
        self._responses: OrderedDict[bytes, tuple[float, bytes]] = OrderedDict()

    def response(self, init: bytes, now: float) -> bytes | None:
        """The RESP that this INIT got already."""
        made_at, response = self._responses.get(ephemeral_of(init), (-RESPONSES_S, None))
        return response if made_at > now - RESPONSES_S else None

    def add(self, session: Session, init: bytes, response: bytes, now: float) -> None:
        """Keep a new session, and let go of those that are too many or too old."""
        unconfirmed, responses = self._unconfirmed, self._responses
        self._sessions[session.local_index] = unconfirmed[session.local_index] = session
        responses[ephemeral_of(init)] = (now, response)
        responses.move_to_end(ephemeral_of(init))
        while unconfirmed:
            index, oldest = next(iter(unconfirmed.items()))
            if len(unconfirmed) <= MAX_UNCONFIRMED and oldest.opened_at > now - UNCONFIRMED_S:
                break
            del unconfirmed[index]
            self._sessions.pop(index, None)
        while responses:
            ephemeral, (made_at, _) = next(iter(responses.items()))
            if len(responses) <= MAX_RESPONSES and made_at > now - RESPONSES_S:
                break
            del responses[ephemeral]

    def confirm(self, session: Session) -> None:
        """Take note that the initiator holds the keys, at the address that it wrote from."""
        session.is_confirmed = True
        self._unconfirmed.pop(session.local_index, None)

    def clear(self) -> None:
        """Forget everything."""
        self._unconfirmed.clear()
        self._responses.clear()
