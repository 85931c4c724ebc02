"""Tests of the measurements that need no network: settings, files and interfaces."""

from __future__ import annotations

import os
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from middleware.config.settings import Settings
from swarmnode.doctor.measure import measure_facts


class MeasureTests(SynchronousTestCase):
    """Tests of ``measure_facts`` on the loopback interface, without packets to other machines."""

    def setUp(self) -> None:
        self.folder = Path(self.mktemp()).absolute()
        self.folder.mkdir()
        self.file = self.folder / "a.toml"

    def settings(self, **node: object) -> Settings:
        """Return settings with the content of a file."""
        self.file.touch(mode=0o600)
        return Settings.from_mapping({"node": {"name": "a", "team_key": "k", **node}}, str(self.file))

    def test_well(self) -> None:
        """For a node whose folder and files are private, no problem is measured."""
        facts = measure_facts(self.settings(store="a.sqlite"))
        assert facts.storage is not None
        self.assertEqual((facts.storage.problem, facts.open_files, facts.lan, facts.known), ("", (), None, ()))
        self.assertIn("127.0.0.1", facts.own_addresses)

    def test_nobody_at_a_port_of_this_machine(self) -> None:
        """A closed port is distinguished from a silent one."""
        facts = measure_facts(self.settings(port=0, known_nodes=["127.0.0.1:9"]))
        self.assertEqual([probe.error for probe in facts.known], ["refused"])

    def test_open_files(self) -> None:
        """A settings file with a key, and a store, are each listed with the file mode if other users can read them."""
        settings = self.settings(store="a.sqlite")
        (self.folder / "a.sqlite").touch(mode=0o600)
        os.chmod(self.folder / "a.sqlite", 0o640)
        os.chmod(self.file, 0o644)
        self.assertEqual(
            set(measure_facts(settings).open_files), {(str(self.folder / "a.sqlite"), 0o640), (str(self.file), 0o644)}
        )

    def test_store(self) -> None:
        """A missing folder of the store, and a folder at the store's path, are reported.

        A store in memory has no file, so nothing is reported.
        """
        missing = measure_facts(self.settings(store="nowhere/a.sqlite")).storage
        (self.folder / "b.sqlite").mkdir()
        folder = measure_facts(self.settings(store="b.sqlite")).storage
        assert missing is not None and folder is not None
        self.assertIn("does not exist", missing.problem)
        self.assertIn("It is a folder", folder.problem)
        self.assertIsNone(measure_facts(self.settings()).storage)
