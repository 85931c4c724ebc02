"""Tests of section 8 of ``docs/reference/wire-protocol.md``, byte for byte, with fixed keys."""

from __future__ import annotations

import json
import random
from pathlib import Path

from nacl import bindings
from twisted.trial.unittest import SynchronousTestCase

from middleware.admission import join_codec
from middleware.admission.certificate import (
    issue_certificate,
    issue_guest_certificate,
    renew_certificate,
    sign_join,
    verify_certificate,
    wrap_grant,
)
from middleware.admission.join_code import JoinCode, TermsContent, seal_terms
from middleware.admission.membership_list import compute_digest, pack_admission
from middleware.admission.statement import DEFAULT_LIFE_S, Grant, Invite, Revocation, Terms, seal_secret, sign_statement
from middleware.entangled.contact import Contact
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address

VECTORS = Path(__file__).parents[1] / "vectors" / "admission.json"
NOW = 1_800_000_000


class Counted(random.Random):
    """A random generator that returns increasing bytes, for the ephemeral keys and nonces of the test vectors."""

    def randbytes(self, n: int) -> bytes:
        return bytes(range(n))


def made() -> dict[str, str]:
    """Return all vectors in hexadecimal, and the code as text."""
    operator, vaio, dog, phone = (Identity(bytes([number]) * 32) for number in (1, 2, 3, 4))
    code, dice = JoinCode(0x123456789ABCDEF0123, 0x7D3A1), Counted()
    grant = sign_statement(operator, Grant(vaio.public, "vaio", ("gateway", "bootstrap"), NOW, NOW + 1000))
    invite = Invite(code.key.public, "dog", ("device",), 2, NOW, NOW + 100, 500)
    packed = sign_statement(operator, invite)
    secret = seal_secret(b"s" * 32, 2, [vaio.public], NOW, 60, dice)
    came = (dog.public, "rex", sign_join(code.key, dog.public, "rex"))
    chain = issue_certificate(vaio, grant, (packed, invite), came, "rex", NOW + 1)
    boot = Identity(bytes([5]) * 32)
    anchor = sign_statement(operator, Grant(boot.public, "boot", ("bootstrap",), NOW, NOW + DEFAULT_LIFE_S))
    lasting = sign_statement(operator, Grant(vaio.public, "vaio", ("gateway",), NOW, NOW + DEFAULT_LIFE_S))
    held = verify_certificate(operator.public, vaio.public, wrap_grant(lasting))
    whole_year = Invite(code.key.public, "dog", ("device",), 2, NOW, NOW + 100, DEFAULT_LIFE_S)
    by_code = issue_certificate(vaio, grant, (sign_statement(operator, whole_year), whole_year), came, "rex", NOW + 1)
    came_in = verify_certificate(operator.public, dog.public, by_code)
    ephemeral = b"e" * 32
    shared = bindings.crypto_scalarmult_base(ephemeral)
    contact = Contact(vaio.public, Address("10.0.0.1", 7000))
    sealed = seal_terms(code, TermsContent(operator.public, "yard", {"lan": True}), dice)
    given = join_codec.JoinReply(chain, ((2, b"s" * 32, NOW + 60),), (contact,))
    signer, heard = join_codec.Signer(vaio, grant, sealed), join_codec.JoinRequest(dog.public, shared, "rex", b"")
    found = {
        "grant": grant,
        "invitation": packed,
        "revocation": sign_statement(operator, Revocation(dog.public, "rex", NOW, NOW + 2000)),
        "secret": sign_statement(operator, secret),
        "pass by the operator": wrap_grant(grant),
        "pass by a code": chain,
        "pass of a guest": issue_guest_certificate(vaio, wrap_grant(grant), phone.public, "phone", NOW),
        "renewed pass by the operator": renew_certificate(boot, anchor, held, wrap_grant(lasting), NOW + 9),
        "renewed pass by a code": renew_certificate(boot, anchor, came_in, by_code, NOW + 9),
        "admission": pack_admission(dog.public, chain),
        "digest of the admission": compute_digest(pack_admission(dog.public, chain)),
        "JOIN_REQUEST": join_codec.make_request(code.key, dog.public, shared, "rex", dice),
        "terms": sign_statement(operator, Terms(code.key.public, sealed, NOW, NOW + 100)),
        "JOIN_REPLY": join_codec.make_reply(code.key.public, heard, given, signer, dice),
        "JOIN_REPLY that refuses": join_codec.make_refusal(code.key.public, heard, "used", signer, dice),
    }
    return {"code": code.text, **{name: whole.hex() for name, whole in found.items()}}


class VectorTests(SynchronousTestCase):
    def test_made_again(self) -> None:
        """Code, statements, certificate chains and both datagrams match the vectors byte for byte."""
        self.assertEqual(made(), json.loads(VECTORS.read_text(encoding="utf-8")))


if __name__ == "__main__":
    VECTORS.write_text(json.dumps(made(), indent=1) + "\n", encoding="utf-8")
