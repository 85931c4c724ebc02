"""Deployment: one node's acceptance of what its operators push; off where the owner has not allowed it.

In this order: is the module listed, is its operator, is the signature good, is it newer than what is held, is the
source what was signed, does it load and conform.  Nothing foreign runs before the signature and the lists are checked.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import msgpack
from twisted.internet.defer import Deferred
from twisted.logger import Logger

from middleware.deployed import Make
from middleware.deployment.manifest import MAX_SOURCE, Manifest, digest_of, manifest_of, manifests_key, source_key
from middleware.deployment.module import loaded
from middleware.deployment.shelf import Shelf
from middleware.entangled.errors import EntangledError, NotRunning
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, hashed_key, unpacked
from middleware.errors import Undeployable
from middleware.presence import Presence
from middleware.settings import DeploymentSettings

RETRY = 2.0
"""Seconds after which a source that nobody could send is asked for again."""
EDITIONS = 2
"""Editions of one module on the shelf: the one that runs, and the one before."""
MAX_JUDGED = 256
"""Manifests that are remembered as judged; more forget the first, which is then judged, and told of, again."""

Later = Callable[..., object]


class Deployment:
    """The modules of one node.

    ``modules`` maps (kind, name) to what makes the strategy or behaviour; agents look there.  ``later(seconds, call)``
    is the node's own, so that it ends with the node.
    """

    _log = Logger()

    def __init__(
        self,
        entangled: EntangledNode,
        presence: Presence,
        wall: Callable[[], float],
        later: Later,
        allowed: DeploymentSettings,
        shelf: Shelf,
    ) -> None:
        self.modules: dict[tuple[str, str], Make] = {}
        self._entangled = entangled
        self._presence = presence
        self._wall = wall
        self._later = later
        self._allowed = allowed
        self._shelf = shelf
        self._held: dict[str, Manifest] = {}
        self._wanted: dict[str, Manifest] = {}
        self._refused: dict[str, str] = {}
        self._judged: dict[tuple[bytes, str], int] = {}

    @property
    def held(self) -> Mapping[str, Manifest]:
        """The manifests of the modules that run here, by name."""
        return self._held

    def open(self) -> None:
        """Load what was accepted in an earlier life, if it would be accepted now."""
        found: dict[str, list[tuple[Manifest, bytes]]] = {}
        for name, content in self._shelf.everything():
            pair = _unshelved(content)
            if pair is None:
                self._say(f"deployed file {name} is damaged and left out")
                continue
            record, source = pair
            manifest = manifest_of(record)
            reason = self._objection(record, manifest)
            if manifest is None or reason:
                self._refuse(record.name, manifest, reason)
            else:
                found.setdefault(manifest.name, []).append((manifest, source))
        for name in sorted(found):
            # The newest that loads; the one before it is there for the day on which the newest does not.
            for manifest, source in sorted(found[name], key=lambda each: each[0].rank, reverse=True):
                if self._run(manifest, source):
                    break
        self._report()

    def follow(self) -> None:
        """Watch what is pushed; to be called once the node has joined."""
        self._entangled.watch(manifests_key(), self._pushed)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _pushed(self, records: list[Record]) -> None:
        for record in sorted(records, key=lambda each: (each.name, each.owner)):
            slot = (record.owner, record.name)
            if self._judged.get(slot) == record.sequence:
                continue
            self._judged[slot] = record.sequence
            while len(self._judged) > MAX_JUDGED:
                del self._judged[next(iter(self._judged))]
            self._judge(record)
        self._report()

    def _judge(self, record: Record) -> None:
        manifest = manifest_of(record)
        reason = self._objection(record, manifest) or self._staleness(manifest)
        if manifest is None or reason:
            self._refuse(record.name, manifest, reason)
        elif manifest != self._held.get(manifest.name):
            wanted = self._wanted.get(manifest.name)
            if wanted is None or manifest.rank > wanted.rank:
                self._wanted[manifest.name] = manifest
                self._ask(manifest, record)

    def _objection(self, record: Record, manifest: Manifest | None) -> str:
        """Why nothing of this record may run here; empty where it may."""
        if record.name not in self._allowed.modules:
            return "is not among this node's modules"
        if record.owner.hex() not in self._allowed.operators:
            return f"comes from {record.owner.hex()[:8]}, no operator of this node"
        if not record.is_genuine():
            return "is not signed by its operator"
        if manifest is None:
            return "has a manifest that cannot be read"
        if manifest.size > MAX_SOURCE:
            return f"has {manifest.size} bytes, more than {MAX_SOURCE}"
        return ""

    def _staleness(self, manifest: Manifest | None) -> str:
        """Why what is held here stays; empty where it does not, or is the very same."""
        held = None if manifest is None else self._held.get(manifest.name)
        if manifest is None or held is None or manifest == held:
            return ""
        if manifest.kind != held.kind:
            return f"is a {held.kind} here, not a {manifest.kind}"
        if manifest.rank == held.rank:
            return f"version {held.version} is held with other content" if manifest.digest != held.digest else ""
        if manifest.rank < held.rank:
            taken_back = f" ({held.withdrawn} was taken back)" if held.withdrawn > held.version else ""
            return f"version {manifest.version} is older than the {held.version} held{taken_back}"
        return ""

    def _ask(self, manifest: Manifest, record: Record) -> None:
        if self._wanted.get(manifest.name) != manifest:
            return
        try:
            asked: Deferred[list[Record]] = self._entangled.get(hashed_key(source_key(manifest.digest)))
        except NotRunning:
            return
        asked.addCallback(self._sent, manifest, record)
        asked.addErrback(self._unsent, manifest, record)

    def _sent(self, records: list[Record], manifest: Manifest, record: Record) -> None:
        sources = [each.value for each in records if each.value is not None and len(each.value) == manifest.size]
        source = next((each for each in sources if digest_of(each) == manifest.digest), None)
        if self._wanted.get(manifest.name) != manifest:
            return
        if source is None:
            self._log.info("nobody has the source of {name} {label} yet", name=manifest.name, label=manifest.label)
            self._later(RETRY, self._ask, manifest, record)
            return
        del self._wanted[manifest.name]
        if self._run(manifest, source):
            self._keep(manifest, record, source)
        self._report()

    def _unsent(self, failure: Any, manifest: Manifest, record: Record) -> None:
        failure.trap(EntangledError)
        if failure.check(NotRunning) is None:
            self._later(RETRY, self._ask, manifest, record)

    def _run(self, manifest: Manifest, source: bytes) -> bool:
        """Have the module run from now on, if it can; whoever uses the one before goes on with it."""
        try:
            make = loaded(manifest, source)
        except Undeployable as error:
            self._log.warn("{error}", error=error)
            self._refuse(manifest.name, manifest, error.problem)
            return False
        self.modules[manifest.kind, manifest.name] = make
        self._held[manifest.name] = manifest
        self._refused.pop(manifest.name, None)
        self._say(f"runs {manifest.kind} {manifest.name} {manifest.label}")
        return True

    def _keep(self, manifest: Manifest, record: Record, source: bytes) -> None:
        content = bytes(msgpack.packb([record.packed(), source]))
        try:
            self._shelf.keep(_file(manifest), content)
        except OSError as error:
            self._say(f"{manifest.name} {manifest.version} is not on file: {error.strerror or error}")
            return
        kept = []
        for name, data in self._shelf.everything():
            pair = _unshelved(data)
            other = None if pair is None else manifest_of(pair[0])
            if other is not None and other.name == manifest.name:
                kept.append((other.rank, name))
        for _, name in sorted(kept, reverse=True)[EDITIONS:]:
            self._shelf.drop(name)

    def _refuse(self, name: str, manifest: Manifest | None, reason: str) -> None:
        version = "" if manifest is None else f" {manifest.version}"
        shown = "".join(c for c in name[:32] if c.isprintable())
        self._log.warn("refused: {name}{version} {reason}", name=shown, version=version, reason=reason)
        if name in self._allowed.modules:
            self._refused[name] = f"{version} refused".strip()
        self._say(f"refuses {shown}{version}: {reason}")

    def _report(self) -> None:
        told = {}
        for name in self._allowed.modules:
            held = self._held.get(name)
            words = [*([held.label] if held is not None else []), *filter(None, [self._refused.get(name)])]
            if words:
                told[name] = ", ".join(words)
        self._presence.change(deployed=told)

    def _say(self, text: str) -> None:
        self._presence.say(self._wall(), text)


def _file(manifest: Manifest) -> str:
    return f"{manifest.name}-{manifest.digest[:16]}"


def _unshelved(content: bytes) -> tuple[Record, bytes] | None:
    """The record and the source in a file of the shelf, or None where it is not whole."""
    try:
        fields = msgpack.unpackb(content)
    except Exception:  # a rotten file may hold anything
        return None
    if not isinstance(fields, list) or len(fields) != 2 or not isinstance(fields[1], bytes):
        return None
    record = unpacked(fields[0])
    return None if record is None else (record, fields[1])
