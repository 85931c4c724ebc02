"""Build and read the datagrams that open a session (INIT, RESP) and the DATA datagrams that it carries.

INIT and RESP each contain a message, the sender's incarnation, and the sender's admission credential, which the other
side checks.  INIT is padded so that RESP is never larger; RESP contains the source address of the INIT, or a refusal.
A keyed hash near the end of INIT lets a node detect and drop a forged datagram in a microsecond, without four key
exchanges.  Under load a second hash is required, made with a cookie from the responder (``discovery``).

A DATA datagram consists of the type (1 byte), the receiver's index of the session (4), the counter (8), and the
encrypted message with its tag (16): 29 bytes more than the message.  The 13 header bytes are also authenticated.
"""

from __future__ import annotations

import hashlib
import hmac
import struct
from dataclasses import dataclass, field
from typing import NamedTuple

from middleware.entangled.contact import Contact
from middleware.entangled.errors import Forged
from middleware.entangled.identity import Identity, derive_exchange_key
from middleware.entangled.network.network import ADDRESS_BYTES, MAX_DATAGRAM_BYTES, Address, pack_address, parse_address
from middleware.entangled.wire.admission_check import NONCE_BYTES, UNNUMBERED, Incarnation, is_refusal
from middleware.entangled.wire.noise import (
    FIRST_OVERHEAD_BYTES,
    KEY_BYTES,
    SECOND_OVERHEAD_BYTES,
    TAG_BYTES,
    Initiator,
    KeyPair,
    Responder,
    TransportKeys,
    make_key_pair,
    open_sealed,
    seal,
)

INIT = 0x11
RESP = 0x12
DATA = 0x13
PROLOGUE = b"swarm-wire-1"
INDEX_BYTES = 4
MAC_BYTES = 16
MIN_ANSWER_BYTES = 512
_INCARNATION_BYTES = 8 + NONCE_BYTES
TIMESTAMP_BYTES = 8
_INIT_PASS_AT = INDEX_BYTES + KEY_BYTES + _INCARNATION_BYTES  # the offset of the admission credential in an INIT
_RESP_PASS_AT = INDEX_BYTES + _INCARNATION_BYTES + ADDRESS_BYTES  # the offset of the admission credential in a RESP
_PAYLOAD_BYTES = _INIT_PASS_AT + 2 + 2 + TIMESTAMP_BYTES
_INIT_FIXED_BYTES = 1 + FIRST_OVERHEAD_BYTES + _PAYLOAD_BYTES + 2 * MAC_BYTES
_RESP_FIXED_BYTES = 1 + INDEX_BYTES + SECOND_OVERHEAD_BYTES + _RESP_PASS_AT + 2
MIN_RESP_BYTES = _RESP_FIXED_BYTES
MIN_INIT_BYTES = _RESP_FIXED_BYTES + MIN_ANSWER_BYTES
MAX_EARLY_BYTES = MAX_DATAGRAM_BYTES - _INIT_FIXED_BYTES

_HEADER_BYTES = 1 + INDEX_BYTES + 8
OVERHEAD_BYTES = _HEADER_BYTES + TAG_BYTES
MAX_PLAIN_BYTES = (
    MAX_DATAGRAM_BYTES - OVERHEAD_BYTES
)  # the capacity of one datagram; longer messages are sent in fragments
WINDOW = 1024
MAX_UNCONFIRMED = 512
UNCONFIRMED_S = 10.0
MAX_RESPONSES = 512
RESPONSES_S = 30.0
_PACKED_UNNUMBERED = bytes(_INCARNATION_BYTES)
_WINDOW_MASK = (1 << WINDOW) - 1
_pack = struct.Struct("<BIQ").pack
"""The header of a DATA datagram: its kind, the receiver's index, the counter."""


def derive_key(team_key: bytes, purpose: bytes) -> bytes:
    """Derive the team's key for one purpose (32 bytes)."""
    return hashlib.blake2s(PROLOGUE + b" " + purpose, key=team_key).digest()


@dataclass(frozen=True)
class Credentials:
    """The keys to open and accept sessions under one secret of the team; their ``repr`` hides the secrets."""

    public: bytes
    static: KeyPair = field(repr=False)
    psk: bytes = field(repr=False)
    mac_key: bytes = field(repr=False)
    discovery_key: bytes = field(repr=False)
    cookie_key: bytes = field(repr=False)

    @classmethod
    def derive(cls, identity: Identity, team_key: bytes) -> Credentials:
        """Return the credentials of ``identity`` in the team with ``team_key`` (32 bytes)."""
        purposes = (b"psk", b"mac", b"greet", b"cookie")
        keys = [derive_key(team_key, purpose) for purpose in purposes]
        return cls(identity.public, make_key_pair(identity.exchange_secret), *keys)


class HandshakeFields(NamedTuple):
    """The fields of one node in a handshake: its incarnation and its admission credential.

    ``max_pass_bytes`` is the maximum length of the other side's credential in bytes.
    """

    incarnation: Incarnation = UNNUMBERED
    own_pass: bytes = b""
    max_pass_bytes: int = 0

    @property
    def max_early_bytes(self) -> int:
        """The maximum length of a message in an INIT with this admission credential, in bytes."""
        return MAX_EARLY_BYTES - len(self.own_pass)

    @property
    def min_init_bytes(self) -> int:
        """The minimum length of an INIT, in bytes.

        A RESP of this length has space for a credential and a message of ``MIN_ANSWER_BYTES`` bytes.
        """
        return MIN_INIT_BYTES + self.max_pass_bytes


OPEN_TEAM_FIELDS = HandshakeFields()


class Response(NamedTuple):
    """The content of a RESP: the responder's session index (``remote_index``), incarnation, credential and message.

    ``seen`` is the source address of the INIT as the responder saw it (None: unknown).  If ``refusal`` contains a code,
    the responder rejects this node, and the other fields have no meaning.
    """

    remote_index: int
    incarnation: Incarnation
    observed_address: Address | None
    peer_pass: bytes
    message: bytes
    refusal: str
    keys: TransportKeys


class InitiatorHandshake:
    """The initiator's half of a handshake; ``mac`` is the first of the two hashes in its INIT.

    ``timestamp`` is the timestamp of the INIT; it must be higher than in every earlier INIT of this incarnation.
    """

    def __init__(
        self,
        credentials: Credentials,
        remote_static: bytes,
        ephemeral_secret: bytes,
        local_index: int,
        early_message: bytes,
        hello: HandshakeFields = OPEN_TEAM_FIELDS,
        timestamp: int = 0,
    ) -> None:
        self.credentials = credentials
        self._noise = Initiator(credentials.static, remote_static, ephemeral_secret, PROLOGUE, credentials.psk)
        self.local_index = local_index
        index = local_index.to_bytes(INDEX_BYTES, "little")
        payload = (
            index
            + credentials.public
            + _pack_incarnation(hello.incarnation)
            + _prefix_length(hello.own_pass)
            + _prefix_length(early_message)
        )
        payload += timestamp.to_bytes(TIMESTAMP_BYTES, "little")
        payload = payload.ljust(_PAYLOAD_BYTES + hello.min_init_bytes - _INIT_FIXED_BYTES, b"\0")
        bare = bytes([INIT]) + self._noise.write(payload)
        self.mac = _keyed_hash(credentials.mac_key, bare)
        self._init_without_cookie = bare + self.mac

    def make_init(self, cookie: bytes = b"") -> bytes:
        """Return the INIT, with ``cookie`` if the responder requested one; the same INIT may be sent several times."""
        return self._init_without_cookie + (
            _keyed_hash(cookie, self._init_without_cookie) if cookie else bytes(MAC_BYTES)
        )

    def read_response(self, datagram: bytes) -> Response:
        """Decode a RESP and return it with the keys of the session; raise ``Forged``.

        Each call uses a copy of the handshake state, because a forged RESP would corrupt the state.
        """
        payload, keys = self._noise.copy().read(datagram[1 + INDEX_BYTES :])
        index = int.from_bytes(payload[:INDEX_BYTES], "little")
        incarnation = _unpack_incarnation(payload[INDEX_BYTES : INDEX_BYTES + _INCARNATION_BYTES])
        seen = parse_address(payload[INDEX_BYTES + _INCARNATION_BYTES : _RESP_PASS_AT])
        peer_pass, message = _split_prefixed(payload, _RESP_PASS_AT)
        if index:
            return Response(index, incarnation, seen, peer_pass, message, "", keys)
        refusal = message.decode("ascii", errors="replace")
        if not is_refusal(refusal):
            raise Forged("the RESP has neither a session nor a refusal")
        return Response(0, incarnation, seen, b"", b"", refusal, keys)


class ResponderHandshake:
    """The responder's half of a handshake: reads an INIT, then builds its RESP.

    ``public`` is the initiator's verified Ed25519 key.  The other attributes are the initiator's incarnation, admission
    credential, message and timestamp.  Raises ``Forged`` for an invalid INIT.
    """

    def __init__(self, credentials: Credentials, datagram: bytes, ephemeral_secret: bytes) -> None:
        self._noise = Responder(credentials.static, ephemeral_secret, PROLOGUE, credentials.psk)
        payload, static = self._noise.read(datagram[1 : -2 * MAC_BYTES])
        self.remote_index = int.from_bytes(payload[:INDEX_BYTES], "little")
        self.public = payload[INDEX_BYTES : INDEX_BYTES + KEY_BYTES]
        self.incarnation = _unpack_incarnation(payload[INDEX_BYTES + KEY_BYTES : _INIT_PASS_AT])
        try:
            proved = derive_exchange_key(self.public) == static
        except (ValueError, RuntimeError, TypeError):
            proved = False
        if not proved:
            raise Forged("the key in the INIT does not match its static key")
        self.peer_pass, rest = _split_prefixed(payload, _INIT_PASS_AT)
        self.early_message, rest = _split_prefixed(rest, 0)
        self.timestamp = int.from_bytes(rest[:TIMESTAMP_BYTES], "little")
        self._room_bytes = len(datagram) - _RESP_FIXED_BYTES

    def max_answer_bytes(self, hello: HandshakeFields) -> int:
        """Return the maximum length of a message in the RESP in bytes, besides the admission credential."""
        return self._room_bytes - len(hello.own_pass)

    def accept(
        self, local_index: int, answer: bytes, seen: Address, hello: HandshakeFields = OPEN_TEAM_FIELDS
    ) -> tuple[bytes, TransportKeys]:
        """Return the RESP with ``answer`` (at most ``max_answer_bytes`` bytes), and the keys."""
        index = local_index.to_bytes(INDEX_BYTES, "little")
        payload = (
            index + _pack_incarnation(hello.incarnation) + pack_address(seen) + _prefix_length(hello.own_pass) + answer
        )
        message, keys = self._noise.write(payload)
        return bytes([RESP]) + self.remote_index.to_bytes(INDEX_BYTES, "little") + message, keys

    def refuse(self, code: str, seen: Address, incarnation: Incarnation) -> bytes:
        """Return the RESP that rejects the initiator."""
        return self.accept(0, code.encode("ascii"), seen, HandshakeFields(incarnation))[0]


def is_init_of_team(own: Credentials, datagram: bytes) -> bool:
    """Return whether the sender of an INIT (of a valid size) has the team secret of ``own``."""
    return hmac.compare_digest(_keyed_hash(own.mac_key, datagram[: -2 * MAC_BYTES]), read_mac(datagram))


def read_mac(init: bytes) -> bytes:
    """Return the hash in an INIT that was computed with the team's key."""
    return init[-2 * MAC_BYTES : -MAC_BYTES]


def has_cookie(init: bytes, cookie: bytes) -> bool:
    """Return whether the INIT was made with ``cookie``."""
    return hmac.compare_digest(_keyed_hash(cookie, init[:-MAC_BYTES]), init[-MAC_BYTES:])


def read_ephemeral(init: bytes) -> bytes:
    """Return the initiator's ephemeral key, which identifies a repeated INIT."""
    return init[1 : 1 + KEY_BYTES]


def _keyed_hash(key: bytes, data: bytes) -> bytes:
    return hashlib.blake2s(data, key=key, digest_size=MAC_BYTES).digest()


def _pack_incarnation(incarnation: Incarnation) -> bytes:
    return incarnation.number.to_bytes(8, "little") + incarnation.nonce


def _unpack_incarnation(packed: bytes) -> Incarnation:
    if packed == _PACKED_UNNUMBERED:
        return UNNUMBERED
    return Incarnation(int.from_bytes(packed[:8], "little"), packed[8:])


def _prefix_length(data: bytes) -> bytes:
    return len(data).to_bytes(2, "little") + data


def _split_prefixed(payload: bytes, start: int) -> tuple[bytes, bytes]:
    """Return the length-prefixed bytes at ``start`` and the bytes after them; raise ``Forged`` if truncated."""
    begin = start + 2
    end = begin + int.from_bytes(payload[start:begin], "little")
    if len(payload) < end or len(payload) < begin:
        raise Forged("the handshake is truncated")
    return payload[begin:end], payload[end:]


class Session:
    """The keys and the state of one session with one peer.

    ``local_index`` identifies the session at this node, ``remote_index`` at the peer.  ``contact`` is the peer with the
    source address of its newest datagram.  ``is_confirmed``: the peer has proved at that address that it has the keys;
    until then nothing may be sent.  Times are seconds of the endpoint's clock.  ``incarnation`` is the incarnation of
    the peer; ``is_superseded``: a later incarnation has replaced it.  ``peer_pass`` is the admission credential in the
    peer's INIT, stored until the session is confirmed.
    """

    __slots__ = (
        "contact",
        "incarnation",
        "is_superseded",
        "peer_pass",
        "local_index",
        "remote_index",
        "is_confirmed",
        "opened_at",
        "last_received_at",
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
        incarnation: Incarnation = UNNUMBERED,
    ) -> None:
        self.contact = contact
        self.incarnation = incarnation
        self.is_superseded = False
        self.peer_pass = b""
        self.local_index = local_index
        self.remote_index = remote_index
        self.is_confirmed = is_confirmed
        self.opened_at = now
        self.last_received_at = now
        self._sending = keys.sending
        self._receiving = keys.receiving
        self._sent = 0
        self._highest = -1
        self._seen = 0  # bit n: the counter n below the highest was received

    def seal(self, message: bytes) -> bytes:
        """Return the next DATA datagram, which contains ``message`` (at most ``MAX_PLAIN_BYTES`` bytes) encrypted."""
        counter = self._sent
        self._sent = counter + 1
        header = _pack(DATA, self.remote_index, counter)
        return header + seal(self._sending, counter, message, header)

    @property
    def sent(self) -> int:
        """The number of DATA datagrams that were encrypted."""
        return self._sent

    def is_replay(self, datagram: bytes) -> bool:
        """Return, without decryption, whether a DATA datagram's counter was received before or is below the window."""
        behind = self._highest - int.from_bytes(datagram[5:_HEADER_BYTES], "little")
        return behind >= 0 and (behind >= WINDOW or bool(self._seen >> behind & 1))

    def open(self, datagram: bytes) -> tuple[bytes, int]:
        """Decrypt a DATA datagram; return its message, and how far its counter is ahead of the highest earlier counter.

        Raises ``Forged`` if the datagram is not authentic or is a replay; the session is then unchanged.
        """
        if len(datagram) < OVERHEAD_BYTES or self.is_replay(datagram):
            raise Forged("the datagram is a replay, or too short")
        header = datagram[:_HEADER_BYTES]
        counter = int.from_bytes(header[5:], "little")
        message = open_sealed(self._receiving, counter, datagram[_HEADER_BYTES:], header)
        ahead = counter - self._highest
        if ahead > 0:
            # A counter may advance by up to 2**64, but a bitmap that is shifted by more than the window only wastes
            # memory.
            self._seen = ((self._seen << ahead) & _WINDOW_MASK if ahead < WINDOW else 0) | 1
            self._highest = counter
        else:
            self._seen |= 1 << -ahead
        return message, ahead


def read_index(datagram: bytes) -> int:
    """Return the receiver's session index in a DATA or RESP datagram."""
    return int.from_bytes(datagram[1 : 1 + INDEX_BYTES], "little")


class HalfOpenSessions:
    """Sessions that their initiators have not confirmed, and the RESPs of the last ``RESPONSES_S`` seconds.

    ``sessions`` is the endpoint's table of all sessions, including the unconfirmed ones.
    """

    def __init__(self, sessions: dict[int, Session]) -> None:
        self._sessions = sessions
        self._unconfirmed: dict[int, Session] = {}
        self._responses: dict[bytes, tuple[float, bytes]] = {}

    def find_response(self, init: bytes, now: float) -> bytes | None:
        """Return the RESP that was sent for this INIT."""
        made_at, response = self._responses.get(read_ephemeral(init), (-RESPONSES_S, None))
        return response if made_at > now - RESPONSES_S else None

    def add(self, session: Session, now: float) -> None:
        """Add a new session, and delete surplus or expired entries."""
        self._sessions[session.local_index] = self._unconfirmed[session.local_index] = session
        self.sweep(now)

    def store_response(self, init: bytes, response: bytes, now: float) -> None:
        """Store the RESP of an INIT, and delete surplus or expired entries."""
        self._responses.pop(read_ephemeral(init), None)
        self._responses[read_ephemeral(init)] = (now, response)
        self.sweep(now)

    def sweep(self, now: float) -> None:
        """Delete surplus and expired entries."""
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
        """Record that the initiator proved at its address that it has the keys."""
        session.is_confirmed = True
        self._unconfirmed.pop(session.local_index, None)

    def forget(self, session: Session) -> None:
        """Delete a session that was rejected."""
        if self._unconfirmed.pop(session.local_index, None) is not None:
            self._sessions.pop(session.local_index, None)

    def forget_peer(self, public: bytes) -> None:
        """Delete the sessions of one initiator."""
        for index in [index for index, session in self._unconfirmed.items() if session.contact.public == public]:
            del self._unconfirmed[index]
            self._sessions.pop(index, None)

    def clear(self) -> None:
        """Delete all entries."""
        self._unconfirmed.clear()
        self._responses.clear()
