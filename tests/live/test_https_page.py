"""Tests of the page over TLS in a real browser that trusts the team's certificates."""

from __future__ import annotations

import json
import signal
from importlib.util import find_spec

from tests.live.node import NodeCase
from tests.live.page import DESK, BrowserCase, pin
from tests.live.page import MISSING as NO_BROWSER
from tests.live.test_https import CODE, SecureNode, asked

MISSING = [*NO_BROWSER, *(name for name in ("OpenSSL", "cryptography") if find_spec(name) is None)]


class HttpsPageTests(BrowserCase, NodeCase):
    if MISSING:
        skip = f"THE PAGE OVER TLS IS NOT TESTED IN A BROWSER: missing {'; '.join(MISSING)}"

    def test_stay_secure_when_the_node_is_lost(self) -> None:
        """The page has camera and service worker; it changes to the HTTPS URL of another node, but never to HTTP."""
        first = SecureNode(self, "vaio")
        second = SecureNode(self, "pi", first.address)
        pins = ",".join(pin(node.port) for node in (first, second))
        self.browser = self.launched(f"--ignore-certificate-errors-spki-list={pins}")
        page = self.tab(DESK, service_workers="allow")
        wanted: list[str] = []
        page.on("request", lambda request: wanted.append(request.url))
        page.goto(f"{first.secure}/#code={CODE}")
        page.locator("#link[data-link=live]").wait_for()
        self.assertTrue(page.evaluate("isSecureContext && !!navigator.mediaDevices?.getUserMedia"))
        self.assertTrue(page.evaluate("navigator.serviceWorker.ready.then(({ active }) => !!active)"))
        page.locator("#standby-nodes", has_text="pi").wait_for()
        told = json.loads(asked(f"{first.plain}/api/v1/node"))["pages"]
        self.assertEqual({each["url"] for each in told}, {first.plain, first.secure, second.plain, second.secure})
        first.process.send_signal(signal.SIGKILL)
        self.wait_for_node(page, "pi")
        self.assertTrue(any(url.startswith(f"{second.secure}/events") for url in wanted))
        self.assertEqual([url for url in wanted if url.startswith("http:")], [])
