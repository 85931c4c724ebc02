"""Deployment: one node's acceptance of what its operators push; off where the owner has not allowed it.

In this order: is the module listed, is its author's key, is the author an operator of the team now, is the signature
good, is it newer than the held version, has the source the signed digest, does it load and conform.  Each module runs
in a separate process (``runner``), and none of it before all this is checked.  The author is judged again every second:
the modules of one that is an operator no longer stop.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import msgpack
from twisted.internet.defer import Deferred
from twisted.logger import Logger

from middleware.admission.roles import OPERATOR
from middleware.config.settings import DeploymentSettings
from middleware.consensus.deployed import STRATEGY, Make
from middleware.deployment.frame import Spawn
from middleware.deployment.manifest import MAX_SOURCE, Manifest, digest_of, manifest_of, manifests_key, source_key
from middleware.deployment.runner import PushedStrategy, Runner, State
from middleware.deployment.shelf import Shelf
from middleware.directory.presence import Presence
from middleware.entangled.errors import EntangledError, NotRunning
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, hashed_key, unpacked

RETRY = 2.0
"""Seconds after which a source that nobody could send is asked for again."""
WATCHING_S = 1.0
"""Seconds between two looks at the authors and the processes."""
STARTING_S = 0.05
"""Seconds between two looks at a process that starts."""
IDLE_S = 60.0
"""Seconds after which the process of the version before is ended, if it was not asked."""
EDITIONS = 2
"""Editions of one module on the shelf: the one that runs, and the one before."""
MAX_JUDGED = 256
"""Manifests that are remembered as judged; more forget the first, which is then judged, and told of, again."""
MAX_NAME = 16
CONFINED = "seccomp"
"""The limit without which the device says that a module is not confined."""

Later = Callable[..., object]


@dataclass(frozen=True)
class Author:
    """The member with a key: its ``roles`` now, None in an open team."""

    name: str
    roles: frozenset[str] | None


@dataclass(frozen=True)
class _Candidate:
    manifest: Manifest
    record: Record
    source: bytes


class Deployment:
    """The modules of one node.

    ``modules`` maps (kind, name) to what makes the strategy or behaviour; agents look there.  ``later(seconds, call)``
    is the node's own, so that it ends with the node.  ``author_of`` tells who holds a key, ``spawn`` starts a process,
    ``seconds`` is the monotonic clock.
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
        author_of: Callable[[bytes], Author],
        spawn: Spawn,
        seconds: Callable[[], float],
    ) -> None:
        self.modules: dict[tuple[str, str], Make] = {}
        self._entangled = entangled
        self._presence = presence
        self._wall = wall
        self._later = later
        self._allowed = allowed
        self._shelf = shelf
        self._author_of = author_of
        self._spawn = spawn
        self._seconds = seconds
        self._wanted: dict[str, tuple[Manifest, Record]] = {}
        self._running: dict[str, tuple[Runner, Record]] = {}
        self._starting: dict[str, tuple[Runner, Record]] = {}
        self._before: dict[str, tuple[Runner, Record]] = {}
        self._refused: dict[str, str] = {}
        self._reported: dict[str, str] = {}
        self._records: dict[tuple[bytes, str], Record] = {}
        self._unfit: dict[tuple[bytes, str], int] = {}

    @property
    def held(self) -> Mapping[str, Manifest]:
        """The manifests of the modules that run here, by name."""
        return {name: runner.manifest for name, (runner, _) in self._running.items()}

    def open(self) -> None:
        """Load what was accepted in an earlier life, if it would be accepted now."""
        found: dict[str, list[_Candidate]] = {}
        for name, content in self._shelf.everything():
            pair = _unshelved(content)
            if pair is None:
                self._say(f"deployed file {name} is damaged and left out")
                continue
            record, source = pair
            manifest = manifest_of(record)
            reason = self._objection(record, manifest)
            if manifest is None or reason:
                self._refuse(record, manifest, reason)
            else:
                found.setdefault(manifest.name, []).append(_Candidate(manifest, record, source))
        for name in sorted(found):
            # The newest that loads; the one before it is there for the day on which the newest does not.
            self._start(sorted(found[name], key=lambda each: each.manifest.rank, reverse=True), is_new=False)
        self._report()
        self._later(WATCHING_S, self._watch)

    def follow(self) -> None:
        """Watch what is pushed; to be called once the node has joined."""
        self._entangled.watch(manifests_key(), self._pushed)

    def stop(self) -> None:
        """End all processes."""
        for runner, _ in (*self._running.values(), *self._starting.values(), *self._before.values()):
            runner.stop("the node has left")

    # -- what is pushed ---------------------------------------------------------------------------------------------

    def _pushed(self, records: list[Record]) -> None:
        for record in sorted(records, key=lambda each: (each.name, each.owner)):
            slot = (record.owner, record.name)
            known = self._records.get(slot)
            if known is not None and known.sequence == record.sequence:
                continue
            self._records[slot] = record
            while len(self._records) > MAX_JUDGED:
                del self._records[next(iter(self._records))]
            self._judge(record)
        self._report()

    def _judge(self, record: Record) -> None:
        manifest = manifest_of(record)
        standing = self._author_objection(record) if self._is_listed(record) else ""
        slot = (record.owner, record.name)
        if standing:
            self._unfit[slot] = record.sequence
        else:
            self._unfit.pop(slot, None)
        reason = self._objection(record, manifest) or self._staleness(manifest)
        if manifest is None or reason:
            self._refuse(record, manifest, reason)
        elif manifest != self.held.get(manifest.name):
            wanted = self._wanted.get(manifest.name)
            if wanted is None or manifest.rank > wanted[0].rank or self._objection(wanted[1], wanted[0]):
                self._wanted[manifest.name] = (manifest, record)
                self._ask(manifest, record)

    def _is_listed(self, record: Record) -> bool:
        return record.name in self._allowed.modules and record.owner.hex() in self._allowed.operators

    def _objection(self, record: Record, manifest: Manifest | None) -> str:
        """Why nothing of this record may run here; empty where it may."""
        if record.name not in self._allowed.modules:
            return "is not among this node's modules"
        if record.owner.hex() not in self._allowed.operators:
            return f"comes from {record.owner.hex()[:8]}, no operator of this node"
        if not record.is_genuine():
            return "is not signed by its operator"
        standing = self._author_objection(record)
        if standing:
            return standing
        if manifest is None:
            return "has a manifest that cannot be read"
        if manifest.size > MAX_SOURCE:
            return f"has {manifest.size} bytes, more than {MAX_SOURCE}"
        return ""

    def _author_objection(self, record: Record) -> str:
        """Why its author may push nothing now; empty if it may."""
        author = self._author_of(record.owner)
        if author.roles is None or OPERATOR in author.roles:
            return ""
        return f"comes from {record.owner.hex()[:8]}, which is no operator of the team now"

    def _staleness(self, manifest: Manifest | None) -> str:
        """Why what is held here stays; empty where it does not, or is the very same."""
        held = None if manifest is None else self.held.get(manifest.name)
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
        if self._wanted.get(manifest.name) != (manifest, record):
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
        if self._wanted.get(manifest.name) != (manifest, record):
            return
        if source is None:
            self._log.info("nobody has the source of {name} {label} yet", name=manifest.name, label=manifest.label)
            self._later(RETRY, self._ask, manifest, record)
            return
        del self._wanted[manifest.name]
        self._start([_Candidate(manifest, record, source)], is_new=True)
        self._report()

    def _unsent(self, failure: Any, manifest: Manifest, record: Record) -> None:
        failure.trap(EntangledError)
        if failure.check(NotRunning) is None:
            self._later(RETRY, self._ask, manifest, record)

    # -- processes --------------------------------------------------------------------------------------------------

    def _start(self, candidates: list[_Candidate], is_new: bool) -> None:
        """Start a process for the first that loads; what runs is used until another is ready."""
        if not candidates:
            return
        manifest, record = candidates[0].manifest, candidates[0].record
        known = self._starting.pop(manifest.name, None)
        if known is not None:
            known[0].stop("a newer one was pushed")
        runner = Runner(
            manifest, candidates[0].source, self._spawn, self._seconds, lambda: self._objection(record, manifest)
        )
        self._starting[manifest.name] = (runner, record)
        runner.start()
        self._settle(runner, candidates, is_new)

    def _settle(self, runner: Runner, candidates: list[_Candidate], is_new: bool) -> None:
        """See what came of a start."""
        name = runner.manifest.name
        if self._starting.get(name, (None,))[0] is not runner:
            return
        runner.look()
        if runner.state is State.STARTING:
            self._later(STARTING_S, self._settle, runner, candidates, is_new)
            return
        del self._starting[name]
        if runner.state is State.READY:
            self._adopt(runner, candidates[0])
            if is_new:
                self._keep(candidates[0])
        else:
            runner.stop(runner.why)
            self._refuse(candidates[0].record, runner.manifest, runner.why)
            self._start(candidates[1:], is_new)
        self._report()

    def _adopt(self, runner: Runner, candidate: _Candidate) -> None:
        """Use this version from now on; tasks under way continue with the previous one."""
        manifest = runner.manifest
        before = self._running.get(manifest.name)
        if before is not None:
            older = self._before.get(manifest.name)
            if older is not None:
                older[0].stop("two newer ones were pushed")
            self._before[manifest.name] = before
        self._running[manifest.name] = (runner, candidate.record)
        is_strategy = manifest.kind == STRATEGY
        self.modules[manifest.kind, manifest.name] = (
            (lambda: PushedStrategy(runner)) if is_strategy else runner.create  # what tasks of that name get
        )
        self._refused.pop(manifest.name, None)
        if CONFINED not in runner.limits:
            held = ", ".join(runner.limits) or "none"
            self._log.warn("{name} runs without seccomp; its limits: {held}", name=manifest.name, held=held)
        self._say(f"runs {manifest.kind} {manifest.name} {manifest.label}")

    def _watch(self) -> None:
        """Stop what may run no longer, look after the processes, and judge again who was no operator."""
        self._later(WATCHING_S, self._watch)
        now = self._seconds()
        for runner, record in (*self._running.values(), *self._starting.values()):
            reason = self._objection(record, runner.manifest)
            if reason:
                self._expel(runner, record, reason)
            else:
                runner.look()
        for name, (runner, record) in list(self._before.items()):
            runner.look()
            is_idle = not runner.instances and now - runner.asked_at > IDLE_S
            reason = self._objection(record, runner.manifest) or ("a newer one was pushed" if is_idle else "")
            if reason or runner.state is State.OUT:
                runner.stop(reason)
                del self._before[name]
        for slot, sequence in list(self._unfit.items()):
            known = self._records.get(slot)
            if known is None or known.sequence != sequence:
                del self._unfit[slot]
            elif not self._author_objection(known):
                self._judge(known)
        self._report()

    def _expel(self, runner: Runner, record: Record, reason: str) -> None:
        """End a module whose author may push no longer, and judge the modules of other authors again."""
        manifest = runner.manifest
        runner.stop(reason)
        self._starting.pop(manifest.name, None)
        if self._running.get(manifest.name, (None,))[0] is runner:
            del self._running[manifest.name]
            self.modules.pop((manifest.kind, manifest.name), None)
            before = self._before.pop(manifest.name, None)
            if before is not None:
                before[0].stop(reason)
        for known in [each for each in self._records.values() if each.name == manifest.name]:
            self._judge(known)
        self._refuse(record, manifest, reason)

    # -- what is told -----------------------------------------------------------------------------------------------

    def _keep(self, candidate: _Candidate) -> None:
        manifest = candidate.manifest
        content = bytes(msgpack.packb([candidate.record.packed(), candidate.source]))
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

    def _refuse(self, record: Record, manifest: Manifest | None, reason: str) -> None:
        version = "" if manifest is None else f" {manifest.version}"
        shown = "".join(c for c in record.name[:32] if c.isprintable())
        self._log.warn("refused: {name}{version} {reason}", name=shown, version=version, reason=reason)
        if record.name in self._allowed.modules:
            self._refused[record.name] = f"{self._told(record, manifest)} refused"
        self._say(f"refuses {shown}{version}: {reason}")

    def _report(self) -> None:
        told = {}
        for name in self._allowed.modules:
            words = []
            if name in self._running:
                runner, record = self._running[name]
                words.append(f"{self._told(record, runner.manifest)} {_state(runner)}")
            if name in self._starting:
                words.append(f"{self._told(self._starting[name][1], self._starting[name][0].manifest)} is started")
            elif name in self._wanted:
                words.append(f"{self._told(self._wanted[name][1], self._wanted[name][0])} waits for its source")
            if name in self._refused:
                words.append(self._refused[name])
            if words:
                told[name] = ", ".join(words)
        if told != self._reported:
            self._reported = told
            self._presence.change(deployed=told)

    def _told(self, record: Record, manifest: Manifest | None) -> str:
        """Version, digest and author of a module, for people."""
        label = "" if manifest is None else f"{manifest.label} "
        name = "".join(c for c in self._author_of(record.owner).name[:MAX_NAME] if c.isprintable())
        return f"{label}by {name} {record.owner.hex()[:8]}".replace("  ", " ")

    def _say(self, text: str) -> None:
        self._presence.say(self._wall(), text)


def _state(runner: Runner) -> str:
    if runner.state is State.READY:
        return "runs" if CONFINED in runner.limits else "runs, not confined"
    return "was ended" if runner.state in (State.LOST, State.OUT) else "is started"


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
