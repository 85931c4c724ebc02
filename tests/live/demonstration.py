"""Test cases with the whole demonstration: its processes, and its page in a real browser."""

from __future__ import annotations

import json
import os
import signal
import ssl
import subprocess
import sys
import threading
import urllib.request
from pathlib import Path
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from benchmarks.demo import list_descendants
from tests.live.page import BrowserCase

PATIENCE_MS = 120_000
"""The timeout of a wait, for a loaded machine."""


class Demonstration:
    """The process ``python -m sim.demo``; ``invitation`` is the URL with the join code that it prints.

    With ``is_secure`` the page is also served over TLS, and the invitation is its HTTPS URL.
    """

    def __init__(self, log: Path, *options: str, is_secure: bool = False) -> None:
        with log.open("w", encoding="utf-8") as errors:
            # The page is the same for all kinds of robots, so the tests use simulated dogs, which need the fewest
            # resources.
            command = [sys.executable, "-m", "sim.demo", "--robot", "sim", "--web-port", "0", *options]
            command += ["--tls"] if is_secure else []
            root = Path(__file__).parents[2]
            self._process = subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, stderr=errors, text=True)
        self.pid = self._process.pid
        # Other tests verify the certificate; here TLS is only needed to get access to the camera.
        self._trust = ssl.create_default_context()
        self._trust.check_hostname, self._trust.verify_mode = False, ssl.CERT_NONE
        self._token = ""
        try:
            self.invitation = self._invitation("Over TLS: " if is_secure else "The page: ", log)
            url, _, self.code = self.invitation.partition("#code=")
            self.sign_in(url)
        except BaseException:
            self.stop()
            raise

    def _invitation(self, begins: str, log: Path) -> str:
        """Return the URL in the line that starts with ``begins``."""
        assert self._process.stdout is not None
        said = []
        for line in self._process.stdout:
            said.append(line)
            if line.startswith(begins):
                break
            if line.startswith("If its node fails"):
                raise AssertionError("".join(said))  # no URL follows this line
        else:
            raise AssertionError("".join(said) + log.read_text(encoding="utf-8"))
        threading.Thread(target=self._process.stdout.read, daemon=True).start()
        return said[-1].split()[2]

    def sign_in(self, url: str) -> None:
        """Send all further requests to the node that serves the page at ``url``."""
        self.url = url
        self._token = self.api("session", {"code": self.code})["token"]

    def api(self, path: str, body: Any = None) -> Any:
        """Return the response to an operator's request to the page's node; ``body`` is sent as JSON."""
        headers = {"Content-Type": "application/json", "Authorization": f"Bearer {self._token}"}
        data = None if body is None else json.dumps(body).encode()
        asked = urllib.request.Request(f"{self.url}api/v1/{path}", data, headers)
        with urllib.request.urlopen(asked, timeout=20, context=self._trust) as answer:
            return json.load(answer)

    def send_signal(self, name: str, how: signal.Signals) -> int:
        """Send a signal to the process of the node ``name``; return the id of that process."""
        pid = next(pid for pid, each in list_descendants(self.pid).items() if each == name)
        os.kill(pid, how)
        return pid

    def stop(self) -> None:
        """Stop the demonstration, and wait until all its processes have ended."""
        self._process.terminate()
        self._process.wait(20)


class DemonstrationCase(SynchronousTestCase):
    """A test of the demonstration, started with ``options``, and with TLS if ``is_secure`` is set."""

    options: tuple[str, ...] = ()
    is_secure = False

    def setUp(self) -> None:
        super().setUp()
        log, run_dir = Path(self.mktemp()), Path(self.mktemp()).absolute()
        self.demo = Demonstration(log, "--run-dir", str(run_dir), *self.options, is_secure=self.is_secure)
        self.addCleanup(self.demo.stop)


class DemonstrationPageCase(BrowserCase, DemonstrationCase):
    """A test of the demonstration with a browser."""

    def opened(self, screen: dict[str, Any], scheme: Any = "light") -> Any:
        """Return the page after it has signed in and shows the team."""
        page = self.tab(screen, scheme)
        page.set_default_timeout(PATIENCE_MS)
        page.goto(self.demo.invitation)
        return self.live(page, 4)
