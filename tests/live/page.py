"""Shared parts of the tests in a real browser: screens, the page's server as a child process, and opened pages.

A browser, its driver and the program that serves teams start slowly, so each process starts them once and reuses them.
(A class fixture would be created for each test, because ``trial -j`` distributes single tests.) Each test has its own
browser context and team.
"""

from __future__ import annotations

import asyncio
import atexit
import base64
import hashlib
import os
import shutil
import signal
import ssl
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from tests.webnode.texts import catalogue

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = [
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--disable-dev-shm-usage"),
]
DISC = 66
"""The diameter of the red disc in the camera's picture, in pixels of a picture that is 104 pixels wide."""
PHONE = {"viewport": {"width": 412, "height": 839}, "has_touch": True}
TABLET = {"viewport": {"width": 820, "height": 1180}, "has_touch": True}
DESK = {"viewport": {"width": 1280, "height": 800}}
VIEWS = ("tasks", "cameras", "map", "groups", "network", "events", "more", "devices")
TEXTS = catalogue("en")
"""The texts that the page shows in the tests' browser."""
PATIENCE_MS = 45_000
"""The timeout of a wait, for a loaded machine; a wait ends as soon as its condition is true."""
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
    .map(e => e.type === 'checkbox' ? e.closest('label') ?? e : e)
    .filter(e => e.offsetHeight < 44 || e.offsetWidth < 44
        || (e.tagName !== 'INPUT' && e.scrollWidth > e.clientWidth + 1))
    .map(e => e.outerHTML)"""
"""Elements that are too small to touch, or cut off."""


def pin(port: int) -> str:
    """Return the hash of the public key of the certificate at this port, for Chromium to trust."""
    from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
    from cryptography.x509 import load_pem_x509_certificate

    served = load_pem_x509_certificate(ssl.get_server_certificate(("127.0.0.1", port)).encode())
    key = served.public_key().public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    return base64.b64encode(hashlib.sha256(key).digest()).decode()


def film(path: Path) -> Path:
    """Write a video for the fake camera: a red disc, 320 x 240 pixels, that trembles slightly."""
    import cv2
    import numpy as np

    with path.open("wb") as file:
        for n in range(30):
            picture = np.full((240, 320, 3), (190, 200, 205), np.uint8)
            picture[150:] = (90, 120, 130)
            cv2.circle(picture, (160 + n % 3, 120), round(DISC / 104 * 320 / 2), (40, 40, 210), -1)
            file.write(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())
    return path


class Chromium:
    """The browser's driver, and a browser with a fake camera that plays a video.

    A browser context without permission has no camera. Between two calls the driver marks the thread as running an
    event loop. Tests without a browser run their own event loops, so the mark is removed when no test uses the driver.
    """

    def __init__(self) -> None:
        from playwright.sync_api import sync_playwright

        self._driver = sync_playwright().start()
        self._loop = asyncio.get_running_loop()
        self._folder = tempfile.TemporaryDirectory()
        atexit.register(self._end)
        self._film = film(Path(self._folder.name) / "film.mjpeg")
        self.browser = self.launched("--host-resolver-rules=MAP vaio.local 127.0.0.1")

    def launched(self, *flags: str) -> Any:
        """Start a browser with additional flags."""
        camera = ("--use-fake-device-for-media-stream", f"--use-file-for-fake-video-capture={self._film}")
        return self._driver.chromium.launch(executable_path=CHROMIUM, args=[*FLAGS, *camera, *flags])

    def resume(self) -> None:
        """Prepare the browser for a test."""
        asyncio._set_running_loop(self._loop)
        if not self.browser.is_connected():
            self.browser = self.launched("--host-resolver-rules=MAP vaio.local 127.0.0.1")

    def pause(self) -> None:
        """Release the browser after a test."""
        asyncio._set_running_loop(None)

    def _end(self) -> None:
        asyncio._set_running_loop(self._loop)
        self.browser.close()
        self._driver.stop()
        self._folder.cleanup()


@cache
def chromium() -> Chromium:
    """Return the browser that all tests of this process share."""
    return Chromium()


class Team:
    """A team and its page, served by a child process; ``order`` changes the content of the page."""

    _idle: list[subprocess.Popen[str]] = []
    """Processes that are running but serve no team now."""

    def __init__(self, port: int = 0) -> None:
        self._process = Team._idle.pop() if Team._idle else self._started()
        self.pid = self._process.pid
        found, self.code, self.token, self.ticket = self.order(f"team {port}").split()
        self.port = int(found)
        self.url = f"http://127.0.0.1:{self.port}/"

    @staticmethod
    def _started() -> subprocess.Popen[str]:
        root = Path(__file__).parents[2]
        command = [sys.executable, "-m", "tests.live.team"]
        process = subprocess.Popen(command, cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        atexit.register(process.wait)
        atexit.register(process.kill)
        return process

    def order(self, words: str) -> str:
        """Send a command to the child process, wait until it is executed, and return the reply."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(words + "\n")
        self._process.stdin.flush()
        return self._process.stdout.readline()

    def freeze(self) -> None:
        """Suspend the process; its port stays open."""
        os.kill(self.pid, signal.SIGSTOP)

    def thaw(self) -> None:
        """Resume the process."""
        os.kill(self.pid, signal.SIGCONT)

    def stop(self) -> None:
        """Kill the process."""
        self._process.kill()
        self._process.communicate()

    def end(self) -> None:
        """Close the page; the process can then serve another team."""
        if self._process.poll() is None:
            self.thaw()
            if self.order("end"):
                Team._idle.append(self._process)
            else:
                self.stop()


class BrowserCase(SynchronousTestCase):
    """A test with a browser.

    ``faults`` are the errors on its pages, ``asked`` the URLs that the newest page has requested.
    """

    if MISSING:
        skip = f"THE PAGE IS NOT TESTED IN A BROWSER: missing {'; '.join(MISSING)}"

    def setUp(self) -> None:
        super().setUp()
        shared = chromium()
        shared.resume()
        self.addCleanup(shared.pause)
        self.browser = shared.browser
        self.asked: list[str] = []
        self.faults: list[str] = []

    def launched(self, *flags: str) -> Any:
        """Return a separate browser for this test, with additional flags."""
        browser = chromium().launched(*flags)
        self.addCleanup(browser.close)
        return browser

    def tab(self, screen: dict[str, Any], scheme: Any = "light", **more: Any) -> Any:
        """Return an empty page on a screen of this kind, in a new session.

        The service worker would load all files again, so it is blocked unless ``service_workers="allow"`` is given.
        """
        more = {"service_workers": "block", **more}
        context = self.browser.new_context(**screen, color_scheme=scheme, reduced_motion="reduce", **more)
        self.addCleanup(context.close)
        page = context.new_page()
        page.set_default_timeout(PATIENCE_MS)
        self.asked = []
        page.on("request", lambda request: self.asked.append(request.url))
        page.on("pageerror", lambda error: self.faults.append(str(error)))
        return page

    def wait_for_node(self, page: Any, name: str) -> None:
        """Wait until the page is connected to the web node ``name``."""
        page.locator("#node", has_text=name).wait_for()
        page.locator("#link[data-link=live]").wait_for()

    def live(self, page: Any, devices: int = 3) -> Any:
        """Wait until the page shows this number of devices, then return the page."""
        page.locator("#link[data-link=live]").wait_for()
        page.locator(".device").nth(devices - 1).wait_for(state="attached")
        return page

    def informed(self, page: Any) -> Any:
        """Wait until the page has received its node's features, on which its content depends, then return the page."""
        page.evaluate(INFORMED)
        return page

    def view(self, page: Any, name: str) -> None:
        """Open a view by following its link."""
        page.evaluate(f"location.hash = {name!r}")
        page.locator(f"body[data-view={name}]").wait_for()

    def floor(self, page: Any) -> Callable[[float, float], tuple[float, float]]:
        """Return a function that converts metres on the map to pixels on the screen."""
        box = page.locator(".floor").bounding_box()
        return lambda x, y: (box["x"] + box["width"] * x / 3.0, box["y"] + box["height"] * (1 - y / 2.4))

    def pass_by(self, page: Any, seconds: float) -> None:
        """Advance the page's clock; wait until the page has sent all requests that are due by then."""
        page.clock.fast_forward(1000 * seconds)
        page.evaluate("fetch('/api/v1/node').then((told) => told.text())")

    def told(self, page: Any, words: str) -> None:
        """Wait until the page shows this message."""
        page.locator("#status-line", has_text=words).wait_for()

    def tab_to(self, page: Any, what: str) -> None:
        """Move the focus to an element with the Tab key."""
        for _ in range(90):
            if page.evaluate(f"document.activeElement.matches({what!r})"):
                return
            page.keyboard.press("Tab")
        self.fail(f"no way to {what} by keyboard")

    def sound(self, page: Any) -> None:
        """Check that axe finds no violation, and that no element is too wide, too small or cut off."""
        from axe_playwright_python.sync_playwright import Axe

        where = page.evaluate("`${innerWidth} ${location.hash}`")
        found = Axe().run(page).response["violations"]
        self.assertEqual([(each["id"], each["nodes"][0]["html"]) for each in found], [], where)
        self.assertLessEqual(page.evaluate("document.documentElement.scrollWidth - innerWidth"), 0, where)
        self.assertEqual((page.evaluate(SMALL), self.faults), ([], []), where)

    def sound_by_day_and_night(self, page: Any) -> None:
        """Check the page in light and in dark colours."""
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)
            self.sound(page)


class TeamCase(SynchronousTestCase):
    """A test of the page of a team of ``tests.live.team``."""

    def setUp(self) -> None:
        super().setUp()
        self.team = Team()
        self.addCleanup(lambda: self.team.end())


class PageCase(BrowserCase, TeamCase):
    """A test of the page of a team with a browser."""

    def note(self, words: Any) -> None:
        """Record an error on the page's console, with the source of the error."""
        if words.type == "error":
            self.faults.append(f"{words.text} {words.location['url']}")

    def opened(self, screen: dict[str, Any], scheme: Any = "light", has_clock: bool = False) -> Any:
        """Return the page after it has signed in and shows the team.

        With ``has_clock``, ``pass_by`` advances its time.
        """
        page = self.tab(screen, scheme)
        page.on("console", self.note)
        if has_clock:
            page.clock.install()
        page.goto(f"{self.team.url}#code={self.team.code}")
        return self.live(page)
