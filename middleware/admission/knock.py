"""Knock: what a newcomer and a bootstrap node say to each other, byte by byte (thesis, Figure 4.5).

::

    KNOCK    0x17 | id of the invitation 8 | nonce 24 | sealed under the invitation's psk, padded to 1400 in all
    WELCOME  0x18 | id 8 | sealed to the newcomer's ephemeral key and the psk
    HINT     0x18 | id 8 | the code of a refusal in ASCII, at most 16; unauthenticated

The psk follows from the invitation's *public* key, which the team's members know from their roll and whoever has the
code can make: so a KNOCK that opens comes from who has the code, and strangers cannot read it.  Members are not trusted
by it.  A WELCOME has three things that they cannot make: the sealed ``terms`` of the invitation, from which the
newcomer alone learns the operator's key; the answering node's grant by that operator, with the role bootstrap; and that
node's signature over the content and both keys of the newcomer.  A WELCOME is never longer than its KNOCK.  Codecs
only; ``newcomer`` and ``reception`` have the two sides.
"""

from __future__ import annotations

import hashlib
import random
from dataclasses import dataclass, field
from typing import NamedTuple

import msgpack
from nacl import bindings
from nacl.exceptions import CryptoError

from middleware.admission import sealed
from middleware.admission.certificate import BOOTSTRAP, ROOM, proof
from middleware.admission.code import Code, TermsContent, open_terms
from middleware.admission.errors import WHY
from middleware.admission.roll import ID, invitation_id
from middleware.admission.statement import SECRET_BYTES, Grant, moment, named, opened, sized
from middleware.entangled.contact import Contact, unpacked
from middleware.entangled.errors import Forged, Malformed
from middleware.entangled.identity import Identity, verified
from middleware.entangled.network.network import MAX_DATAGRAM

KNOCK, WELCOME = 0x17, 0x18
KNOCK_BYTES = MAX_DATAGRAM
MAX_CONTACTS = 8
MAX_SECRETS = 2
_NONCE, _TAG = 24, 16
_HEAD = 1 + ID
_PADDED = KNOCK_BYTES - _HEAD - _NONCE - _TAG
MAX_WELCOME = KNOCK_BYTES - _HEAD - sealed.OVERHEAD
MAX_HINT = 16
_DOMAIN = b"swarm-welcome-1 "


@dataclass(frozen=True)
class Knock:
    """What a newcomer says: its key, the ephemeral key for the answer, the name it wishes for, and the proof."""

    public: bytes
    ephemeral: bytes
    wish: str
    proof: bytes


@dataclass(frozen=True)
class Signer:
    """The bootstrap node that answers: its key pair, its packed grant, and the sealed terms of the invitation."""

    identity: Identity
    grant: bytes
    terms: bytes


@dataclass(frozen=True)
class Welcome:
    """What a newcomer is given: its pass, the team's secrets and whom to ask; ``secrets`` are as in ``Membership``."""

    shown: bytes
    secrets: tuple[tuple[int, bytes, int], ...] = field(repr=False)
    contacts: tuple[Contact, ...] = ()


class Reply(NamedTuple):
    """A signed answer: what a newcomer is given, or the code of a refusal; ``terms`` is what the code opened."""

    terms: TermsContent
    said: Welcome | str


class Hint(NamedTuple):
    """An unauthenticated answer: the code of a refusal, which may be anybody's word."""

    code: str


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


def welcome(invitation: bytes, heard: Knock, welcomed: Welcome, signer: Signer, rng: random.Random) -> bytes:
    """Make the WELCOME for a newcomer, with as many contacts as there is room for.

    Raises ``Forged`` where the newcomer's ephemeral key is none.
    """
    contacts = [contact.packed() for contact in welcomed.contacts[:MAX_CONTACTS]]
    secrets = [list(each) for each in welcomed.secrets[:MAX_SECRETS]]
    while True:
        body = _signed(invitation, heard, msgpack.packb([welcomed.shown, secrets, contacts]), signer)
        if len(body) <= MAX_WELCOME or not contacts:
            return _answered(invitation, heard.ephemeral, body, rng)
        contacts.pop()


def refusal(invitation: bytes, heard: Knock, code: str, signer: Signer, rng: random.Random) -> bytes:
    """Make the WELCOME that says no to a newcomer, by a code of ``errors.WHY``."""
    return _answered(invitation, heard.ephemeral, _signed(invitation, heard, msgpack.packb([code]), signer), rng)


def hint(name: bytes, code: str = "") -> bytes:
    """Make the HINT of an id that nobody knows, or of a node that cannot sign; anybody can make it."""
    return bytes([WELCOME]) + name + code.encode()[:MAX_HINT]


def opened_welcome(datagram: bytes, code: Code, public: bytes, ephemeral: bytes) -> Reply | Hint:
    """Read the answer to the KNOCK of the newcomer ``public``; ``ephemeral`` is the secret half of its other key.

    Raises ``Forged`` or ``Malformed``.
    """
    invitation = code.key.public
    if id_of(datagram) != invitation_id(invitation):
        raise Forged("a welcome by another invitation")
    if len(datagram) <= _HEAD + MAX_HINT:
        said = datagram[_HEAD:].decode("ascii", "replace")
        return Hint(said if said in WHY else "unknown")
    body = sealed.opened(datagram[_HEAD:], ephemeral, psk_of(invitation), datagram[:_HEAD])
    try:
        terms, grant, signature, content = msgpack.unpackb(body, max_map_len=0, max_ext_len=0, max_array_len=4)
        found = open_terms(code, terms)
        bootstrap = opened(found.operator, grant)
        if not isinstance(bootstrap, Grant) or BOOTSTRAP not in bootstrap.roles:
            raise Forged("the node that answers is no bootstrap node of the team")
        heard = Knock(public, bindings.crypto_scalarmult_base(ephemeral), "", b"")
        if not verified(bootstrap.public, _covered(invitation, heard, terms, content), sized(signature, 64)):
            raise Forged("an answer that the bootstrap node did not sign")
        return Reply(found, _content(content))
    except (Forged, Malformed):
        raise
    except Exception as error:  # the one place where foreign bytes are unpacked
        raise Malformed("a welcome with other fields than it should have") from error


def _content(packed: bytes) -> Welcome | str:
    fields = msgpack.unpackb(packed, max_map_len=0, max_ext_len=0, max_array_len=MAX_CONTACTS)
    if len(fields) == 1:
        return fields[0] if fields[0] in WHY else "unknown"
    shown, secrets, contacts = fields
    if not isinstance(shown, bytes) or len(shown) > ROOM or not secrets:
        raise Malformed("a welcome without a pass, or without a secret")
    found = tuple((moment(number), sized(secret, SECRET_BYTES), moment(until)) for number, secret, until in secrets)
    return Welcome(shown, found, tuple(contact for each in contacts if (contact := unpacked(each)) is not None))


def _signed(invitation: bytes, heard: Knock, content: bytes, signer: Signer) -> bytes:
    signature = signer.identity.sign(_covered(invitation, heard, signer.terms, content))
    return bytes(msgpack.packb([signer.terms, signer.grant, signature, content]))


def _covered(invitation: bytes, heard: Knock, terms: bytes, content: bytes) -> bytes:
    return _DOMAIN + bytes(msgpack.packb([invitation, heard.public, heard.ephemeral, terms, content]))


def _answered(invitation: bytes, ephemeral: bytes, body: bytes, rng: random.Random) -> bytes:
    head = bytes([WELCOME]) + invitation_id(invitation)
    return head + sealed.sealed(body, ephemeral, psk_of(invitation), head, rng)
