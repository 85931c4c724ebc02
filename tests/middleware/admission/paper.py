"""Build operators, members and signed statements for the tests of admission."""

from __future__ import annotations

import random

from middleware.admission.certificate import chained, pass_of, proof
from middleware.admission.code import Code
from middleware.admission.operator import Operator, drawn
from middleware.admission.roll import Roll
from middleware.admission.statement import Invite, opened
from middleware.entangled.identity import Identity

NOW = 1_800_000_000
LATER = 3600.0


def operator(seed: int = 1, team: str = "yard") -> Operator:
    """Return an operator; the same seed gives the same operator."""
    return drawn(team, random.Random(f"operator {seed}"))


def identity(name: str) -> Identity:
    """Return the key pair that belongs to ``name``."""
    return Identity(random.Random(f"identity {name}").randbytes(32))


def granted(signer: Operator, name: str, *roles: str) -> bytes:
    return signer.grant(identity(name).public, name, roles or ("device",), NOW)


def invited(signer: Operator, name: str = "dog", uses: int = 1, seed: int = 1) -> tuple[Code, bytes, Invite]:
    """Return a join code, the signed invitation for it, and the decoded invitation."""
    code, packed, _ = signer.invite(name, ("device",), uses, NOW, LATER, random.Random(seed))
    invite = opened(signer.public, packed)
    assert isinstance(invite, Invite)
    return code, packed, invite


def admitted(
    signer: Operator, name: str, bootstrap: str = "vaio", wish: str = "", now: int = NOW, seed: int = 1
) -> bytes:
    """Return the certificate chain of a newcomer that the bootstrap node ``bootstrap`` admitted."""
    code, packed, invite = invited(signer, name, seed=seed)
    public = identity(name).public
    grant = granted(signer, bootstrap, "bootstrap")
    came = (public, wish, proof(code.key, public, wish))
    return chained(identity(bootstrap), grant, (packed, invite), came, name, now)


def roll(signer: Operator, *packed: bytes, now: float = NOW) -> Roll:
    made = Roll(signer.public)
    for each in packed:
        made.add(each, now)
    return made


__all__ = ["LATER", "NOW", "admitted", "granted", "identity", "invited", "operator", "pass_of", "roll"]
