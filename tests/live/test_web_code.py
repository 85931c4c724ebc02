"""Tests of a real node with a page: its code for signing in, and its audit log."""

from __future__ import annotations

import json
import time
from importlib.util import find_spec

from tests.live.node import NodeCase
from tests.live.test_https import asked
from tests.live.until import until

MISSING = [name for name in ("flask",) if find_spec(name) is None]


class WebCodeTests(NodeCase):
    if MISSING:
        skip = f"SIGNING IN AT A REAL NODE IS NOT TESTED: missing {', '.join(MISSING)}"

    def test_sign_in_with_what_the_node_says(self) -> None:
        """``swarm web`` prints URL and code, the code signs in, and the next change is recorded in the audit file."""
        web = 'roles = ["web"]\nstore = "vaio.sqlite"\n[web]\nport = 0\n'
        self.node("--config", self.file(f'[node]\nname = "vaio"\nteam_key = "t"\nport = 0\n{web}'))
        page = json.loads(until(lambda: self.swarm("web", "--json").stdout))
        self.assertEqual(page["link"], f"{page['url']}#code={page['code']}")
        self.assertIn(page["link"], self.swarm("web").stdout)
        token = json.loads(asked(f"{page['url']}api/v1/session", None, {"code": page["code"]}))["token"]
        asked(f"{page['url']}api/v1/message", None, {"text": "sit"}, token)
        lines = [json.loads(line) for line in (self.folder / "vaio.sqlite.audit").read_text().splitlines()]
        self.assertEqual([line["route"] for line in lines], ["POST /api/v1/session", "POST /api/v1/message"])
        self.assertEqual((lines[1]["role"], lines[1]["from"], lines[1]["outcome"]), ("operator", "127.0.0.1", "202"))
        self.assertEqual(json.loads(asked(f"{page['url']}api/v1/audit", None, None, token))[0], lines[1])
        self.assertLess(abs(lines[1]["at"] - time.time()), 60.0)
