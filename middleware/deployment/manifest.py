"""Manifest: an operator's signed word on one module, and which of two words holds; pure.

A manifest is a small team record of the operator; its name is the module's.  The source lies under a key of its own,
made of its digest, so whoever trusts the manifest can trust the source, wherever it comes from.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass

import msgpack

from middleware.consensus.deployed import KINDS
from middleware.entangled.record import Record, hashed_key
from middleware.entangled.value import bounded, is_whole, mapping_of

DEPLOYMENTS = "deployments"
NAME = r"[a-z][a-z0-9_-]{0,31}"
MAX_SOURCE = 256 * 1024
"""Bytes of a module's source; a strategy has a few thousand."""
MAX_VERSION = 10**9
KEPT = 4
"""Versions that a manifest remembers beside its own, to go back to."""


@dataclass(frozen=True)
class Edition:
    """One version's content: the ``digest`` is the SHA-256 of the source in hex, ``size`` its bytes."""

    version: int
    digest: str
    size: int


@dataclass(frozen=True)
class Manifest:
    """Which edition of the module ``name`` is to run, and which were before it, the newest first.

    ``withdrawn`` is the highest version that was taken back, 0 where none was.
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
        """What decides between two manifests of one name: the higher holds.

        A higher version holds; to go back from a version holds against that version, and loses against any higher one.
        So an old word that comes again changes nothing.
        """
        return (max(self.version, self.withdrawn), -self.version)

    @property
    def edition(self) -> Edition:
        """The edition that is to run."""
        return Edition(self.version, self.digest, self.size)

    @property
    def label(self) -> str:
        """Version and the beginning of the digest, as devices report them."""
        return f"{self.version} {self.digest[:8]}"

    def packed(self) -> bytes:
        """The value of the manifest's record."""
        content = asdict(self)
        content["digest"] = bytes.fromhex(self.digest)
        content["before"] = [[e.version, bytes.fromhex(e.digest), e.size] for e in self.before]
        return bounded(bytes(msgpack.packb(content)))


def digest_of(source: bytes) -> str:
    """The SHA-256 of a source, in hex."""
    return hashlib.sha256(source).hexdigest()


def source_key(digest: str) -> str:
    """The text of the key under which the source with ``digest`` lies."""
    return f"deployment/{digest}"


def manifests_key() -> bytes:
    """The key under which all manifests of a team lie."""
    return hashed_key(DEPLOYMENTS)


def newest(manifests: Iterable[Manifest]) -> Manifest | None:
    """The manifest that holds among several of one name."""
    return max(manifests, key=lambda manifest: (manifest.rank, manifest.digest), default=None)


def pushed(name: str, kind: str, source: bytes, held: Manifest | None, version: int | None = None) -> Manifest:
    """The manifest of a new version, after ``held``; without a ``version``, of the next one."""
    if held is None:
        return Manifest(name, kind, 1 if version is None else version, digest_of(source), len(source))
    following = held.rank[0] + 1 if version is None else version
    before = (held.edition, *held.before)[:KEPT]
    return Manifest(name, kind, following, digest_of(source), len(source), before, held.withdrawn)


def rolled_back(held: Manifest) -> Manifest | None:
    """The manifest that goes back to the version before ``held``, or None where there is none before it."""
    if not held.before:
        return None
    edition, rest = held.before[0], held.before[1:]
    return Manifest(held.name, held.kind, edition.version, edition.digest, edition.size, rest, held.rank[0])


def manifest_of(record: Record) -> Manifest | None:
    """The manifest in a record, or None where its value is none; never raises.

    It says nothing of who may push, nor of the signature.
    """
    content = mapping_of(record)
    if content is None:
        return None
    name, kind, before = content.get("name"), content.get("kind"), content.get("before")
    edition = _edition([content.get("version"), content.get("digest"), content.get("size")])
    withdrawn = content.get("withdrawn")
    if not isinstance(name, str) or name != record.name or not re.fullmatch(NAME, name, re.ASCII) or kind not in KINDS:
        return None
    if not isinstance(withdrawn, int) or not is_whole(withdrawn) or withdrawn > MAX_VERSION:
        return None
    if edition is None or not isinstance(before, list):
        return None
    editions = [_edition(fields) for fields in before[:KEPT]]
    lawful = tuple(each for each in editions if each is not None)
    if len(lawful) != len(editions) or any(each.version >= edition.version for each in lawful):
        return None
    return Manifest(name, kind, edition.version, edition.digest, edition.size, lawful, withdrawn)


def _edition(fields: object) -> Edition | None:
    if not isinstance(fields, list) or len(fields) != 3:
        return None
    version, digest, size = fields
    lawful = is_whole(version) and 0 < version <= MAX_VERSION and is_whole(size)
    return Edition(version, digest.hex(), size) if lawful and isinstance(digest, bytes) and len(digest) == 32 else None
