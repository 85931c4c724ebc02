"""Knock: what a newcomer and a bootstrap node say to each other, byte by byte (thesis, Figure 4.5).

::

    KNOCK    0x17 | id of the invitation 8 | nonce 24 | sealed under the invitation's psk, padded to 1400 in all
    WELCOME  0x18 | id 8 | sealed to the newcomer's ephemeral key and the psk; nothing where nobody knows the id

The psk follows from the invitation's *public* key, which the team's members know from their roll and whoever has the
code can make: so a WELCOME that opens comes from a member, and a KNOCK that opens from who has the code.  A WELCOME is
never longer than its KNOCK.  Codecs only; ``newcomer`` and ``welcome`` have the two sides.
"""

from __future__ import annotations

import hashlib
import random
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import msgpack
from nacl import bindings
from nacl.exceptions import CryptoError

from middleware.admission import sealed
from middleware.admission.certificate import ROOM, proof
from middleware.admission.errors import WHY
from middleware.admission.roll import ID, invitation_id
from middleware.admission.statement import SECRET_BYTES, moment, named, sized
from middleware.entangled.errors import Forged, Malformed
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.contact import Contact, unpacked
from middleware.entangled.network.network import MAX_DATAGRAM

KNOCK, WELCOME = 0x17, 0x18
KNOCK_BYTES = MAX_DATAGRAM
MAX_CONTACTS = 8
MAX_SECRETS = 2
_NONCE, _TAG = 24, 16
_HEAD = 1 + ID
_PADDED = KNOCK_BYTES - _HEAD - _NONCE - _TAG
MAX_WELCOME = KNOCK_BYTES - _HEAD - sealed.OVERHEAD
MAX_SETTINGS = 16


@dataclass(frozen=True)
class Knock:
    """What a newcomer says: its key, the ephemeral key for the answer, the name it wishes for, and the proof."""

    public: bytes
    ephemeral: bytes
    wish: str
    proof: bytes


@dataclass(frozen=True)
class Welcome:
    """What a newcomer is given: the operator's key, its pass, the team's secrets and whom to ask.

    ``secrets`` and ``settings`` are as in ``Membership``; ``team`` is what people call it.
    """

    operator: bytes
    team: str
    shown: bytes
    secrets: tuple[tuple[int, bytes, int], ...] = field(repr=False)
    contacts: tuple[Contact, ...] = ()
    settings: Mapping[str, str | int | float | bool] = field(default_factory=dict)


def psk_of(invitation: bytes) -> bytes:
    """The secret that the members share with who has the code; ``invitation`` is its public key."""
    return hashlib.blake2s(invitation, person=b"knock").digest()


def knock(invitation: Identity, public: bytes, ephemeral: bytes, wish: str, rng: random.Random) -> bytes:
    """The KNOCK of the newcomer ``public``, who wishes to be called ``wish`` (empty: as it comes)."""
    signature = proof(invitation, public, wish)
    body = msgpack.packb([public, ephemeral, wish, signature]).ljust(_PADDED, b"\0")
    head, nonce = bytes([KNOCK]) + invitation_id(invitation.public), rng.randbytes(_NONCE)
    key = psk_of(invitation.public)
    return head + nonce + bindings.crypto_aead_xchacha20poly1305_ietf_encrypt(body, head, nonce, key)


def id_of(datagram: bytes) -> bytes:
    """The id of the invitation that a KNOCK or WELCOME names; raises ``Malformed``."""
    is_knock = datagram[:1] == bytes([KNOCK])
    if len(datagram) < _HEAD or (is_knock and len(datagram) != KNOCK_BYTES):
        raise Malformed("a knock of the wrong length")
    return datagram[1:_HEAD]


def opened_knock(datagram: bytes, invitation: bytes) -> Knock:
    """What a KNOCK says that names the invitation with that public key; raises ``Forged`` or ``Malformed``.

    The proof is not checked here.
    """
    id_of(datagram)
    head, nonce = datagram[:_HEAD], datagram[_HEAD : _HEAD + _NONCE]
    try:
        body = bindings.crypto_aead_xchacha20poly1305_ietf_decrypt(
            datagram[_HEAD + _NONCE :], head, nonce, psk_of(invitation)
        )
    except (CryptoError, ValueError) as error:
        raise Forged("a knock that does not open") from error
    unpacker = msgpack.Unpacker(max_buffer_size=_PADDED, max_map_len=0, max_ext_len=0, max_array_len=4)
    unpacker.feed(body)
    try:
        public, ephemeral, wish, signature = unpacker.unpack()
    except Exception as error:  # the one place where foreign bytes are unpacked
        raise Malformed("a knock with other fields than it should have") from error
    return Knock(sized(public, 32), sized(ephemeral, 32), wish if wish == "" else named(wish), sized(signature, 64))


def welcome(invitation: bytes, ephemeral: bytes, welcomed: Welcome, rng: random.Random) -> bytes:
    """The WELCOME for a newcomer; as many contacts as there is room for.  Raises ``Forged`` for no ephemeral key."""
    contacts = [contact.packed() for contact in welcomed.contacts[:MAX_CONTACTS]]
    settings = dict(list(welcomed.settings.items())[:MAX_SETTINGS])
    secrets = [list(each) for each in welcomed.secrets[:MAX_SECRETS]]
    while True:
        body = msgpack.packb([welcomed.operator, welcomed.team, welcomed.shown, secrets, contacts, settings])
        if len(body) <= MAX_WELCOME or not (contacts or settings):
            return _answered(invitation, ephemeral, body, rng)
        if contacts:
            contacts.pop()
        else:
            settings = {}


def refusal(invitation: bytes, ephemeral: bytes, code: str, rng: random.Random) -> bytes:
    """The WELCOME that says no to a newcomer, by a code of ``errors.WHY``."""
    return _answered(invitation, ephemeral, msgpack.packb([code]), rng)


def unknown(name: bytes) -> bytes:
    """The WELCOME for an id that nobody knows; anybody can make it, so it is a hint and no more."""
    return bytes([WELCOME]) + name


def opened_welcome(datagram: bytes, invitation: bytes, ephemeral: bytes) -> Welcome | str:
    """What a WELCOME gives, or the code of the refusal that it is; ``ephemeral`` is the newcomer's secret half.

    Raises ``Forged`` or ``Malformed``.
    """
    if id_of(datagram) != invitation_id(invitation):
        raise Forged("a welcome by another invitation")
    if len(datagram) == _HEAD:
        return "unknown"
    body = sealed.opened(datagram[_HEAD:], ephemeral, psk_of(invitation), datagram[:_HEAD])
    try:
        fields = msgpack.unpackb(body, max_map_len=MAX_SETTINGS, max_ext_len=0, max_array_len=MAX_CONTACTS)
        if len(fields) == 1:
            return fields[0] if fields[0] in WHY else "unknown"
        operator, team, shown, secrets, contacts, settings = fields
        if not isinstance(shown, bytes) or len(shown) > ROOM or not secrets:
            raise Malformed("a welcome without a pass, or without a secret")
        found = tuple((moment(number), sized(secret, SECRET_BYTES), moment(until)) for number, secret, until in secrets)
        met = tuple(contact for each in contacts if (contact := unpacked(each)) is not None)
        return Welcome(sized(operator, 32), named(team), shown, found, met, _settings(settings))
    except Malformed:
        raise
    except Exception as error:  # the one place where foreign bytes are unpacked
        raise Malformed("a welcome with other fields than it should have") from error


def _settings(given: Any) -> dict[str, str | int | float | bool]:
    if not all(isinstance(key, str) and isinstance(value, str | int | float | bool) for key, value in given.items()):
        raise Malformed("settings that are none")
    return dict(given)


def _answered(invitation: bytes, ephemeral: bytes, body: bytes, rng: random.Random) -> bytes:
    head = bytes([WELCOME]) + invitation_id(invitation)
    return head + sealed.sealed(body, ephemeral, psk_of(invitation), head, rng)
