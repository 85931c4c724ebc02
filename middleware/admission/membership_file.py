"""Membership file of a member of a closed team: identity, certificate and team secrets.

The file is secret, because a holder of the file can act as this member.  A file that other users can read is rejected.
The file is replaced when the team's secret is rotated or the operator issues a new grant.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from middleware.admission import keyfile
from middleware.admission.certificate import Member, verify_certificate
from middleware.admission.errors import BadKeyFile
from middleware.admission.membership_list import MAX_SECRETS
from middleware.admission.statement import SECRET_BYTES, check_bytes, check_name, check_number
from middleware.entangled.errors import RemoteError
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address

KIND = "swarm-node membership 1"
MAX_KNOWN_NODES = 64


@dataclass(frozen=True)
class Membership:
    """One member's keys and secrets.

    ``operator`` is the operator's public key.  ``secrets`` are the team's secrets, the newest first.  Each is a tuple
    of its number, the secret, and the wall-clock time until which earlier secrets are accepted.  ``known`` are
    addresses of bootstrap nodes, and ``settings`` the settings that the team gives to each node.
    """

    team: str
    seed: bytes = field(repr=False)
    operator: bytes
    certificate: bytes
    secrets: tuple[tuple[int, bytes, int], ...] = field(repr=False)
    known_nodes: tuple[Address, ...] = ()
    settings: Mapping[str, str | int | float | bool] = field(default_factory=dict)

    @property
    def identity(self) -> Identity:
        """The member's lasting key pair."""
        return Identity(self.seed)

    @property
    def member(self) -> Member:
        """The member described by the certificate; raises ``BadKeyFile`` if the certificate is not of this team."""
        try:
            return verify_certificate(self.operator, self.identity.public, self.certificate)
        except RemoteError as error:
            raise BadKeyFile(f"the certificate in the membership is not of this team: {error}; join again") from error

    def with_secret(self, number: int, secret: bytes, until: int) -> Membership:
        """Return this membership with one more secret; the secrets before it are accepted until ``until``."""
        secrets = [each for each in self.secrets if each[0] != number] + [(number, secret, until)]
        return replace(self, secrets=tuple(sorted(secrets, key=lambda each: -each[0])[:MAX_SECRETS]))

    def list_accepted_secrets(self, now: float) -> list[tuple[int, bytes, int]]:
        """Return the secrets accepted at ``now`` (wall clock), newest first; the newest is always accepted."""
        found: list[tuple[int, bytes, int]] = []
        for each in self.secrets:
            if all(now < until for _, _, until in found):
                found.append(each)
        return found

    def to_json(self) -> dict[str, Any]:
        """Return the content of the file."""
        return {
            "kind": KIND,
            "team": self.team,
            "operator": self.operator.hex(),
            "seed": self.seed.hex(),
            "pass": self.certificate.hex(),
            "secrets": [[number, secret.hex(), until] for number, secret, until in self.secrets],
            "known_nodes": [[address.host, address.port] for address in self.known_nodes],
            "settings": dict(self.settings),
        }


def parse_membership(found: Mapping[str, Any]) -> Membership:
    """Parse the content of a membership file; raises ``BadKeyFile``."""
    try:
        if found["kind"] != KIND:
            raise ValueError("a different kind of file")
        secrets = [
            (check_number(number, 1), check_bytes(bytes.fromhex(secret), SECRET_BYTES), check_number(until))
            for number, secret, until in found["secrets"][:MAX_SECRETS]
        ]
        if not secrets:
            raise ValueError("the team's secret is missing")
        known = [
            Address(str(host), check_number(port, 1, 65535)) for host, port in found["known_nodes"][:MAX_KNOWN_NODES]
        ]
        operator, seed = (
            check_bytes(bytes.fromhex(found["operator"]), 32),
            check_bytes(bytes.fromhex(found["seed"]), 32),
        )
        certificate = bytes.fromhex(found["pass"])
        membership = Membership(
            check_name(found["team"]),
            seed,
            operator,
            certificate,
            tuple(secrets),
            tuple(known),
            dict(found["settings"]),
        )
    except (KeyError, ValueError, TypeError, RemoteError) as error:
        raise BadKeyFile(
            f"the membership is not valid ({error}); join again, or restore the file from a backup"
        ) from error
    # Verify the certificate now and not at the first handshake.
    assert membership.member
    return membership


class MembershipFile:
    """The membership file of one member; ``save`` replaces it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.membership = parse_membership(keyfile.read(path))
        except BadKeyFile as error:
            text = str(error)
            raise error if str(path) in text else BadKeyFile(f"{path}: {text}") from error

    def save(self, membership: Membership) -> None:
        """Write ``membership`` to the file; raises ``BadKeyFile``."""
        if membership != self.membership:
            keyfile.write(self.path, membership.to_json())
            self.membership = membership


class MemoryMembership:
    """A membership in memory, for nodes that are discarded when their process ends."""

    def __init__(self, membership: Membership) -> None:
        self.membership = membership

    def save(self, membership: Membership) -> None:
        """Store ``membership``."""
        self.membership = membership


def create_membership_file(path: Path, membership: Membership) -> None:
    """Create the file of a new member; raise ``BadKeyFile``, also if the file exists."""
    keyfile.write(path, membership.to_json(), is_new=True)


MembershipStore = MembershipFile | MemoryMembership
