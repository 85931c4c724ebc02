"""Acceptance of pushed modules by one node; disabled unless the device's owner allows it.

The node accepts a module if its name and its author's key are listed in the settings, the signature is valid, and the
author is an operator of the team now.  The version must be newer than the current one, the source must have the signed
digest, and the module must load and conform to its interface.  Each module runs in a separate process (``runner``),
after all checks have passed.  The author's role is checked again every second, so the modules of a former operator are
stopped.
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
from middleware.consensus.deployed_modules import STRATEGY, Factory
from middleware.deployment.manifest import (
    MAX_SOURCE_BYTES,
    Manifest,
    compute_digest,
    manifests_key,
    parse_manifest,
    source_key,
)
from middleware.deployment.module_channel import Spawn
from middleware.deployment.module_store import ModuleStore
from middleware.deployment.runner import PushedStrategy, Runner, State
from middleware.directory.presence import Presence
from middleware.entangled.errors import EntangledError, NotRunning
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, hash_key, parse_record

RETRY_S = 2.0
"""If no node could send the source of a module, the source is requested again after this number of seconds."""
WATCH_INTERVAL_S = 1.0
"""Seconds between two checks of authors and processes."""
START_CHECK_INTERVAL_S = 0.05
"""Seconds between two checks of a process that is starting."""
IDLE_S = 60.0
"""Seconds after which the unused process of a previous version is ended."""
STORED_EDITIONS = 2
"""Number of stored editions of one module: the running edition and the previous one."""
MAX_CHECKED_MANIFESTS = 256
"""Maximum number of manifests that are remembered as checked; a forgotten manifest is checked and reported again."""
MAX_AUTHOR_CHARACTERS = 16
CONFINED = "seccomp"
"""The name of a limit (``confinement``) without which the device reports a module as not confined."""

Later = Callable[..., object]


@dataclass(frozen=True)
class Author:
    """The author of a module: its name, and its current ``roles`` (None in an open team)."""

    name: str
    roles: frozenset[str] | None


@dataclass(frozen=True)
class _Candidate:
    manifest: Manifest
    record: Record
    source: bytes


class Deployment:
    """The pushed modules of one node.

    ``modules`` maps (kind, name) to the factory of the strategy or behaviour, for the agents.  ``later(seconds, call)``
    calls ``call`` after ``seconds``, unless the node is stopped first.  ``find_author`` returns the author with a given
    key, ``spawn`` starts a process, and ``seconds`` is the monotonic clock.
    """

    _log = Logger()

    def __init__(
        self,
        entangled: EntangledNode,
        presence: Presence,
        wall: Callable[[], float],
        later: Later,
        allowed: DeploymentSettings,
        module_store: ModuleStore,
        find_author: Callable[[bytes], Author],
        spawn: Spawn,
        seconds: Callable[[], float],
    ) -> None:
        self.modules: dict[tuple[str, str], Factory] = {}
        self._entangled = entangled
        self._presence = presence
        self._wall = wall
        self._later = later
        self._allowed = allowed
        self._module_store = module_store
        self._find_author = find_author
        self._spawn = spawn
        self._seconds = seconds
        self._wanted: dict[str, tuple[Manifest, Record]] = {}
        self._running: dict[str, tuple[Runner, Record]] = {}
        self._starting: dict[str, tuple[Runner, Record]] = {}
        self._previous: dict[str, tuple[Runner, Record]] = {}
        self._refusals: dict[str, str] = {}
        self._reported: dict[str, str] = {}
        self._records: dict[tuple[bytes, str], Record] = {}
        self._unauthorized: dict[tuple[bytes, str], int] = {}

    @property
    def running_manifests(self) -> Mapping[str, Manifest]:
        """The manifests of the modules that run on this node, by name."""
        return {name: runner.manifest for name, (runner, _) in self._running.items()}

    def load_stored(self) -> None:
        """Load the stored modules that the node would accept now."""
        found: dict[str, list[_Candidate]] = {}
        for name, content in self._module_store.list_modules():
            pair = _parse_stored(content)
            if pair is None:
                self._publish_message(f"deployed file {name} is damaged and ignored")
                continue
            record, source = pair
            manifest = parse_manifest(record)
            reason = self._find_objection(record, manifest)
            if manifest is None or reason:
                self._refuse(record, manifest, reason)
            else:
                found.setdefault(manifest.name, []).append(_Candidate(manifest, record, source))
        for name in sorted(found):
            # Use the newest version that loads: if the newest version does not load, use the previous version.
            self._start(sorted(found[name], key=lambda each: each.manifest.rank, reverse=True), is_new=False)
        self._report()
        self._later(WATCH_INTERVAL_S, self._watch)

    def follow(self) -> None:
        """Watch for pushed modules; call this once the node has joined."""
        self._entangled.watch(manifests_key(), self._on_manifests)

    def stop(self) -> None:
        """End all module processes."""
        for runner, _ in (*self._running.values(), *self._starting.values(), *self._previous.values()):
            runner.stop("the node has left")

    # -- received manifests -----------------------------------------------------------------------------------------

    def _on_manifests(self, records: list[Record]) -> None:
        for record in sorted(records, key=lambda each: (each.name, each.owner)):
            slot = (record.owner, record.name)
            known = self._records.get(slot)
            if known is not None and known.sequence == record.sequence:
                continue
            self._records[slot] = record
            while len(self._records) > MAX_CHECKED_MANIFESTS:
                del self._records[next(iter(self._records))]
            self._check_record(record)
        self._report()

    def _check_record(self, record: Record) -> None:
        manifest = parse_manifest(record)
        objection = self._check_author(record) if self._is_listed(record) else ""
        slot = (record.owner, record.name)
        if objection:
            self._unauthorized[slot] = record.sequence
        else:
            self._unauthorized.pop(slot, None)
        reason = self._find_objection(record, manifest) or self._check_rank(manifest)
        if manifest is None or reason:
            self._refuse(record, manifest, reason)
        elif manifest != self.running_manifests.get(manifest.name):
            wanted = self._wanted.get(manifest.name)
            if wanted is None or manifest.rank > wanted[0].rank or self._find_objection(wanted[1], wanted[0]):
                self._wanted[manifest.name] = (manifest, record)
                self._request_source(manifest, record)

    def _is_listed(self, record: Record) -> bool:
        return record.name in self._allowed.modules and record.owner.hex() in self._allowed.operators

    def _find_objection(self, record: Record, manifest: Manifest | None) -> str:
        """Return the reason why this record may not run on this node; empty if it may."""
        if record.name not in self._allowed.modules:
            return "is not among this node's modules"
        if record.owner.hex() not in self._allowed.operators:
            return f"comes from {record.owner.hex()[:8]}, no operator of this node"
        if not record.is_genuine():
            return "is not signed by its operator"
        objection = self._check_author(record)
        if objection:
            return objection
        if manifest is None:
            return "has a manifest that cannot be read"
        if manifest.size > MAX_SOURCE_BYTES:
            return f"has {manifest.size} bytes, more than {MAX_SOURCE_BYTES}"
        return ""

    def _check_author(self, record: Record) -> str:
        """Return the reason why the author may not push modules now; empty if it may."""
        author = self._find_author(record.owner)
        if author.roles is None or OPERATOR in author.roles:
            return ""
        return f"comes from {record.owner.hex()[:8]}, which is no operator of the team now"

    def _check_rank(self, manifest: Manifest | None) -> str:
        """Return the reason why the current version stays; empty if ``manifest`` is newer or identical."""
        held = None if manifest is None else self.running_manifests.get(manifest.name)
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

    def _request_source(self, manifest: Manifest, record: Record) -> None:
        if self._wanted.get(manifest.name) != (manifest, record):
            return
        try:
            reading: Deferred[list[Record]] = self._entangled.get(hash_key(source_key(manifest.digest)))
        except NotRunning:
            return
        reading.addCallback(self._on_source, manifest, record)
        reading.addErrback(self._on_source_error, manifest, record)

    def _on_source(self, records: list[Record], manifest: Manifest, record: Record) -> None:
        sources = [each.value for each in records if each.value is not None and len(each.value) == manifest.size]
        source = next((each for each in sources if compute_digest(each) == manifest.digest), None)
        if self._wanted.get(manifest.name) != (manifest, record):
            return
        if source is None:
            self._log.info("no node has the source of {name} {label} yet", name=manifest.name, label=manifest.label)
            self._later(RETRY_S, self._request_source, manifest, record)
            return
        del self._wanted[manifest.name]
        self._start([_Candidate(manifest, record, source)], is_new=True)
        self._report()

    def _on_source_error(self, failure: Any, manifest: Manifest, record: Record) -> None:
        failure.trap(EntangledError)
        if failure.check(NotRunning) is None:
            self._later(RETRY_S, self._request_source, manifest, record)

    # -- processes --------------------------------------------------------------------------------------------------

    def _start(self, candidates: list[_Candidate], is_new: bool) -> None:
        """Start a process for the first candidate that loads.

        The running version is used until the process is ready.
        """
        if not candidates:
            return
        manifest, record = candidates[0].manifest, candidates[0].record
        known = self._starting.pop(manifest.name, None)
        if known is not None:
            known[0].stop("a newer one was pushed")
        runner = Runner(
            manifest, candidates[0].source, self._spawn, self._seconds, lambda: self._find_objection(record, manifest)
        )
        self._starting[manifest.name] = (runner, record)
        runner.start()
        self._check_start(runner, candidates, is_new)

    def _check_start(self, runner: Runner, candidates: list[_Candidate], is_new: bool) -> None:
        """Check the result of a start."""
        name = runner.manifest.name
        if self._starting.get(name, (None,))[0] is not runner:
            return
        runner.poll()
        if runner.state is State.STARTING:
            self._later(START_CHECK_INTERVAL_S, self._check_start, runner, candidates, is_new)
            return
        del self._starting[name]
        if runner.state is State.READY:
            self._adopt(runner, candidates[0])
            if is_new:
                self._store(candidates[0])
        else:
            runner.stop(runner.why)
            self._refuse(candidates[0].record, runner.manifest, runner.why)
            self._start(candidates[1:], is_new)
        self._report()

    def _adopt(self, runner: Runner, candidate: _Candidate) -> None:
        """Use this version from now on; running tasks continue with the previous version."""
        manifest = runner.manifest
        before = self._running.get(manifest.name)
        if before is not None:
            older = self._previous.get(manifest.name)
            if older is not None:
                older[0].stop("two newer ones were pushed")
            self._previous[manifest.name] = before
        self._running[manifest.name] = (runner, candidate.record)
        is_strategy = manifest.kind == STRATEGY
        self.modules[manifest.kind, manifest.name] = (
            (lambda: PushedStrategy(runner)) if is_strategy else runner.create  # factory for new tasks
        )
        self._refusals.pop(manifest.name, None)
        if CONFINED not in runner.limits:
            held = ", ".join(runner.limits) or "none"
            self._log.warn("{name} runs without seccomp; limits in effect: {held}", name=manifest.name, held=held)
        self._publish_message(f"runs {manifest.kind} {manifest.name} {manifest.label}")

    def _watch(self) -> None:
        """Stop modules that may no longer run, supervise processes, and check rejected authors again."""
        self._later(WATCH_INTERVAL_S, self._watch)
        now = self._seconds()
        for runner, record in (*self._running.values(), *self._starting.values()):
            reason = self._find_objection(record, runner.manifest)
            if reason:
                self._stop_module(runner, record, reason)
            else:
                runner.poll()
        for name, (runner, record) in list(self._previous.items()):
            runner.poll()
            is_idle = not runner.instances and now - runner.last_request_at > IDLE_S
            reason = self._find_objection(record, runner.manifest) or ("a newer one was pushed" if is_idle else "")
            if reason or runner.state is State.OUT:
                runner.stop(reason)
                del self._previous[name]
        for slot, sequence in list(self._unauthorized.items()):
            known = self._records.get(slot)
            if known is None or known.sequence != sequence:
                del self._unauthorized[slot]
            elif not self._check_author(known):
                self._check_record(known)
        self._report()

    def _stop_module(self, runner: Runner, record: Record, reason: str) -> None:
        """Stop a module whose author may no longer push modules, and check the modules of other authors again."""
        manifest = runner.manifest
        runner.stop(reason)
        self._starting.pop(manifest.name, None)
        if self._running.get(manifest.name, (None,))[0] is runner:
            del self._running[manifest.name]
            self.modules.pop((manifest.kind, manifest.name), None)
            before = self._previous.pop(manifest.name, None)
            if before is not None:
                before[0].stop(reason)
        for known in [each for each in self._records.values() if each.name == manifest.name]:
            self._check_record(known)
        self._refuse(record, manifest, reason)

    # -- storage and reports ----------------------------------------------------------------------------------------

    def _store(self, candidate: _Candidate) -> None:
        manifest = candidate.manifest
        content = bytes(msgpack.packb([candidate.record.pack(), candidate.source]))
        try:
            self._module_store.save(_file_name(manifest), content)
        except OSError as error:
            self._publish_message(f"cannot store {manifest.name} {manifest.version}: {error.strerror or error}")
            return
        kept = []
        for name, data in self._module_store.list_modules():
            pair = _parse_stored(data)
            other = None if pair is None else parse_manifest(pair[0])
            if other is not None and other.name == manifest.name:
                kept.append((other.rank, name))
        for _, name in sorted(kept, reverse=True)[STORED_EDITIONS:]:
            self._module_store.delete(name)

    def _refuse(self, record: Record, manifest: Manifest | None, reason: str) -> None:
        version = "" if manifest is None else f" {manifest.version}"
        shown_name = "".join(c for c in record.name[:32] if c.isprintable())
        self._log.warn("refused: {name}{version} {reason}", name=shown_name, version=version, reason=reason)
        if record.name in self._allowed.modules:
            self._refusals[record.name] = f"{self._describe(record, manifest)} refused"
        self._publish_message(f"refuses {shown_name}{version}: {reason}")

    def _report(self) -> None:
        described = {}
        for name in self._allowed.modules:
            words = []
            if name in self._running:
                runner, record = self._running[name]
                words.append(f"{self._describe(record, runner.manifest)} {_describe_state(runner)}")
            if name in self._starting:
                words.append(f"{self._describe(self._starting[name][1], self._starting[name][0].manifest)} is started")
            elif name in self._wanted:
                words.append(f"{self._describe(self._wanted[name][1], self._wanted[name][0])} waits for its source")
            if name in self._refusals:
                words.append(self._refusals[name])
            if words:
                described[name] = ", ".join(words)
        if described != self._reported:
            self._reported = described
            self._presence.change(deployed=described)

    def _describe(self, record: Record, manifest: Manifest | None) -> str:
        """Return version, digest and author of a module for display."""
        label = "" if manifest is None else f"{manifest.label} "
        name = "".join(c for c in self._find_author(record.owner).name[:MAX_AUTHOR_CHARACTERS] if c.isprintable())
        return f"{label}by {name} {record.owner.hex()[:8]}".replace("  ", " ")

    def _publish_message(self, text: str) -> None:
        self._presence.add_message(self._wall(), text)


def _describe_state(runner: Runner) -> str:
    if runner.state is State.READY:
        return "runs" if CONFINED in runner.limits else "runs, not confined"
    return "was ended" if runner.state in (State.LOST, State.OUT) else "is started"


def _file_name(manifest: Manifest) -> str:
    return f"{manifest.name}-{manifest.digest[:16]}"


def _parse_stored(content: bytes) -> tuple[Record, bytes] | None:
    """Return the record and the source in a stored file, or None if it is damaged."""
    try:
        fields = msgpack.unpackb(content)
    except Exception:  # damaged file
        return None
    if not isinstance(fields, list) or len(fields) != 2 or not isinstance(fields[1], bytes):
        return None
    record = parse_record(fields[0])
    return None if record is None else (record, fields[1])
