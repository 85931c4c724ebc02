"""Codecs of the join request (JOIN_REQUEST) and the join reply (JOIN_REPLY, HINT); thesis, Figure 4.5.

::

    JOIN_REQUEST  0x17 | id of the invitation 8 | nonce 24 | encrypted under the invitation's psk, padded to 1400 in all
    JOIN_REPLY    0x18 | id 8 | encrypted to the newcomer's ephemeral key and the psk
    HINT          0x18 | id 8 | the code of a refusal in ASCII, at most 16; unauthenticated

The psk is derived from the invitation's *public* key, which members know from the membership list and the holder of the
code can derive.  A JOIN_REQUEST that decrypts therefore comes from a member or from a holder of the code, and strangers
cannot read it.  The psk does not authenticate the replying node.  Three parts of a JOIN_REPLY do this, because other
members cannot forge them: the encrypted ``terms`` of the invitation, from which only the newcomer learns the operator's
key; the replying node's grant by that operator with the role bootstrap; and that node's signature over the content and
both keys of the newcomer.  A JOIN_REPLY is never longer than its JOIN_REQUEST.  The modules ``join_client`` and
``server`` implement the two sides.
"""

from __future__ import annotations

import hashlib
import random
from dataclasses import dataclass, field
from typing import NamedTuple

import msgpack
from nacl import bindings
from nacl.exceptions import CryptoError

from middleware.admission import sealed_box
from middleware.admission.certificate import BOOTSTRAP, MAX_CERTIFICATE_BYTES, sign_join
from middleware.admission.errors import REFUSAL_TEXTS
from middleware.admission.join_code import JoinCode, TermsContent, open_terms
from middleware.admission.membership_list import INVITATION_ID_BYTES, invitation_id
from middleware.admission.statement import SECRET_BYTES, Grant, check_bytes, check_name, check_number, open_statement
from middleware.entangled.contact import Contact, parse_contact
from middleware.entangled.errors import Forged, Malformed
from middleware.entangled.identity import Identity, is_signature_valid
from middleware.entangled.network.network import MAX_DATAGRAM_BYTES

JOIN_REQUEST, JOIN_REPLY = 0x17, 0x18
JOIN_REQUEST_BYTES = MAX_DATAGRAM_BYTES
MAX_CONTACTS = 8
MAX_SECRETS = 2
_NONCE_BYTES, _TAG_BYTES = 24, 16
_HEAD_BYTES = 1 + INVITATION_ID_BYTES
_BODY_BYTES = JOIN_REQUEST_BYTES - _HEAD_BYTES - _NONCE_BYTES - _TAG_BYTES
MAX_REPLY_BODY_BYTES = JOIN_REQUEST_BYTES - _HEAD_BYTES - sealed_box.OVERHEAD_BYTES
MAX_REFUSAL_CODE_BYTES = 16
_DOMAIN = b"swarm-welcome-1 "


@dataclass(frozen=True)
class JoinRequest:
    """A join request: newcomer's key, ephemeral key for the reply, requested name, and the invitation's proof."""

    public: bytes
    ephemeral: bytes
    requested_name: str
    proof: bytes


@dataclass(frozen=True)
class Signer:
    """The replying bootstrap node: its key pair, its packed grant, and the encrypted terms of the invitation."""

    identity: Identity
    grant: bytes
    terms: bytes


@dataclass(frozen=True)
class JoinReply:
    """Content of a join reply: certificate, team secrets and contacts; ``secrets`` are as in ``Membership``."""

    certificate: bytes
    secrets: tuple[tuple[int, bytes, int], ...] = field(repr=False)
    contacts: tuple[Contact, ...] = ()


class VerifiedReply(NamedTuple):
    """A signed reply: the content of a join reply or the code of a refusal, with the decrypted terms."""

    terms: TermsContent
    content: JoinReply | str


class UnsignedRefusal(NamedTuple):
    """An unauthenticated reply with the code of a refusal; any node can forge it."""

    code: str


def derive_psk(invitation: bytes) -> bytes:
    """Return the pre-shared key of members and code holders; ``invitation`` is the invitation's public key."""
    return hashlib.blake2s(invitation, person=b"knock").digest()


def make_request(
    invitation: Identity, public: bytes, ephemeral: bytes, requested_name: str, rng: random.Random
) -> bytes:
    """Return the JOIN_REQUEST of the newcomer ``public`` that asks for the name ``requested_name`` (empty: any)."""
    signature = sign_join(invitation, public, requested_name)
    body = msgpack.packb([public, ephemeral, requested_name, signature]).ljust(_BODY_BYTES, b"\0")
    head, nonce = bytes([JOIN_REQUEST]) + invitation_id(invitation.public), rng.randbytes(_NONCE_BYTES)
    key = derive_psk(invitation.public)
    return head + nonce + bindings.crypto_aead_xchacha20poly1305_ietf_encrypt(body, head, nonce, key)


def read_invitation_id(datagram: bytes) -> bytes:
    """Return the invitation id in a JOIN_REQUEST or JOIN_REPLY; raises ``Malformed``."""
    is_request = datagram[:1] == bytes([JOIN_REQUEST])
    if len(datagram) < _HEAD_BYTES or (is_request and len(datagram) != JOIN_REQUEST_BYTES):
        raise Malformed(f"the join datagram has a wrong length, {len(datagram)} bytes")
    return datagram[1:_HEAD_BYTES]


def open_request(datagram: bytes, invitation: bytes) -> JoinRequest:
    """Decrypt a JOIN_REQUEST under the invitation with that public key; raises ``Forged`` or ``Malformed``.

    The caller verifies the proof.
    """
    read_invitation_id(datagram)
    head, nonce = datagram[:_HEAD_BYTES], datagram[_HEAD_BYTES : _HEAD_BYTES + _NONCE_BYTES]
    try:
        body = bindings.crypto_aead_xchacha20poly1305_ietf_decrypt(
            datagram[_HEAD_BYTES + _NONCE_BYTES :], head, nonce, derive_psk(invitation)
        )
    except (CryptoError, ValueError) as error:
        raise Forged("the join request cannot be decrypted") from error
    unpacker = msgpack.Unpacker(max_buffer_size=_BODY_BYTES, max_map_len=0, max_ext_len=0, max_array_len=4)
    unpacker.feed(body)
    try:
        public, ephemeral, requested_name, signature = unpacker.unpack()
    except Exception as error:  # untrusted bytes
        raise Malformed("the join request has invalid fields") from error
    return JoinRequest(
        check_bytes(public, 32),
        check_bytes(ephemeral, 32),
        requested_name if requested_name == "" else check_name(requested_name),
        check_bytes(signature, 64),
    )


def make_reply(invitation: bytes, request: JoinRequest, reply: JoinReply, signer: Signer, rng: random.Random) -> bytes:
    """Return the JOIN_REPLY for a newcomer, with as many contacts as fit.

    Raises ``Forged`` if the newcomer's ephemeral key is not valid.
    """
    contacts = [contact.pack() for contact in reply.contacts[:MAX_CONTACTS]]
    secrets = [list(each) for each in reply.secrets[:MAX_SECRETS]]
    while True:
        body = _sign_body(invitation, request, msgpack.packb([reply.certificate, secrets, contacts]), signer)
        if len(body) <= MAX_REPLY_BODY_BYTES or not contacts:
            return _encrypt_reply(invitation, request.ephemeral, body, rng)
        contacts.pop()


def make_refusal(invitation: bytes, request: JoinRequest, code: str, signer: Signer, rng: random.Random) -> bytes:
    """Return the JOIN_REPLY that rejects a newcomer with a code of ``errors.REFUSAL_TEXTS``."""
    body = _sign_body(invitation, request, msgpack.packb([code]), signer)
    return _encrypt_reply(invitation, request.ephemeral, body, rng)


def make_unsigned_refusal(name: bytes, code: str = "") -> bytes:
    """Return the HINT for an unknown invitation id, or from a node that cannot sign; unauthenticated."""
    return bytes([JOIN_REPLY]) + name + code.encode()[:MAX_REFUSAL_CODE_BYTES]


def open_reply(datagram: bytes, code: JoinCode, public: bytes, ephemeral: bytes) -> VerifiedReply | UnsignedRefusal:
    """Parse and verify the reply to the request of ``public``; ``ephemeral`` is the secret half of its ephemeral key.

    Raises ``Forged`` or ``Malformed``.
    """
    invitation = code.key.public
    if read_invitation_id(datagram) != invitation_id(invitation):
        raise Forged("the join reply is for a different invitation")
    if len(datagram) <= _HEAD_BYTES + MAX_REFUSAL_CODE_BYTES:
        refusal_code = datagram[_HEAD_BYTES:].decode("ascii", "replace")
        return UnsignedRefusal(refusal_code if refusal_code in REFUSAL_TEXTS else "unknown")
    body = sealed_box.unseal(datagram[_HEAD_BYTES:], ephemeral, derive_psk(invitation), datagram[:_HEAD_BYTES])
    try:
        terms, grant, signature, content = msgpack.unpackb(body, max_map_len=0, max_ext_len=0, max_array_len=4)
        found = open_terms(code, terms)
        bootstrap = open_statement(found.operator, grant)
        if not isinstance(bootstrap, Grant) or BOOTSTRAP not in bootstrap.roles:
            raise Forged("the replying node is not a bootstrap node of the team")
        request = JoinRequest(public, bindings.crypto_scalarmult_base(ephemeral), "", b"")
        if not is_signature_valid(
            bootstrap.public, _signed_content(invitation, request, terms, content), check_bytes(signature, 64)
        ):
            raise Forged("the signature of the join reply is not valid")
        return VerifiedReply(found, _parse_content(content))
    except (Forged, Malformed):
        raise
    except Exception as error:  # untrusted bytes
        raise Malformed("the join reply has invalid fields") from error


def _parse_content(packed: bytes) -> JoinReply | str:
    fields = msgpack.unpackb(packed, max_map_len=0, max_ext_len=0, max_array_len=MAX_CONTACTS)
    if len(fields) == 1:
        return fields[0] if fields[0] in REFUSAL_TEXTS else "unknown"
    certificate, secrets, contacts = fields
    if not isinstance(certificate, bytes) or len(certificate) > MAX_CERTIFICATE_BYTES or not secrets:
        raise Malformed("the join reply has no certificate or no secret")
    found = tuple(
        (check_number(number), check_bytes(secret, SECRET_BYTES), check_number(until))
        for number, secret, until in secrets
    )
    return JoinReply(
        certificate, found, tuple(contact for each in contacts if (contact := parse_contact(each)) is not None)
    )


def _sign_body(invitation: bytes, request: JoinRequest, content: bytes, signer: Signer) -> bytes:
    signature = signer.identity.sign(_signed_content(invitation, request, signer.terms, content))
    return bytes(msgpack.packb([signer.terms, signer.grant, signature, content]))


def _signed_content(invitation: bytes, request: JoinRequest, terms: bytes, content: bytes) -> bytes:
    return _DOMAIN + bytes(msgpack.packb([invitation, request.public, request.ephemeral, terms, content]))


def _encrypt_reply(invitation: bytes, ephemeral: bytes, body: bytes, rng: random.Random) -> bytes:
    head = bytes([JOIN_REPLY]) + invitation_id(invitation)
    return head + sealed_box.seal(body, ephemeral, derive_psk(invitation), head, rng)
