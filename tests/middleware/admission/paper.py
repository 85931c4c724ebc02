"""Paper: operators, members and what they sign, for the tests of admission."""

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
    """An operator who is the same for the same seed."""
    return drawn(team, random.Random(f"operator {seed}"))


def identity(name: str) -> Identity:
    """The key pair of whoever is called so."""
    return Identity(random.Random(f"identity {name}").randbytes(32))


def granted(signer: Operator, name: str, *roles: str) -> bytes:
    return signer.grant(identity(name).public, name, roles or ("device",), NOW)


def invited(signer: Operator, name: str = "dog", uses: int = 1, seed: int = 1) -> tuple[Code, bytes, Invite]:
    """A code, the statement that makes it good, and that as it is read."""
    code, packed, _ = signer.invite(name, ("device",), uses, NOW, LATER, random.Random(seed))
    invite = opened(signer.public, packed)
    assert isinstance(invite, Invite)
    return code, packed, invite


def admitted(
    signer: Operator, name: str, bootstrap: str = "vaio", wish: str = "", now: int = NOW, seed: int = 1
) -> bytes:
    """The pass of a newcomer that the bootstrap node of that name let in."""
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
