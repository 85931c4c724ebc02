"""Tests of ``middleware.deployment.deployment``: a node of a simulated team accepts or rejects modules."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import msgpack

from middleware.config.settings import DeploymentSettings
from middleware.consensus.deployed_modules import BEHAVIOUR, STRATEGY
from middleware.consensus.strategy import load_strategy
from middleware.deployment.deployment import RETRY_S, Author, Deployment
from middleware.deployment.manifest import (
    MAX_SOURCE_BYTES,
    Manifest,
    make_next_manifest,
    make_rollback,
    manifests_key,
    source_key,
)
from middleware.deployment.module_store import FileModuleStore, MemoryModuleStore, ModuleStore
from middleware.entangled.record import Record, hash_key
from middleware.errors import UnknownStrategy
from middleware.node import SwarmNode
from swarmnode.sandbox import make_memory_channel
from tests.fleet import FleetCase

SOURCE = b"""
import sys
from middleware.consensus.strategies.nearest import Nearest
sys.modules["swarm_canary"] = sys

class Strategy(Nearest):
    pass
"""
CANARY = "swarm_canary"


class DeploymentTests(FleetCase):
    def setUp(self) -> None:
        super().setUp()
        before = set(sys.modules)
        self.addCleanup(lambda: [sys.modules.pop(name) for name in sorted(set(sys.modules) - before)])
        self.world = self.swarm(3)
        self.operator, self.stranger, self.dog = self.world.nodes
        self.module_store = MemoryModuleStore()
        self.author = Author("laptop", frozenset({"operator"}))
        self.deployment = self.allow()

    def allow(
        self, module_store: ModuleStore | None = None, node: SwarmNode | None = None, **more: object
    ) -> Deployment:
        """Allow the dog (or ``node``) to accept the module "best" from the operator."""
        node = self.dog if node is None else node
        key = self.operator.entangled.identity.public.hex()
        allowed = replace(DeploymentSettings(True, (key,), ("best",)), **more)  # type: ignore[arg-type]
        module_store = self.module_store if module_store is None else module_store
        made = Deployment(
            node.entangled,
            node.presence,
            node.wall,
            node.later,
            allowed,
            module_store,
            lambda public: self.author,
            make_memory_channel,
            node.clock.seconds,
        )
        made.load_stored()
        made.follow()
        return made

    def push(self, manifest: Manifest, source: bytes | None = SOURCE, by: SwarmNode | None = None) -> None:
        """Publish a manifest, and store a source under the key in the manifest."""
        node = self.operator if by is None else by
        if source is not None:
            self.done(self.world, node.entangled.put(hash_key(source_key(manifest.digest)), "source", source), 1.0)
        self.done(self.world, node.entangled.put(manifests_key(), manifest.name, manifest.pack()), 1.0)
        self.world.run(1.0)

    def version(self, number: int, held: Manifest | None = None, name: str = "best") -> tuple[Manifest, bytes]:
        source = SOURCE + b"# %d\n" % number
        return make_next_manifest(name, STRATEGY, source, held, number), source

    @property
    def running(self) -> int:
        """Return the version of the module that runs, or 0."""
        held = self.deployment.running_manifests.get("best")
        return 0 if held is None else held.version

    def assert_refused(self, words: str, runs: int = 0) -> None:
        """Check that the dog logs ``words``, has not run the rejected code, and still runs version ``runs``."""
        said = " | ".join(text for _, text in self.dog.presence.device.messages)
        self.assertIn(words, said)
        self.assertEqual(self.running, runs)
        if not runs:
            self.assertNotIn(CANARY, sys.modules)

    def test_accepts_and_reports(self) -> None:
        """A listed module of a listed operator runs under its name, and the device publishes its version and digest."""
        manifest, source = self.version(1)
        self.push(manifest, source)
        self.assertEqual(self.running, 1)
        self.assertIn(CANARY, sys.modules)
        strategy = load_strategy("deployed:best", deployed=self.deployment.modules)
        self.assertEqual(strategy.name, "deployed:best")
        key = self.operator.entangled.identity.public.hex()
        told = f"1 {manifest.digest[:8]} by laptop {key[:8]} runs, not confined"
        self.assertEqual(self.dog.presence.device.deployed, {"best": told})
        error = self.assertRaises(UnknownStrategy, load_strategy, "deployed:other", deployed=self.deployment.modules)
        self.assertIn("deployed: deployed:best", str(error))
        self.assertRaises(UnknownStrategy, load_strategy, "deployed:best")

    def test_objections(self) -> None:
        """A module that is unlisted, oversized or from an unlisted operator is rejected before the download."""
        manifest, source = self.version(1)
        self.push(manifest, source, self.stranger)
        self.assert_refused(f"comes from {self.stranger.entangled.identity.public.hex()[:8]}")
        self.push(*self.version(1, name="worst"))
        self.assert_refused("refuses worst 1: is not among this node's modules")
        self.assertNotIn("worst", self.dog.presence.device.deployed)
        self.push(replace(manifest, size=MAX_SOURCE_BYTES + 1), source)
        self.assert_refused(f"has {MAX_SOURCE_BYTES + 1} bytes, more than {MAX_SOURCE_BYTES}")

    def test_bad_signature_is_refused(self) -> None:
        """A record in the operator's name without its signature is rejected, even if a watch delivers it."""
        manifest, source = self.version(1)
        self.done(self.world, self.operator.entangled.put(hash_key(source_key(manifest.digest)), "source", source))
        owner = self.operator.entangled.identity.public
        forged = Record(manifests_key(), "best", owner, 5, "team", 60.0, manifest.pack())
        self.deployment._on_manifests([forged.sign(self.stranger.entangled.identity)])
        self.world.run(1.0)
        self.assert_refused("is not signed by its operator")

    def test_wrong_kind_is_refused(self) -> None:
        """A strategy that is pushed as a behaviour is rejected, and a name keeps its kind."""
        source = SOURCE + b"#"
        self.push(make_next_manifest("best", BEHAVIOUR, source, None, 1), source)
        said = " ".join(text for _, text in self.dog.presence.device.messages)
        self.assertIn("a behaviour has to define Behaviour", said)
        manifest, source = self.version(2)
        self.push(manifest, source)
        self.push(replace(make_next_manifest("best", BEHAVIOUR, source, manifest, 3), before=()), source)
        self.assert_refused("is a strategy here, not a behaviour", runs=2)

    def test_lower_version_and_other_content_are_refused(self) -> None:
        """Neither an older version, nor the same version with different content, replaces the current version."""
        second, source = self.version(2)
        self.push(second, source)
        first, source = self.version(1)
        self.push(first, source)
        self.assert_refused("version 1 is older than the 2 held", runs=2)
        other = SOURCE + b"# other\n"
        self.push(make_next_manifest("best", STRATEGY, other, None, 2), other)
        self.assert_refused("version 2 is held with other content", runs=2)
        self.assertEqual(self.deployment.running_manifests["best"], second)

    def test_going_back_and_old_word_again(self) -> None:
        """After a rollback the withdrawn version is rejected, even if its record arrives again."""
        first, source = self.version(1)
        self.push(first, source)
        second, source = self.version(2, first)
        self.push(second, source)
        back = make_rollback(second)
        assert back is not None
        self.push(back, None)
        self.assertEqual(self.running, 1)
        self.push(second, None)
        self.assert_refused("version 2 is older than the 1 held (2 was taken back)", runs=1)

    def test_source_may_come_late(self) -> None:
        """If the source is missing or differs from the signed digest, it is requested again until it arrives."""
        manifest, source = self.version(1)
        wrong = source[:-2] + b"2\n"
        key = hash_key(source_key(manifest.digest))
        self.done(self.world, self.stranger.entangled.put(key, "source", wrong))
        self.push(manifest, None)
        self.world.run(RETRY_S)
        self.assertEqual(self.running, 0)
        self.assertNotIn(CANARY, sys.modules)
        self.done(self.world, self.operator.entangled.put(key, "source", source))
        self.world.run(2 * RETRY_S)
        self.assertEqual(self.running, 1)

    def test_nonsense_under_the_key(self) -> None:
        """Each value that is not a manifest is rejected once, without other effects."""
        for value in (b"", b"\xc1", msgpack.packb({"name": "best"}), bytes(5000)):
            self.done(self.world, self.operator.entangled.put(manifests_key(), "best", value), 1.0)
            self.done(self.world, self.stranger.entangled.put(manifests_key(), "x\x1b", value), 1.0)
        self.assert_refused("refuses best: has a manifest that cannot be read")
        self.assertNotIn("\x1b", "".join(text for _, text in self.dog.presence.device.messages))

    def test_restart_loads_from_the_shelf(self) -> None:
        """After a restart the accepted version runs without any peer; the store contains it and the previous one."""
        held = None
        for number in (1, 2, 3):
            held, source = self.version(number, held)
            self.push(held, source)
        self.assertEqual(len(self.module_store.contents), 2)
        for node in (self.operator, self.stranger):
            node.stop_silently()
        self.deployment = self.allow()
        self.assertEqual(self.running, 3)

    def test_restart_checks_again(self) -> None:
        """A stored module does not run after a restart if the settings no longer list its operator or its name."""
        manifest, source = self.version(1)
        self.push(manifest, source)
        sys.modules.pop(CANARY)
        for struck in ("operators", "modules"):
            made = self.allow(None, self.stranger, **{struck: ()})
            self.assertEqual((dict(made.running_manifests), made.modules), ({}, {}))
            self.assertNotIn(CANARY, sys.modules)

    def test_damaged_files_never_run(self) -> None:
        """A truncated or changed file is skipped, and the previous edition runs instead."""
        folder = Path(self.mktemp())
        self.deployment = self.allow(FileModuleStore(folder))
        first, source = self.version(1)
        self.push(first, source)
        second, source = self.version(2, first)
        self.push(second, source)
        path = folder / f"best-{second.digest[:16]}.module"
        whole = path.read_bytes()
        sys.modules.pop(CANARY)
        for damaged in (b"", whole[:40], whole[: len(whole) // 2], whole.replace(b"Strategy", b"Strategx")):
            path.write_bytes(damaged)
            for node in (self.operator, self.stranger):
                if node.running:
                    node.stop_silently()
            self.deployment = self.allow(FileModuleStore(folder))
            self.assertEqual(self.running, 1)
        middle = len(whole) // 8
        path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
        self.deployment = self.allow(FileModuleStore(folder))
        self.assertEqual(self.running, 1)

    def test_full_disk_is_told(self) -> None:
        """A module that cannot be stored still runs, and the device reports that its disk is full."""

        def full(source: Path, target: Path) -> None:
            raise OSError(28, "No space left on device")

        folder = Path(self.mktemp())
        self.deployment = self.allow(FileModuleStore(folder, full))
        manifest, source = self.version(1)
        self.push(manifest, source)
        self.assert_refused("cannot store best 1: No space left on device", runs=1)
