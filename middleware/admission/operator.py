"""Operator of a team: sign grants, invitations, revocations and secrets with a key kept in a file outside the nodes.

The holder of the file is the operator.  Without the file, a team cannot invite or revoke members, so keep a copy.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from middleware.admission import keyfile
from middleware.admission.certificate import wrap_grant
from middleware.admission.errors import BadKeyFile
from middleware.admission.join_code import JoinCode, TermsContent, draw_code, seal_terms
from middleware.admission.membership_file import Membership
from middleware.admission.statement import (
    DEFAULT_LIFE_S,
    MAX_KEPT,
    MAX_LIFE_S,
    SECRET_BYTES,
    Grant,
    Invite,
    Revocation,
    Terms,
    check_bytes,
    check_name,
    member_id,
    renewal_id,
    seal_secret,
    sign_statement,
)
from middleware.entangled.errors import RemoteError
from middleware.entangled.identity import Identity

KIND = "swarm-node operator 1"
FIRST_SECRET_NUMBER = 1
FIRST_NODE_ROLES = ("device", "operator", "gateway", "bootstrap")
"""Roles of the first node of a team: all except viewer."""


class Invitation(NamedTuple):
    """A code and the two statements that activate it; publish ``terms`` before ``invite``."""

    code: JoinCode
    invite: bytes
    terms: bytes


@dataclass(frozen=True)
class Operator:
    """The operator of the team named ``team``; all times are seconds of the wall clock.

    ``settings`` are the settings that newcomers receive.
    """

    team: str
    seed: bytes = field(repr=False)
    settings: Mapping[str, str | int | float | bool] = field(default_factory=dict)

    @property
    def identity(self) -> Identity:
        """The key pair that signs statements."""
        return Identity(self.seed)

    @property
    def public(self) -> bytes:
        """The operator's public key, which identifies the team."""
        return self.identity.public

    def grant(self, public: bytes, name: str, roles: Sequence[str], now: float, life: float = DEFAULT_LIFE_S) -> bytes:
        """Sign a certificate for ``public``, valid for ``life`` seconds."""
        return sign_statement(self.identity, Grant(public, name, tuple(roles), int(now), int(now + life)))

    def invite(
        self,
        name: str,
        roles: Sequence[str],
        uses: int,
        now: float,
        expires: float,
        rng: random.Random,
        life: float = DEFAULT_LIFE_S,
    ) -> Invitation:
        """Create a code that admits ``uses`` newcomers within ``expires`` seconds, each for ``life`` seconds.

        Raises ``ValueError`` for values that an invitation cannot have.
        """
        join_code = draw_code(self.public, rng)
        end = int(now + expires)
        invite = Invite(join_code.key.public, name, tuple(roles), uses, int(now), end, int(life))
        sealed_terms = seal_terms(join_code, TermsContent(self.public, self.team, self.settings), rng)
        terms = Terms(join_code.key.public, sealed_terms, int(now), end)
        return Invitation(join_code, sign_statement(self.identity, invite), sign_statement(self.identity, terms))

    def revoke(
        self,
        public: bytes,
        name: str,
        now: float,
        members: Iterable[bytes] = (),
        renewals: Iterable[tuple[bytes, int]] = (),
    ) -> bytes:
        """Revoke the key of a member or of an invitation.

        If the key is a bootstrap node's, ``members`` are the public keys of the members that it admitted and that stay
        members; all other members that it admitted are revoked too.  ``renewals`` are the renewals by this node that
        stay valid, as pairs of key and end.  Raises ``ValueError`` if there are too many.
        """
        ids = (*(member_id(each) for each in members), *(renewal_id(*each) for each in renewals))
        if len(ids) > MAX_KEPT:
            raise ValueError(f"a revocation keeps at most {MAX_KEPT} members and renewals, not {len(ids)}")
        return sign_statement(self.identity, Revocation(public, name, int(now), int(now) + MAX_LIFE_S, ids))

    def rotate_secret(
        self, number: int, members: Iterable[bytes], now: float, grace: float, rng: random.Random
    ) -> bytes:
        """Draw a new team secret for ``members``; the previous one is accepted for ``grace`` seconds."""
        secret = seal_secret(rng.randbytes(SECRET_BYTES), number, members, int(now), int(grace), rng)
        return sign_statement(self.identity, secret)

    def create_membership(
        self, name: str, roles: Sequence[str], now: float, rng: random.Random, secret: bytes | None = None
    ) -> Membership:
        """Return a membership without a code: for the first node, or with the team's ``secret`` for another one."""
        seed = rng.randbytes(32)
        grant = self.grant(Identity(seed).public, name, roles, now)
        first = rng.randbytes(SECRET_BYTES) if secret is None else secret
        return Membership(self.team, seed, self.public, wrap_grant(grant), ((FIRST_SECRET_NUMBER, first, 0),))


def create_operator(team: str, rng: random.Random) -> Operator:
    """Create the operator of a new team; raises ``BadKeyFile`` if ``team`` is not a valid name."""
    try:
        return Operator(check_name(team), rng.randbytes(32))
    except RemoteError as error:
        raise BadKeyFile("the name of a team must have 1 to 40 letters, digits, _ or -") from error


def load_operator(path: Path) -> Operator:
    """Load the operator's key from ``path``; raises ``BadKeyFile``."""
    found: dict[str, Any] = keyfile.read(path)
    try:
        if found["kind"] != KIND:
            raise ValueError("a different kind of file")
        settings = found.get("settings", {})
        if not isinstance(settings, dict):
            raise ValueError("the settings are not a mapping")
        return Operator(check_name(found["team"]), check_bytes(bytes.fromhex(found["seed"]), 32), settings)
    except (KeyError, ValueError, TypeError, RemoteError) as error:
        raise BadKeyFile(f"{path} is not an operator's key ({error}); use the file that swarm init created") from error


def create_operator_file(path: Path, operator: Operator) -> None:
    """Create the file of a new operator; raises ``BadKeyFile``, also if it exists."""
    content = {"kind": KIND, "team": operator.team, "seed": operator.seed.hex(), "settings": dict(operator.settings)}
    keyfile.write(path, content, is_new=True)
