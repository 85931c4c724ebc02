"""Tests of ``swarm schema``."""

from __future__ import annotations

import io
import json
from dataclasses import fields

from twisted.trial.unittest import SynchronousTestCase

from middleware.config.settings import TABLES
from swarmnode.command import main


class SchemaTests(SynchronousTestCase):
    """The schema describes the settings."""

    def test_has_every_setting(self) -> None:
        """Each table lists exactly its keys with their bounds; only the name is required."""
        out = io.StringIO()
        self.patch(__import__("sys"), "stdout", out)
        self.assertEqual(main(["schema"]), 0)
        known = json.loads(out.getvalue())["$defs"]
        for name, table in TABLES.items():
            self.assertEqual(list(known[name]["properties"]), [each.name for each in fields(table)])
            self.assertFalse(known[name]["additionalProperties"])
        self.assertEqual(known["node"]["required"], ["name"])
        self.assertEqual(known["node"]["properties"]["port"]["maximum"], 65535)
        self.assertEqual(known["web"]["properties"]["tls"]["enum"], ["", "auto"])
