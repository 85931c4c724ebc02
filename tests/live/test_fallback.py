"""Tests of the page's fallback to another web node when its own node is killed, freezes or stops."""

from __future__ import annotations

import os
import signal
from typing import Any

from tests.live.demonstration import DemonstrationPageCase
from tests.live.page import DESK, TEXTS, BrowserCase, Team

NAMES = ("vaio", "pi")
CAMERAS = "figure[data-camera=live]"
KEPT = """async () => {
  await navigator.serviceWorker.ready;
  const shell = await caches.open("swarm.shell");
  while (!await shell.match("/")) await new Promise((done) => setTimeout(done, 50));
}"""
"""Wait until the browser has cached the page with all its files."""


class FallbackTests(BrowserCase):
    def setUp(self) -> None:
        super().setUp()
        self.webs = [Team() for _ in NAMES]
        urls = [f"{name}={web.url[:-1]}" for name, web in zip(NAMES, self.webs, strict=True)]
        for name, web, pages in zip(NAMES, self.webs, (urls, urls[::-1]), strict=True):
            self.addCleanup(web.end)
            web.order(f"name {name}")
            web.order(f"pages {' '.join(pages)}")
        self.page = self.tab(DESK, service_workers="allow")

    def tearDown(self) -> None:
        self.assertEqual(self.faults, [])

    def served(self, name: str, page: Any = None) -> None:
        """Wait until the page is live, served by ``name``, and shows three cameras."""
        page = page or self.page
        self.wait_for_node(page, name)
        page.locator(CAMERAS).nth(2).wait_for()

    def opened(self) -> None:
        self.page.goto(f"{self.webs[0].url}#code={self.webs[0].code}")
        self.served("vaio")
        self.page.locator("#standby-nodes", has_text="reserve").wait_for()

    def pid(self, place: int) -> int:
        return self.webs[place].pid

    def lose(self, how: signal.Signals) -> None:
        """Send the signal to the serving node; wait until the page is live at the other node."""
        os.kill(self.pid(0), how)
        self.wait_for_node(self.page, "pi")

    def test_go_on_after_a_crash(self) -> None:
        """After a SIGKILL the page is live at the other node, in the same view, and sends its requests to that node."""
        self.opened()
        self.page.locator(".device", has_text="dog2").dblclick()
        self.page.locator("#d-text").fill("half a sentence")
        self.lose(signal.SIGKILL)
        self.assertTrue(self.page.url.endswith("#device/" + "02" * 16))
        self.assertEqual(self.page.locator("#d-text").input_value(), "half a sentence")
        self.page.locator("#d-message button").click()
        self.page.locator("#d-result", has_text="sent").wait_for()
        self.page.locator("#d-close").click()
        self.served("pi")
        self.page.locator("#status-line", has_text="pi serves the page").wait_for()
        self.webs[1].order("status dog3 IDLE")
        self.page.locator(".device[data-state=IDLE]", has_text="dog3").wait_for()

    def test_go_on_after_a_freeze(self) -> None:
        """After a SIGSTOP, when the frozen node still accepts connections, the page uses the other node."""
        self.opened()
        os.kill(self.pid(0), signal.SIGSTOP)
        self.page.locator("#demo").click()
        self.wait_for_node(self.page, "pi")
        self.page.locator("#status-line", has_text=TEXTS["demo.runs"]).wait_for()
        self.served("pi")

    def test_go_past_an_impostor(self) -> None:
        """A listed web node without the role gateway gets no requests and no token; no URL contains a token."""
        eve = Team()
        self.addCleanup(eve.end)
        eve.order("name eve")
        urls = [f"{name}={web.url[:-1]}" for name, web in (("vaio", self.webs[0]), ("eve", eve), ("pi", self.webs[1]))]
        self.webs[0].order(f"pages {' '.join(urls)}")
        shown: list[tuple[str, str]] = []
        self.page.on("request", lambda request: shown.append((request.url, request.headers.get("authorization", ""))))
        self.opened()
        held = self.page.evaluate("JSON.parse(localStorage.getItem('swarm.sessions'))")
        self.assertEqual(sorted(held), sorted(web.url[:-1] for web in self.webs))
        self.lose(signal.SIGSTOP)
        self.served("pi")
        self.page.locator("#demo").click()
        self.page.locator("#status-line", has_text=TEXTS["demo.runs"]).wait_for()
        self.assertEqual([url for url, _ in shown if url.startswith(eve.url)], [])
        tokens = {url: session["token"] for url, session in held.items()}
        for url, token in tokens.items():
            self.assertEqual([asked for asked, _ in shown if token in asked], [])
            strays = [asked for asked, header in shown if token in header and not asked.startswith(f"{url}/")]
            self.assertEqual(strays, [])

    def test_new_task_is_asked_for_again(self) -> None:
        """A task sent to a frozen node is sent again to the other node, with the same idempotency key."""
        self.opened()
        keys: list[str] = []

        def note(request: Any) -> None:
            if request.method == "POST" and request.url.endswith("/api/v1/tasks"):
                keys.append(request.headers["idempotency-key"])

        self.page.on("request", note)
        self.page.locator("#task option").first.wait_for(state="attached")
        os.kill(self.pid(0), signal.SIGSTOP)
        with self.page.expect_response(f"{self.webs[1].url}api/v1/tasks") as answered:
            self.page.locator("#assign button").click()
        self.assertEqual(answered.value.status, 202)
        self.served("pi")
        self.assertEqual((len(keys), len(set(keys))), (2, 1))

    def test_keep_all_or_nothing(self) -> None:
        """The page is cached as a whole, because with a single cached file it would open without the other files."""
        self.opened()
        self.page.evaluate(KEPT)
        held = "async () => (await (await caches.open('swarm.shell')).keys()).length"
        files = self.page.evaluate("fetch('/static/files.json').then((told) => told.json())")
        self.assertGreaterEqual(self.page.evaluate(held), len(files) + 1)
        self.page.evaluate("caches.delete('swarm.shell')")
        for path in ("/", files[0]):
            self.page.evaluate("path => fetch(path).then((told) => told.text())", path)
        self.page.wait_for_timeout(300)
        self.assertEqual(self.page.evaluate(held), 0)

    def test_open_while_the_node_is_gone(self) -> None:
        """A cached page opens at the URL of a failed node, and finds the other node."""
        self.opened()
        # The page is cached with all its files or not at all.
        self.page.evaluate(KEPT)
        os.kill(self.pid(0), signal.SIGKILL)
        self.page.reload()
        self.served("pi")
        kept = self.page.evaluate(
            "caches.open('swarm.shell').then(c => c.keys()).then(k => k.map(r => new URL(r.url).pathname))"
        )
        self.page.evaluate("location.hash = 'phone'")
        self.page.locator("#place-phone").get_by_role("button", name="Take part").wait_for()
        self.assertEqual([path for path in kept if path != "/" and not path.startswith("/static/")], [])


class DemonstrationFallbackTests(DemonstrationPageCase):
    """Experiment 2 of the thesis with the real team, and additionally a failure of the web node."""

    options = ("--web-port", "0")

    def test_experiment_2_and_the_web_node(self) -> None:
        """The acting dog is killed and the page's node frozen; page and task continue.

        Then the other web node is killed.
        """
        page = self.opened(DESK)
        page.locator("#standby-nodes", has_text="pi").wait_for()
        page.locator("#demo").click()
        going = page.locator(".device[data-state=EXECUTING] b")
        going.wait_for()
        dog = going.inner_text()
        self.demo.send_signal(dog, signal.SIGKILL)
        frozen = self.demo.send_signal("vaio", signal.SIGSTOP)
        self.wait_for_node(page, "pi")
        page.locator("#tasks li", has_text="completed").wait_for()
        done = page.locator("#tasks li").first.inner_text()
        self.assertIn("Done by dog", done)
        self.assertNotIn(f"Done by {dog}", done)
        page.locator(CAMERAS).first.wait_for()
        os.kill(frozen, signal.SIGCONT)
        page.locator("#standby-nodes", has_text="vaio").wait_for()
        self.demo.send_signal("pi", signal.SIGKILL)
        self.wait_for_node(page, "vaio")
        page.locator(CAMERAS).first.wait_for()
