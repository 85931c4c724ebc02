"""Manifests: an operator's signed descriptions of pushed modules, and the order of manifests with one name.  Pure.

A manifest is a small team record of the operator, with the name of the module.  The source is stored under a separate
key derived from its digest, so a node that trusts the manifest can accept the source from any node.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass

import msgpack

from middleware.consensus.deployed_modules import KINDS
from middleware.entangled.record import Record, hash_key
from middleware.entangled.value import check_size, is_natural, parse_mapping

DEPLOYMENTS = "deployments"
NAME_PATTERN = r"[a-z][a-z0-9_-]{0,31}"
MAX_SOURCE_BYTES = 256 * 1024
"""Maximum size of a module's source in bytes; a strategy has a few thousand bytes."""
MAX_VERSION = 10**9
MAX_PREVIOUS_EDITIONS = 4
"""Number of previous versions that a manifest lists for a rollback."""


@dataclass(frozen=True)
class Edition:
    """The content of one version: ``digest`` is the SHA-256 of the source in hex, ``size`` its number of bytes."""

    version: int
    digest: str
    size: int


@dataclass(frozen=True)
class Manifest:
    """The edition of the module ``name`` to run, and the previous editions, the newest first.

    ``withdrawn`` is the highest version that was rolled back, 0 if none was.
    """

    name: str
    kind: str
    version: int
    digest: str
    size: int
    before: tuple[Edition, ...] = ()
    withdrawn: int = 0

    @property
    def rank(self) -> tuple[int, int]:
        """The sort key of the manifests with one name: the manifest with the highest key is valid.

        A higher version has a higher key.  The key of a rollback is above the key of the version that it withdraws, and
        below the key of any higher version.  So a replayed old manifest has no effect.
        """
        return (max(self.version, self.withdrawn), -self.version)

    @property
    def edition(self) -> Edition:
        """The edition to run."""
        return Edition(self.version, self.digest, self.size)

    @property
    def label(self) -> str:
        """Version and first digits of the digest, as devices report them."""
        return f"{self.version} {self.digest[:8]}"

    def pack(self) -> bytes:
        """Return the value of the manifest's record."""
        content = asdict(self)
        content["digest"] = bytes.fromhex(self.digest)
        content["before"] = [[e.version, bytes.fromhex(e.digest), e.size] for e in self.before]
        return check_size(bytes(msgpack.packb(content)))


def compute_digest(source: bytes) -> str:
    """Return the SHA-256 of a source, in hex."""
    return hashlib.sha256(source).hexdigest()


def source_key(digest: str) -> str:
    """Return the text of the key of the source with ``digest``."""
    return f"deployment/{digest}"


def manifests_key() -> bytes:
    """Return the key of all manifests of a team."""
    return hash_key(DEPLOYMENTS)


def find_newest(manifests: Iterable[Manifest]) -> Manifest | None:
    """Return the one manifest that is valid among several with the same name."""
    return max(manifests, key=lambda manifest: (manifest.rank, manifest.digest), default=None)


def make_next_manifest(
    name: str, kind: str, source: bytes, held: Manifest | None, version: int | None = None
) -> Manifest:
    """Return the manifest of a new version after ``held``; ``version`` defaults to the next number."""
    if held is None:
        return Manifest(name, kind, 1 if version is None else version, compute_digest(source), len(source))
    following = held.rank[0] + 1 if version is None else version
    before = (held.edition, *held.before)[:MAX_PREVIOUS_EDITIONS]
    return Manifest(name, kind, following, compute_digest(source), len(source), before, held.withdrawn)


def make_rollback(held: Manifest) -> Manifest | None:
    """Return the manifest that rolls ``held`` back to the previous version, or None if there is none."""
    if not held.before:
        return None
    edition, rest = held.before[0], held.before[1:]
    return Manifest(held.name, held.kind, edition.version, edition.digest, edition.size, rest, held.rank[0])


def parse_manifest(record: Record) -> Manifest | None:
    """Return the manifest in a record, or None if its value is not a valid manifest; never raises.

    The signature and the author's permission are not checked.
    """
    content = parse_mapping(record)
    if content is None:
        return None
    name, kind, before = content.get("name"), content.get("kind"), content.get("before")
    edition = _parse_edition([content.get("version"), content.get("digest"), content.get("size")])
    withdrawn = content.get("withdrawn")
    if (
        not isinstance(name, str)
        or name != record.name
        or not re.fullmatch(NAME_PATTERN, name, re.ASCII)
        or kind not in KINDS
    ):
        return None
    if not isinstance(withdrawn, int) or not is_natural(withdrawn) or withdrawn > MAX_VERSION:
        return None
    if edition is None or not isinstance(before, list):
        return None
    editions = [_parse_edition(fields) for fields in before[:MAX_PREVIOUS_EDITIONS]]
    valid = tuple(each for each in editions if each is not None)
    if len(valid) != len(editions) or any(each.version >= edition.version for each in valid):
        return None
    return Manifest(name, kind, edition.version, edition.digest, edition.size, valid, withdrawn)


def _parse_edition(fields: object) -> Edition | None:
    if not isinstance(fields, list) or len(fields) != 3:
        return None
    version, digest, size = fields
    valid = is_natural(version) and 0 < version <= MAX_VERSION and is_natural(size)
    return Edition(version, digest.hex(), size) if valid and isinstance(digest, bytes) and len(digest) == 32 else None
