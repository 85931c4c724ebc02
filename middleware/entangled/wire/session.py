"""Session: the datagrams that open one (INIT, RESP) and those that it carries (DATA).

Each of the first two carries a message, the sender's pass, which the ``door`` of the other side judges, and the life
that it lives.  INIT is padded so that RESP need never be larger; RESP says from where the INIT came, or that it is
refused.  A keyed hash near the end of INIT lets a node drop what outsiders make up for a microsecond instead of four
key exchanges; a second one, made with a cookie that the responder gave, is asked for when too many come (``greeting``).

A DATA datagram is: type (1), the receiver's index of the session (4), counter (8), then the sealed message with its tag
(16): 29 bytes more than the message.  The 13 bytes in front are authenticated too.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
from dataclasses import dataclass, field
from typing import NamedTuple

from middleware.entangled.contact import Contact
from middleware.entangled.errors import Forged
from middleware.entangled.identity import Identity, exchange_key
from middleware.entangled.network.network import ADDRESS, MAX_DATAGRAM, Address, address_of, packed_address
from middleware.entangled.wire.door import NONCE, UNCOUNTED, Life, is_refusal
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
_LIFE = 8 + NONCE
STAMP = 8
_ASKED = INDEX_BYTES + KEY + _LIFE  # before the pass of an INIT
_GIVEN = INDEX_BYTES + _LIFE + ADDRESS  # before that of a RESP
_PAYLOAD = _ASKED + 2 + 2 + STAMP
_INIT_BARE = 1 + FIRST_OVERHEAD + _PAYLOAD + 2 * MAC
_RESP_BARE = 1 + INDEX_BYTES + SECOND_OVERHEAD + _GIVEN + 2
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
_NO_LIFE = bytes(_LIFE)
_WINDOW_MASK = (1 << WINDOW) - 1
_pack = struct.Struct("<BIQ").pack
"""The header of a DATA datagram: its kind, the receiver's index, the counter."""


def derived_key(team_key: bytes, purpose: bytes) -> bytes:
    """The team's key for one purpose (32 bytes)."""
    return hashlib.blake2s(PROLOGUE + b" " + purpose, key=team_key).digest()


@dataclass(frozen=True)
class Credentials:
    """What a node needs to open and to accept sessions under one secret of its team; what shows it shows no secret."""

    public: bytes
    static: KeyPair = field(repr=False)
    psk: bytes = field(repr=False)
    mac_key: bytes = field(repr=False)
    greet_key: bytes = field(repr=False)
    cookie_key: bytes = field(repr=False)

    @classmethod
    def of(cls, identity: Identity, team_key: bytes) -> Credentials:
        """The credentials of ``identity`` in the team that holds ``team_key`` (32 bytes)."""
        purposes = (b"psk", b"mac", b"greet", b"cookie")
        keys = [derived_key(team_key, purpose) for purpose in purposes]
        return cls(identity.public, key_pair(identity.exchange_secret), *keys)


class Hello(NamedTuple):
    """What a node says of itself in a handshake: its life and its pass.

    ``room`` is what the pass of the other side may take.
    """

    life: Life = UNCOUNTED
    shown: bytes = b""
    room: int = 0

    @property
    def rider_room(self) -> int:
        """The bytes of a message that an INIT may carry beside the pass."""
        return MAX_RIDER - len(self.shown)

    @property
    def init_least(self) -> int:
        """The length of the shortest INIT that is answered with a pass and a message of ``ANSWER_ROOM``."""
        return INIT_LEAST + self.room


OF_OPEN_TEAM = Hello()


class Reply(NamedTuple):
    """What a RESP says: ``remote_index``, the responder's index, its life, pass and message.

    ``seen`` is where the INIT came from, as the responder saw it (None: it cannot say).  ``refusal`` names why it lets
    us not in; then nothing else counts.
    """

    remote_index: int
    life: Life
    seen: Address | None
    shown: bytes
    message: bytes
    refusal: str
    keys: TransportKeys


class Invitation:
    """The initiator's half of a handshake; ``mac`` is the first of the two hashes in its INIT.

    ``stamp`` is the timestamp of the INIT: higher than that of every INIT before it of this life.
    """

    def __init__(
        self,
        own: Credentials,
        remote_static: bytes,
        ephemeral_secret: bytes,
        local_index: int,
        rider: bytes,
        hello: Hello = OF_OPEN_TEAM,
        stamp: int = 0,
    ) -> None:
        self.own = own
        self._noise = Initiator(own.static, remote_static, ephemeral_secret, PROLOGUE, own.psk)
        self.local_index = local_index
        index = local_index.to_bytes(INDEX_BYTES, "little")
        payload = index + own.public + _packed_life(hello.life) + _counted(hello.shown) + _counted(rider)
        payload += stamp.to_bytes(STAMP, "little")
        payload = payload.ljust(_PAYLOAD + hello.init_least - _INIT_BARE, b"\0")
        bare = bytes([INIT]) + self._noise.write(payload)
        self.mac = _hashed(own.mac_key, bare)
        self._proven = bare + self.mac

    def datagram(self, cookie: bytes = b"") -> bytes:
        """The INIT, which may be sent again unchanged, or with a ``cookie`` that the responder asked for."""
        return self._proven + (_hashed(cookie, self._proven) if cookie else bytes(MAC))

    def accepted(self, datagram: bytes) -> Reply:
        """What a RESP says, with the keys of the session; raises ``Forged``.

        A failed reading spoils the state only if the datagram was forged by somebody who saw the INIT; so each reading
        works on a copy.
        """
        payload, keys = self._noise.copy().read(datagram[1 + INDEX_BYTES :])
        index = int.from_bytes(payload[:INDEX_BYTES], "little")
        life = _life(payload[INDEX_BYTES : INDEX_BYTES + _LIFE])
        seen = address_of(payload[INDEX_BYTES + _LIFE : _GIVEN])
        shown, message = _taken(payload, _GIVEN)
        if index:
            return Reply(index, life, seen, shown, message, "", keys)
        refusal = message.decode("ascii", errors="replace")
        if not is_refusal(refusal):
            raise Forged("a RESP with neither a session nor a refusal")
        return Reply(0, life, seen, b"", b"", refusal, keys)


class Acceptance:
    """The responder's half: reads an INIT, then makes its RESP.

    ``public`` is the initiator's Ed25519 key, proved; ``life`` and ``shown`` what it says of itself, ``rider`` its
    message, ``stamp`` its timestamp.  Raises ``Forged`` where anything is not as it must be.
    """

    def __init__(self, own: Credentials, datagram: bytes, ephemeral_secret: bytes) -> None:
        self._noise = Responder(own.static, ephemeral_secret, PROLOGUE, own.psk)
        payload, static = self._noise.read(datagram[1 : -2 * MAC])
        self.remote_index = int.from_bytes(payload[:INDEX_BYTES], "little")
        self.public = payload[INDEX_BYTES : INDEX_BYTES + KEY]
        self.life = _life(payload[INDEX_BYTES + KEY : _ASKED])
        try:
            proved = exchange_key(self.public) == static
        except (ValueError, RuntimeError, TypeError):
            proved = False
        if not proved:
            raise Forged("an INIT whose key is not its sender's")
        self.shown, rest = _taken(payload, _ASKED)
        self.rider, rest = _taken(rest, 0)
        self.stamp = int.from_bytes(rest[:STAMP], "little")
        self._room = len(datagram) - _RESP_BARE

    def answer_room(self, hello: Hello) -> int:
        """The bytes of a message that the RESP may carry beside the pass."""
        return self._room - len(hello.shown)

    def accept(
        self, local_index: int, answer: bytes, seen: Address, hello: Hello = OF_OPEN_TEAM
    ) -> tuple[bytes, TransportKeys]:
        """The RESP datagram that carries ``answer`` (at most ``answer_room`` bytes), and the keys."""
        index = local_index.to_bytes(INDEX_BYTES, "little")
        payload = index + _packed_life(hello.life) + packed_address(seen) + _counted(hello.shown) + answer
        message, keys = self._noise.write(payload)
        return bytes([RESP]) + self.remote_index.to_bytes(INDEX_BYTES, "little") + message, keys

    def refuse(self, code: str, seen: Address, life: Life) -> bytes:
        """The RESP datagram that says why its sender is not let in."""
        return self.accept(0, code.encode("ascii"), seen, Hello(life))[0]


def is_init_of_team(own: Credentials, datagram: bytes) -> bool:
    """Whether an INIT of a lawful size was made by somebody who holds the secret that ``own`` goes by."""
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


def _packed_life(life: Life) -> bytes:
    return life.number.to_bytes(8, "little") + life.nonce


def _life(packed: bytes) -> Life:
    if packed == _NO_LIFE:
        return UNCOUNTED
    return Life(int.from_bytes(packed[:8], "little"), packed[8:])


def _counted(data: bytes) -> bytes:
    return len(data).to_bytes(2, "little") + data


def _taken(payload: bytes, start: int) -> tuple[bytes, bytes]:
    """The bytes whose count stands at ``start``, and what follows them; raises ``Forged`` where they are cut short."""
    begin = start + 2
    end = begin + int.from_bytes(payload[start:begin], "little")
    if len(payload) < end or len(payload) < begin:
        raise Forged("a handshake that is cut short")
    return payload[begin:end], payload[end:]


class Session:
    """One agreed pair of keys with one peer.

    ``local_index`` is the number under which we find the session, ``remote_index`` the one under which the peer does.
    ``contact`` is the peer with the address from which its newest datagram came.  ``is_confirmed`` says that the peer
    has shown to hold the keys at that address; until then nothing may be sent.  Moments are seconds of the endpoint's
    clock.  ``life`` is the one that the peer lives in it; with ``is_over`` a later one has taken its place.  ``shown``
    is the pass in its INIT, until the session is confirmed.
    """

    __slots__ = (
        "contact",
        "life",
        "is_over",
        "shown",
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
    )

    def __init__(
        self,
        contact: Contact,
        local_index: int,
        remote_index: int,
        keys: TransportKeys,
        now: float,
        is_confirmed: bool,
        life: Life = UNCOUNTED,
    ) -> None:
        self.contact = contact
        self.life = life
        self.is_over = False
        self.shown = b""
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

    def seal(self, message: bytes) -> bytes:
        """The next DATA datagram, with ``message`` of at most ``MAX_PLAIN`` bytes inside."""
        counter = self._sent
        self._sent = counter + 1
        header = _pack(DATA, self.remote_index, counter)
        return header + sealed(self._sending, counter, message, header)

    @property
    def sent(self) -> int:
        """How many datagrams were sealed."""
        return self._sent

    def is_replay(self, datagram: bytes) -> bool:
        """Whether the counter of a DATA datagram has been here, or is too old to tell; costs no decryption."""
        behind = self._highest - int.from_bytes(datagram[5:_HEADER], "little")
        return behind >= 0 and (behind >= WINDOW or bool(self._seen >> behind & 1))

    def open(self, datagram: bytes) -> tuple[bytes, int]:
        """The message inside a DATA datagram, and how far its counter is ahead of the newest one before it.

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
        return message, ahead


def index_of(datagram: bytes) -> int:
    """The receiver's session index in a DATA or RESP datagram."""
    return int.from_bytes(datagram[1 : 1 + INDEX_BYTES], "little")


class HalfOpen:
    """The sessions whose initiators have not confirmed them, and the RESPs of the last ``RESPONSES_S`` seconds.

    ``sessions`` is the endpoint's table, in which the former stand too.
    """

    def __init__(self, sessions: dict[int, Session]) -> None:
        self._sessions = sessions
        self._unconfirmed: dict[int, Session] = {}
        self._responses: dict[bytes, tuple[float, bytes]] = {}

    def response(self, init: bytes, now: float) -> bytes | None:
        """The RESP that this INIT got already."""
        made_at, response = self._responses.get(ephemeral_of(init), (-RESPONSES_S, None))
        return response if made_at > now - RESPONSES_S else None

    def add(self, session: Session, now: float) -> None:
        """Keep a new session, and let go of what is too much or too old."""
        self._sessions[session.local_index] = self._unconfirmed[session.local_index] = session
        self.sweep(now)

    def answered(self, init: bytes, response: bytes, now: float) -> None:
        """Keep the RESP of an INIT, and let go of what is too much or too old."""
        self._responses.pop(ephemeral_of(init), None)
        self._responses[ephemeral_of(init)] = (now, response)
        self.sweep(now)

    def sweep(self, now: float) -> None:
        """Let go of what is too much or too old."""
        unconfirmed, responses = self._unconfirmed, self._responses
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

    def forget(self, session: Session) -> None:
        """Forget a session that was not let in."""
        if self._unconfirmed.pop(session.local_index, None) is not None:
            self._sessions.pop(session.local_index, None)

    def drop(self, public: bytes) -> None:
        """Forget the sessions of one initiator."""
        for index in [index for index, session in self._unconfirmed.items() if session.contact.public == public]:
            del self._unconfirmed[index]
            self._sessions.pop(index, None)

    def clear(self) -> None:
        """Forget everything."""
        self._unconfirmed.clear()
        self._responses.clear()
