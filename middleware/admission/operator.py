"""Operator: who signs for a team, with a key that lies in a file outside the nodes.

Whoever has the file is the operator; who has lost it cannot invite or revoke any more, so keep a copy of it.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from middleware.admission import code, keyfile
from middleware.admission.certificate import pass_of
from middleware.admission.errors import BadKeyFile
from middleware.admission.membership import Membership
from middleware.admission.statement import (
    MAX_LIFE,
    SECRET_BYTES,
    Grant,
    Invite,
    Revoke,
    named,
    sealed_secret,
    signed,
    sized,
)
from middleware.entangled.errors import RemoteError
from middleware.entangled.identity import Identity

KIND = "swarm-node operator 1"
YEAR = 365 * 86_400
FIRST_SECRET = 1
FIRST = ("device", "operator", "gateway", "bootstrap")
"""What the first node of a team may do: everything."""


@dataclass(frozen=True)
class Operator:
    """The operator of the team that people call ``team``; all moments are seconds of the wall clock."""

    team: str
    seed: bytes = field(repr=False)

    @property
    def identity(self) -> Identity:
        """The key pair that signs."""
        return Identity(self.seed)

    @property
    def public(self) -> bytes:
        """The team's name for programs."""
        return self.identity.public

    def grant(self, public: bytes, name: str, roles: Sequence[str], now: float, life: float = YEAR) -> bytes:
        """The certificate of the holder of ``public``, for ``life`` seconds."""
        return signed(self.identity, Grant(public, name, tuple(roles), int(now), int(now + life)))

    def invite(
        self,
        name: str,
        roles: Sequence[str],
        uses: int,
        now: float,
        expires: float,
        rng: random.Random,
        life: float = YEAR,
    ) -> tuple[code.Code, bytes]:
        """A code that lets in ``uses`` newcomers within ``expires`` seconds, and the statement that makes it so."""
        drawn = code.drawn(self.public, rng)
        invite = Invite(drawn.key.public, name, tuple(roles), uses, int(now), int(now + expires), int(life))
        return drawn, signed(self.identity, invite)

    def revoke(self, public: bytes, name: str, now: float) -> bytes:
        """The end of a member's key or of an invitation's."""
        return signed(self.identity, Revoke(public, name, int(now), int(now) + MAX_LIFE))

    def rotate(self, number: int, members: Iterable[bytes], now: float, grace: float, rng: random.Random) -> bytes:
        """A new secret of the team, for those ``members``; the one before it is accepted for ``grace`` seconds."""
        secret = sealed_secret(rng.randbytes(SECRET_BYTES), number, members, int(now), int(grace), rng)
        return signed(self.identity, secret)

    def founded(
        self, name: str, roles: Sequence[str], now: float, rng: random.Random, secret: bytes | None = None
    ) -> Membership:
        """The membership of a team's first node, or with the team's ``secret`` of any that needs no code."""
        seed = rng.randbytes(32)
        grant = self.grant(Identity(seed).public, name, roles, now)
        first = rng.randbytes(SECRET_BYTES) if secret is None else secret
        return Membership(self.team, seed, self.public, pass_of(grant), ((FIRST_SECRET, first, 0),))


def drawn(team: str, rng: random.Random) -> Operator:
    """The operator of a new team; raises ``BadKeyFile`` for a name that a team cannot have."""
    try:
        return Operator(named(team), rng.randbytes(32))
    except RemoteError as error:
        raise BadKeyFile("a team's name has 1 to 40 letters, digits, _ or -") from error


def load(path: Path) -> Operator:
    """The operator whose key the file at ``path`` holds; raises ``BadKeyFile``."""
    found: dict[str, Any] = keyfile.read(path)
    try:
        if found["kind"] != KIND:
            raise ValueError("another kind of file")
        return Operator(named(found["team"]), sized(bytes.fromhex(found["seed"]), 32))
    except (KeyError, ValueError, TypeError, RemoteError) as error:
        raise BadKeyFile(f"{path} is no operator's key ({error}); name the file that swarm init made") from error


def made(path: Path, operator: Operator) -> None:
    """Make the file of a new operator; raises ``BadKeyFile``, also where there is one already."""
    keyfile.write(path, {"kind": KIND, "team": operator.team, "seed": operator.seed.hex()}, is_new=True)
