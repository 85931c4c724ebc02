"""Tests of the page against its OpenAPI document: Schemathesis sends valid and invalid requests to each route."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import urllib.request
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from tests.live.page import TeamCase

MISSING = [name for name in ("schemathesis", "flask", "cv2") if find_spec(name) is None]
# Streams, which do not end, and long polls, which last five seconds, are tested separately.
STREAMS = ("/events", "/shot/{uuid}")
# This request ends the session, so all later requests would fail.
SIGNING_OUT = "delete_session"
CHECKS = ("not_a_server_error", "status_code_conformance", "content_type_conformance", "response_schema_conformance")
KNOWN = {"uuid": ["01" * 16, "02" * 16, "99"], "task_id": ["t1", "t9"]}
"""Ids of existing objects, and one of a missing object, because random ids match no object.  The third dog does not
reply, so the page returns 504."""
LIMIT_S = 170


class ContractTests(TeamCase):
    if MISSING:
        skip = f"THE API IS NOT TESTED AGAINST ITS DOCUMENT: missing {', '.join(MISSING)} (make contract)"

    def test_keep_to_the_document(self) -> None:
        """For any request, each route responds as documented, and never with a 5xx status."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "openapi.json"
            path.write_text(json.dumps(self.document()), encoding="utf-8")
            command = [sys.executable, "-m", "schemathesis.cli", "run", str(path), "--url", self.team.url]
            command += ["-H", f"Authorization: Bearer {self.team.token}", "--phases", "examples,coverage,fuzzing"]
            command += ["--max-examples", "20", "--checks", ",".join(CHECKS), "--workers", "1", "--seed", "1"]
            command += ["--exclude-operation-id", SIGNING_OUT, "--request-timeout", "10", "--no-color"]
            for stream in STREAMS:
                command += ["--exclude-path", stream]
            found = subprocess.run(
                command, cwd=Path(folder), capture_output=True, text=True, timeout=LIMIT_S, check=False
            )
        self.assertEqual(found.returncode, 0, found.stdout[-6000:] + found.stderr[-2000:])
        counts = re.search(r"(\d+) generated, (\d+) passed", found.stdout)
        assert counts is not None, found.stdout
        self.assertEqual(counts[1], counts[2])
        self.assertGreater(int(counts[1]), 400)

    def document(self) -> Any:
        """Return the node's OpenAPI document; for ``KNOWN`` fields it allows existing and non-existing names."""
        address = f"{self.team.url}api/v1/openapi.json?ticket={self.team.ticket}"
        with urllib.request.urlopen(address, timeout=10) as answer:
            document = json.load(answer)
        for methods in document["paths"].values():
            for operation in methods.values():
                for each in operation["parameters"]:
                    if each["name"] in KNOWN:
                        each["schema"]["enum"] = KNOWN[each["name"]]
        return document
