"""Demonstration: what the tests of the whole demonstration in a real browser share: its processes, and their page."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import urllib.request
from pathlib import Path
from typing import Any

from tests.live.page import BrowserCase

PATIENCE_MS = 30_000


class Demonstration:
    """``python -m sim.demo`` as a child process; ``invitation`` is the address that it prints, with the code."""

    def __init__(self, log: Path, *options: str) -> None:
        with log.open("w", encoding="utf-8") as errors:
            command = [sys.executable, "-m", "sim.demo", "--web-port", "0", *options]
            root = Path(__file__).parents[2]
            self._process = subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, stderr=errors, text=True)
        self.pid = self._process.pid
        assert self._process.stdout is not None
        said = []
        for line in self._process.stdout:
            said.append(line)
            if line.startswith("The page: "):
                break
        else:
            raise AssertionError("".join(said) + log.read_text(encoding="utf-8"))
        threading.Thread(target=self._process.stdout.read, daemon=True).start()
        self.invitation = said[-1].split()[2]
        self.url, _, self.code = self.invitation.partition("#code=")
        self._token = ""
        self._token = self.api("api/v1/session", json.dumps({"code": self.code}).encode())["token"]

    def api(self, path: str, body: bytes | None = None) -> Any:
        """What the page's node answers an operator."""
        headers = {"Content-Type": "application/json", "Authorization": f"Bearer {self._token}"}
        asked = urllib.request.Request(self.url + path, body, headers)
        with urllib.request.urlopen(asked, timeout=5) as answer:
            return json.load(answer)

    def stop(self) -> None:
        """End it, and wait until all its processes are gone."""
        self._process.terminate()
        self._process.wait(20)


class DemonstrationCase(BrowserCase):
    """The demonstration, started with ``options``, and a browser."""

    options: tuple[str, ...] = ()

    def setUp(self) -> None:
        log, run_dir = Path(self.mktemp()), Path(self.mktemp()).absolute()
        self.demo = Demonstration(log, "--run-dir", str(run_dir), *self.options)
        self.addCleanup(self.demo.stop)
        super().setUp()

    def opened(self, screen: dict[str, Any], scheme: Any = "light") -> Any:
        """The page, signed in, when it shows the team."""
        page = self.tab(screen, scheme)
        page.set_default_timeout(PATIENCE_MS)
        page.goto(self.demo.invitation)
        return self.live(page, 4)
