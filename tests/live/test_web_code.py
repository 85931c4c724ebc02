"""A real node with a page: it says how to sign in, takes who does, and writes down what was changed."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
import urllib.request
from importlib.util import find_spec
from typing import Any

from tests.live.test_bad_input import PATIENCE_S, ROOT, LiveTests
from tests.live.until import until

MISSING = [name for name in ("flask",) if find_spec(name) is None]


class WebCodeTests(LiveTests):
    if MISSING:
        skip = f"SIGNING IN AT A REAL NODE IS NOT TESTED: missing {', '.join(MISSING)}"

    def swarm_web(self, runtime: str, *words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", "from swarmnode.command import main; raise SystemExit(main())", "web", *words]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_RUNTIME_DIR": runtime}
        return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False)

    def asked(self, url: str, body: object = None, token: str = "") -> Any:
        data = None if body is None else json.dumps(body).encode()
        headers = {"Content-Type": "application/json", **({"Authorization": f"Bearer {token}"} if token else {})}
        with urllib.request.urlopen(urllib.request.Request(url, data, headers), timeout=10) as answer:
            return json.load(answer)

    def test_sign_in_with_what_the_node_says(self) -> None:
        """``swarm web`` tells page and code, the code signs in, and the order given then stands in the audit's file."""
        # Short, as a UNIX socket's path has little room.
        runtime = tempfile.TemporaryDirectory(prefix="swarm", dir="/tmp")
        self.addCleanup(runtime.cleanup)
        self.patch(os, "environ", {**os.environ, "XDG_RUNTIME_DIR": runtime.name})
        child = self.start(
            "--config",
            self.file(
                '[node]\nname = "vaio"\nteam_key = "t"\nport = 0\nroles = ["web"]\n'
                'store = "vaio.sqlite"\n[web]\nport = 0\n'
            ),
        )
        self.addCleanup(child.communicate)
        self.addCleanup(child.terminate)
        page = json.loads(until(lambda: self.swarm_web(runtime.name, "--json").stdout))
        self.assertEqual(page["link"], f"{page['url']}#code={page['code']}")
        self.assertIn(page["link"], self.swarm_web(runtime.name).stdout)
        token = self.asked(f"{page['url']}api/v1/session", {"code": page["code"]})["token"]
        self.asked(f"{page['url']}api/v1/message", {"text": "sit"}, token)
        lines = [json.loads(line) for line in (self.folder / "vaio.sqlite.audit").read_text().splitlines()]
        self.assertEqual([line["route"] for line in lines], ["POST /api/v1/session", "POST /api/v1/message"])
        self.assertEqual((lines[1]["role"], lines[1]["from"], lines[1]["outcome"]), ("operator", "127.0.0.1", "202"))
        self.assertEqual(self.asked(f"{page['url']}api/v1/audit", None, token)[0], lines[1])
        self.assertLess(abs(lines[1]["at"] - time.time()), 60.0)

    def test_let_nobody_open_the_page_to_all(self) -> None:
        """A page open to the network without signing in is refused in one line, and so is a password in plain text."""
        for web, words in (
            ('host = "0.0.0.0"\nsign_in = false\n', "[web] sign_in"),
            ('password = "correct horse"\n', "[web] password"),
        ):
            path = self.file(f'[node]\nname = "a"\nteam_key = "t"\nport = 0\nroles = ["web"]\n[web]\nport = 0\n{web}')
            self.assert_says(self.refused("--config", path), path, words)
