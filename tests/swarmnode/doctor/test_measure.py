"""Tests of what can be measured without a network: settings, files and this machine's tables."""

from __future__ import annotations

import os
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from middleware.config.settings import Settings
from swarmnode.doctor.measure import measured


class MeasureTests(SynchronousTestCase):
    """Behaviour of ``measured`` at the loopback, where nothing is sent to anybody else."""

    def setUp(self) -> None:
        self.folder = Path(self.mktemp()).absolute()
        self.folder.mkdir()
        self.file = self.folder / "a.toml"

    def settings(self, **node: object) -> Settings:
        """The settings in a file."""
        self.file.touch(mode=0o600)
        return Settings.from_mapping({"node": {"name": "a", "team_key": "k", **node}}, str(self.file))

    def test_well(self) -> None:
        """A node in a folder of its own, with a file that only its owner reads, has nothing to be said of."""
        facts = measured(self.settings(store="a.sqlite"))
        assert facts.storage is not None
        self.assertEqual((facts.storage.problem, facts.open_files, facts.lan, facts.known), ("", (), None, ()))
        self.assertIn("127.0.0.1", facts.own)

    def test_nobody_at_a_port_of_this_machine(self) -> None:
        """A port that is closed is told from one that is silent."""
        facts = measured(self.settings(port=0, known_nodes=["127.0.0.1:9"]))
        self.assertEqual([probe.error for probe in facts.known], ["refused"])

    def test_open_files(self) -> None:
        """Settings with a key in them, and a store, that others can read are noted with their modes."""
        settings = self.settings(store="a.sqlite")
        (self.folder / "a.sqlite").touch(mode=0o600)
        os.chmod(self.folder / "a.sqlite", 0o640)
        os.chmod(self.file, 0o644)
        self.assertEqual(
            set(measured(settings).open_files), {(str(self.folder / "a.sqlite"), 0o640), (str(self.file), 0o644)}
        )

    def test_store(self) -> None:
        """A folder that is not there, and a folder where the file should be, are named; memory has no file."""
        missing = measured(self.settings(store="nowhere/a.sqlite")).storage
        (self.folder / "b.sqlite").mkdir()
        folder = measured(self.settings(store="b.sqlite")).storage
        assert missing is not None and folder is not None
        self.assertIn("does not exist", missing.problem)
        self.assertIn("It is a folder", folder.problem)
        self.assertIsNone(measured(self.settings()).storage)
