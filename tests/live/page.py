"""Page: what the tests in a real browser share: the screens, the page's server as a child process, and opening it."""

from __future__ import annotations

import base64
import hashlib
import shutil
import ssl
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = [
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--disable-dev-shm-usage"),
]
PHONE = {"viewport": {"width": 412, "height": 839}, "has_touch": True}
TABLET = {"viewport": {"width": 820, "height": 1180}, "has_touch": True}
DESK = {"viewport": {"width": 1280, "height": 800}}
VIEWS = ("tasks", "cameras", "map", "groups", "network", "events", "more", "devices")
PATIENCE_MS = 45_000
"""How long a page is waited for on a machine that has more to do; where it is in time nothing waits for that."""
INFORMED = """async () => {
  const { model } = await import("/static/model.js");
  while (!model.has.includes("invites")) await new Promise((done) => setTimeout(done, 20));
}"""
MISSING = [
    *(() if CHROMIUM else ("the program chromium (apt-get install chromium)",)),
    *(
        f"the Python package {name} (pip install -e '.[browser]')"
        for name in ("playwright", "axe_playwright_python", "cv2", "flask")
        if find_spec(name) is None
    ),
]
SMALL = """[...document.querySelectorAll('button, input, select, nav a')].filter(e => e.offsetParent)
    .filter(e => e.offsetHeight < 44 || e.offsetWidth < 44
        || (e.tagName !== 'INPUT' && e.scrollWidth > e.clientWidth + 1))
    .map(e => e.outerHTML)"""
"""What a finger does not hit, or is cut off."""


def pin(port: int) -> str:
    """What Chromium is told to trust: the hash of the public key of the certificate that is served there."""
    from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
    from cryptography.x509 import load_pem_x509_certificate

    served = load_pem_x509_certificate(ssl.get_server_certificate(("127.0.0.1", port)).encode())
    key = served.public_key().public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    return base64.b64encode(hashlib.sha256(key).digest()).decode()


class Team:
    """The page's server as a child process; ``order`` changes what it shows."""

    def __init__(self, port: int = 0) -> None:
        root = Path(__file__).parents[2]
        command = [sys.executable, "-m", "tests.live.team", str(port)]
        self._process = subprocess.Popen(command, cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        found, self.code, self.token, self.ticket = self._line().split()
        self.port = int(found)
        self.url = f"http://127.0.0.1:{self.port}/"
        self.pid = self._process.pid

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()

    def order(self, words: str) -> None:
        """Give an order; ``freeze`` is not waited for."""
        assert self._process.stdin is not None
        self._process.stdin.write(words + "\n")
        self._process.stdin.flush()
        if not words.startswith("freeze"):
            self._line()

    def stop(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.communicate()


class BrowserCase(SynchronousTestCase):
    """A browser; ``faults`` are the errors of its pages, ``asked`` the addresses that the newest one asked for."""

    if MISSING:
        skip = f"THE PAGE IS NOT TESTED IN A BROWSER: missing {'; '.join(MISSING)}"

    def setUp(self) -> None:
        from playwright.sync_api import sync_playwright

        super().setUp()
        play = sync_playwright().start()
        self.addCleanup(play.stop)
        self.browser = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        self.addCleanup(self.browser.close)
        self.asked: list[str] = []
        self.faults: list[str] = []

    def tab(self, screen: dict[str, Any], scheme: Any = "light") -> Any:
        """An empty page on that screen, in a session of its own."""
        context = self.browser.new_context(**screen, color_scheme=scheme, reduced_motion="reduce")
        self.addCleanup(context.close)
        page = context.new_page()
        page.set_default_timeout(PATIENCE_MS)
        self.asked = []
        page.on("request", lambda request: self.asked.append(request.url))
        page.on("pageerror", lambda error: self.faults.append(str(error)))
        return page

    def live(self, page: Any, devices: int = 3) -> Any:
        """The page, when it shows so many devices of the team."""
        page.locator("#link[data-link=live]").wait_for()
        page.locator(".device").nth(devices - 1).wait_for(state="attached")
        return page

    def informed(self, page: Any) -> Any:
        """The page, when it knows what its node has; that takes the place of what was there before."""
        page.evaluate(INFORMED)
        return page

    def view(self, page: Any, name: str) -> None:
        """Look at a view, as a link to it does."""
        page.evaluate(f"location.hash = {name!r}")
        page.locator(f"body[data-view={name}]").wait_for()

    def told(self, page: Any, words: str) -> None:
        """Wait until the page says so."""
        page.locator("#line", has_text=words).wait_for()

    def tab_to(self, page: Any, what: str) -> None:
        """Go there by the Tab key alone."""
        for _ in range(90):
            if page.evaluate(f"document.activeElement.matches({what!r})"):
                return
            page.keyboard.press("Tab")
        self.fail(f"no way to {what} by keyboard")

    def sound(self, page: Any) -> None:
        """Axe finds nothing in what stands there now, nothing is wider than the screen, cut off or too small."""
        from axe_playwright_python.sync_playwright import Axe

        where = page.evaluate("`${innerWidth} ${location.hash}`")
        found = Axe().run(page).response["violations"]
        self.assertEqual([(each["id"], each["nodes"][0]["html"]) for each in found], [], where)
        self.assertLessEqual(page.evaluate("document.documentElement.scrollWidth - innerWidth"), 0, where)
        self.assertEqual((page.evaluate(SMALL), self.faults), ([], []), where)


class TeamCase(SynchronousTestCase):
    """The page of the team of ``tests.live.team``."""

    def setUp(self) -> None:
        super().setUp()
        self.team = Team()
        self.addCleanup(lambda: self.team.stop())


class PageCase(BrowserCase, TeamCase):
    """Such a page, and a browser."""

    def note(self, words: Any) -> None:
        """Take note of what the page's console calls an error, and of where it comes from."""
        if words.type == "error":
            self.faults.append(f"{words.text} {words.location['url']}")

    def opened(self, screen: dict[str, Any], scheme: Any = "light") -> Any:
        """The page, signed in, when it shows the team."""
        page = self.tab(screen, scheme)
        page.on("console", self.note)
        page.goto(f"{self.team.url}#code={self.team.code}")
        return self.live(page)
