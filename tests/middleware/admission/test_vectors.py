"""Tests of section 8 of ``docs/reference/wire-protocol.md``, byte for byte, with fixed keys."""

from __future__ import annotations

import json
import random
from pathlib import Path

from nacl import bindings
from twisted.trial.unittest import SynchronousTestCase

from middleware.admission import knock
from middleware.admission.certificate import chained, guest_pass, member_of, pass_of, proof, renewed
from middleware.admission.code import Code, TermsContent, seal_terms
from middleware.admission.roll import digest_of, packed_admission
from middleware.admission.statement import YEAR, Grant, Invite, Revoke, Terms, sealed_secret, signed
from middleware.entangled.contact import Contact
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address

VECTORS = Path(__file__).parents[1] / "vectors" / "admission.json"
NOW = 1_800_000_000


class Counted(random.Random):
    """A random generator that returns increasing bytes, for the ephemeral keys and nonces of the vectors."""

    def randbytes(self, n: int) -> bytes:
        return bytes(range(n))


def made() -> dict[str, str]:
    """Return all vectors in hexadecimal, and the code as text."""
    operator, vaio, dog, phone = (Identity(bytes([number]) * 32) for number in (1, 2, 3, 4))
    code, dice = Code(0x123456789ABCDEF0123, 0x7D3A1), Counted()
    grant = signed(operator, Grant(vaio.public, "vaio", ("gateway", "bootstrap"), NOW, NOW + 1000))
    invite = Invite(code.key.public, "dog", ("device",), 2, NOW, NOW + 100, 500)
    packed = signed(operator, invite)
    secret = sealed_secret(b"s" * 32, 2, [vaio.public], NOW, 60, dice)
    came = (dog.public, "rex", proof(code.key, dog.public, "rex"))
    chain = chained(vaio, grant, (packed, invite), came, "rex", NOW + 1)
    boot = Identity(bytes([5]) * 32)
    anchor = signed(operator, Grant(boot.public, "boot", ("bootstrap",), NOW, NOW + YEAR))
    lasting = signed(operator, Grant(vaio.public, "vaio", ("gateway",), NOW, NOW + YEAR))
    held = member_of(operator.public, vaio.public, pass_of(lasting))
    whole_year = Invite(code.key.public, "dog", ("device",), 2, NOW, NOW + 100, YEAR)
    by_code = chained(vaio, grant, (signed(operator, whole_year), whole_year), came, "rex", NOW + 1)
    came_in = member_of(operator.public, dog.public, by_code)
    ephemeral = b"e" * 32
    shared = bindings.crypto_scalarmult_base(ephemeral)
    contact = Contact(vaio.public, Address("10.0.0.1", 7000))
    sealed = seal_terms(code, TermsContent(operator.public, "yard", {"lan": True}), dice)
    given = knock.Welcome(chain, ((2, b"s" * 32, NOW + 60),), (contact,))
    signer, heard = knock.Signer(vaio, grant, sealed), knock.Knock(dog.public, shared, "rex", b"")
    found = {
        "grant": grant,
        "invitation": packed,
        "revocation": signed(operator, Revoke(dog.public, "rex", NOW, NOW + 2000)),
        "secret": signed(operator, secret),
        "pass by the operator": pass_of(grant),
        "pass by a code": chain,
        "pass of a guest": guest_pass(vaio, pass_of(grant), phone.public, "phone", NOW),
        "renewed pass by the operator": renewed(boot, anchor, held, pass_of(lasting), NOW + 9),
        "renewed pass by a code": renewed(boot, anchor, came_in, by_code, NOW + 9),
        "admission": packed_admission(dog.public, chain),
        "digest of the admission": digest_of(packed_admission(dog.public, chain)),
        "KNOCK": knock.knock(code.key, dog.public, shared, "rex", dice),
        "terms": signed(operator, Terms(code.key.public, sealed, NOW, NOW + 100)),
        "WELCOME": knock.welcome(code.key.public, heard, given, signer, dice),
        "WELCOME that refuses": knock.refusal(code.key.public, heard, "used", signer, dice),
    }
    return {"code": code.text, **{name: whole.hex() for name, whole in found.items()}}


class VectorTests(SynchronousTestCase):
    def test_made_again(self) -> None:
        """Code, statements, certificate chains and both datagrams match the vectors byte for byte."""
        self.assertEqual(made(), json.loads(VECTORS.read_text(encoding="utf-8")))


if __name__ == "__main__":
    VECTORS.write_text(json.dumps(made(), indent=1) + "\n", encoding="utf-8")
