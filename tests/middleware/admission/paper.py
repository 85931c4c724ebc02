"""Build operators, members and signed statements for the tests of admission."""

from __future__ import annotations

import random

from middleware.admission.certificate import issue_certificate, sign_join, wrap_grant
from middleware.admission.join_code import JoinCode
from middleware.admission.membership_list import MembershipList
from middleware.admission.operator import Operator, create_operator
from middleware.admission.statement import Invite, open_statement
from middleware.entangled.identity import Identity

NOW = 1_800_000_000
LATER = 3600.0


def operator(seed: int = 1, team: str = "yard") -> Operator:
    """Return an operator; the same seed gives the same operator."""
    return create_operator(team, random.Random(f"operator {seed}"))


def identity(name: str) -> Identity:
    """Return the key pair that belongs to ``name``."""
    return Identity(random.Random(f"identity {name}").randbytes(32))


def granted(signer: Operator, name: str, *roles: str) -> bytes:
    return signer.grant(identity(name).public, name, roles or ("device",), NOW)


def invited(signer: Operator, name: str = "dog", uses: int = 1, seed: int = 1) -> tuple[JoinCode, bytes, Invite]:
    """Return a join code, the signed invitation for it, and the decoded invitation."""
    code, packed, _ = signer.invite(name, ("device",), uses, NOW, LATER, random.Random(seed))
    invite = open_statement(signer.public, packed)
    assert isinstance(invite, Invite)
    return code, packed, invite


def admitted(
    signer: Operator, name: str, bootstrap: str = "vaio", wish: str = "", now: int = NOW, seed: int = 1
) -> bytes:
    """Return the certificate chain of a newcomer that the node ``bootstrap`` admitted."""
    code, packed, invite = invited(signer, name, seed=seed)
    public = identity(name).public
    grant = granted(signer, bootstrap, "bootstrap")
    came = (public, wish, sign_join(code.key, public, wish))
    return issue_certificate(identity(bootstrap), grant, (packed, invite), came, name, now)


def make_list(signer: Operator, *packed: bytes, now: float = NOW) -> MembershipList:
    made = MembershipList(signer.public)
    for each in packed:
        made.add(each, now)
    return made


__all__ = ["LATER", "NOW", "admitted", "granted", "identity", "invited", "operator", "wrap_grant", "make_list"]
