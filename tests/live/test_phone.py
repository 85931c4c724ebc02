"""Tests of a phone in Chromium, with a fake camera, that takes part in the real demonstration.

The demonstration's page is served over HTTPS, which phones need, if the libraries of the extra ``tls`` are installed.
"""

from __future__ import annotations

import json
import signal
import urllib.error
import urllib.request
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

from tests.live.demonstration import DemonstrationCase
from tests.live.page import DESK, PHONE, TABLET, TEXTS, BrowserCase, TeamCase, pin
from tests.live.until import until

PLACES = ((0.3, 2.1), (2.7, 2.1), (0.3, 0.3), (2.7, 0.3))
SIGHTS = """async (pictures) => {
  const { detectTarget } = await import("/static/detection.js");
  const found = [];
  for (const picture of pictures) {
    const image = await createImageBitmap(new Blob([Uint8Array.from(atob(picture), (each) => each.charCodeAt(0))]));
    const canvas = new OffscreenCanvas(image.width, image.height).getContext("2d");
    canvas.drawImage(image, 0, 0);
    const { data } = canvas.getImageData(0, 0, image.width, image.height);
    const seen = detectTarget(data, image.width, image.height, { radius: 0.08, height: 0.22 }, 56.9 * Math.PI / 180);
    found.push(seen && [seen.bearing, seen.distance]);
  }
  return found;
}"""
HIDE = """(hidden) => {
  Object.defineProperty(document, "hidden", { value: hidden, configurable: true });
  document.dispatchEvent(new Event("visibilitychange"));
}"""


class PhoneViewTests(BrowserCase, TeamCase):
    """The view of a phone, with a fake gateway in memory."""

    def opened(self, screen: Any = PHONE, base: str = "", may_film: bool = True) -> Any:
        page = self.tab(screen, permissions=["camera"] if may_film else [])
        page.goto(f"{base or self.team.url}#code={self.team.code}")
        page.locator("#link[data-link=live]").wait_for()
        if screen is PHONE:
            page.locator("#views a", has_text="More").tap()
        page.get_by_role("button", name="Take part with this device").press("Enter")
        page.get_by_role("button", name="Take part", exact=True).wait_for()
        return page

    def test_take_part_and_stop(self) -> None:
        """By touch and by keyboard, on three screens, the phone shows its detections and its task, and stops."""
        for screen in (PHONE, TABLET, DESK):
            look = self.sound_by_day_and_night if screen is PHONE else self.sound
            page = self.opened(screen)
            look(page)
            button = page.get_by_role("button", name="Take part", exact=True)
            if screen.get("has_touch"):
                button.tap()
            else:
                page.locator("#phone-name").focus()
                page.keyboard.press("Enter")
            page.locator(".phone .request", has_text="Look for the red target").wait_for()
            page.locator(".phone", has_text="Target at about 0.2").wait_for()
            look(page)
            page.get_by_role("button", name="Stop taking part").click()
            page.locator(".phone .trouble", has_text="has left the team").wait_for()
            look(page)
            page.context.close()

    def test_leave_while_hidden(self) -> None:
        """A hidden page leaves the team and releases the camera; when it is visible, it rejoins as the same phone."""
        page = self.opened()
        page.get_by_role("button", name="Take part", exact=True).tap()
        page.locator(".phone .request", has_text="Look for the red target").wait_for()
        secret = page.evaluate("localStorage.getItem('swarm.phone')")
        page.evaluate(HIDE, True)
        page.locator(".phone .trouble", has_text=TEXTS["phone.left_hidden"]).wait_for()
        with page.expect_request("**/api/v1/phones") as joined:
            page.evaluate(HIDE, False)
        page.locator(".phone .trouble", has_text=TEXTS["phone.returned"]).wait_for()
        page.locator(".phone .request", has_text="Look for the red target").wait_for()
        self.assertEqual(json.loads(joined.value.post_data)["secret"], json.loads(secret)["secret"])
        self.assertEqual(self.faults, [])

    def test_say_why_not(self) -> None:
        """For a denied camera, an insecure page and a viewer the page shows a message with the remedy."""
        page = self.opened(may_film=False)
        page.get_by_role("button", name="Take part", exact=True).tap()
        page.locator(".phone .trouble", has_text=TEXTS["camera.error.NotAllowedError"]).wait_for()
        self.sound(page)
        page = self.opened(base=f"http://vaio.local:{self.team.port}/", may_film=False)
        page.locator(".phone .trouble", has_text="allow the camera on https pages").wait_for()
        self.assertTrue(page.get_by_role("button", name="Take part", exact=True).is_disabled())
        page = self.tab(PHONE)
        page.goto(f"{self.team.url}#code={self.invited('viewer')}/phone")
        page.locator(".phone .trouble", has_text=TEXTS["phone.is_viewer"]).wait_for()

    def invited(self, role: str) -> str:
        body = json.dumps({"role": role}).encode()
        headers = {"Content-Type": "application/json", "Authorization": f"Bearer {self.team.token}"}
        asked = urllib.request.Request(f"{self.team.url}api/v1/invitations", body, headers)
        with urllib.request.urlopen(asked, timeout=5) as answer:
            return str(json.load(answer)["token"])

    def test_see_as_robots_do(self) -> None:
        """In simulated camera frames the page finds the target at the same position as the robots."""
        import base64

        from agents.vision import TargetSize, find_target
        from tests.agents.test_search import Walk

        pictures = []
        for x, y in ((0.75, 1.2), (0.9, 1.3), (1.2, 1.1), (1.6, 1.5), (2.0, 0.9), (2.4, 1.3), (1.0, 1.48), (0.2, 0.2)):
            walk = Walk()
            walk.world.place_target(x, y)
            pictures.append(walk.camera.render_jpeg(walk.dog))
        pictures.append(Walk().camera.render_jpeg(Walk().dog))
        page = self.opened()
        found = page.evaluate(SIGHTS, [base64.b64encode(picture).decode() for picture in pictures])
        count = 0
        for picture, here in zip(pictures, found, strict=True):
            there = find_target(picture, TargetSize(0.08, 0.22))
            self.assertEqual(here is None, there is None)
            if there is not None:
                count += 1
                self.assertLess(abs(here[0] - there.bearing), 0.01)
                self.assertLess(abs(here[1] / there.distance - 1), 0.05)
        self.assertGreater(count, 5)


class DemonstrationPhoneTests(BrowserCase, DemonstrationCase):
    """The team of the demonstration (six processes) and a visitor's phone."""

    is_secure = all(find_spec(name) for name in ("OpenSSL", "cryptography"))

    def pins(self) -> str:
        """Return the hashes of the public keys of both web nodes, for Chromium to trust."""
        secure = [page["url"] for page in self.demo.api("node")["pages"] if page["is_secure"]]
        return ",".join(pin(int(url.rpartition(":")[2])) for url in secure)

    def devices(self) -> dict[str, Any]:
        return {each["name"]: each for each in self.demo.api("devices")}

    def until(self, is_so: Callable[[], Any], page: Any = None) -> None:
        """Wait until ``is_so`` is true."""

        def told() -> str:
            devices = {name: (each["status"], each["messages"]) for name, each in self.devices().items()}
            seen = "" if page is None else page.locator(".phone").text_content()
            return f"{devices} {[(task['status'], task['note']) for task in self.demo.api('tasks')]} {seen}"

        until(is_so, told=told)

    def statuses(self) -> dict[str, str]:
        return {name: each["status"] for name, each in self.devices().items()}

    def has_task(self, page: Any) -> bool:
        """Return whether the phone has the task, according to its own page and to the team's page."""
        said = page.locator(".phone .request").text_content()
        return "You have the task" in said and self.statuses().get("anna") == "EXECUTING"

    def place_target(self) -> None:
        for x, y in PLACES:
            try:
                self.demo.api("target", {"x": x, "y": y})
                return
            except urllib.error.HTTPError as error:
                error.close()
        self.fail("there is no place for the target")

    def joined(self) -> Any:
        """Return the page of a phone that joined the team as "anna", with the target in view of its camera."""
        invitation = self.demo.api("invitations", {"role": "phone", "name": "visitor"})["token"]
        self.until(lambda: {"dog1", "dog2", "dog3"} <= set(self.devices()))
        self.until(lambda: len(self.demo.api("node")["pages"]) == (4 if self.is_secure else 2))
        self.browser = self.launched(f"--ignore-certificate-errors-spki-list={self.pins()}")
        page = self.tab(PHONE, permissions=["camera"])
        page.goto(f"{self.demo.url}#code={invitation}/phone")
        page.locator("#phone-name").fill("anna")
        page.get_by_role("button", name="Take part", exact=True).tap()
        page.locator(".phone", has_text="Target at about 0.2").wait_for()
        self.until(lambda: "anna" in self.devices(), page=page)
        return page

    def lose_web_node(self, page: Any) -> None:
        """Kill the phone's web node; the phone continues at the other node as the same device."""
        before = self.devices()["anna"]
        self.demo.send_signal("vaio", signal.SIGKILL)
        page.locator("#node", has_text="pi").wait_for()
        self.demo.sign_in(
            page.evaluate("import('/static/connection.js').then(({ currentOrigin }) => currentOrigin())") + "/"
        )
        self.until(lambda: self.devices().get("anna", before)["address"] != before["address"], page=page)
        page.locator(".phone .request", has_text="Nothing to do").wait_for()
        after = self.devices()["anna"]
        self.assertEqual(after["uuid"], before["uuid"])
        self.assertIsNone(after["gone"])

    def test_wins_at_another_web_node_and_is_taken_over(self) -> None:
        """A phone joins with one tap, keeps working when its web node is killed, and wins a task.

        When the phone leaves, a dog takes over the task.
        """
        page = self.joined()
        anna = self.devices()["anna"]
        self.assertEqual((anna["kind"], "camera" in anna["capabilities"]), ("phone", True))
        self.assertNotIn("base2d", anna["capabilities"])
        self.lose_web_node(page)

        self.place_target()
        self.demo.api("tasks", {"name": "watch-target"})
        self.until(lambda: self.has_task(page), page=page)
        self.sound(page)
        page.evaluate("location.hash = 'cameras'")
        page.locator("figure[data-camera=live]", has_text="anna").wait_for()
        reds = page.evaluate(
            "() => { const canvas = [...document.querySelectorAll('figure')].find(f => f.textContent.includes('anna'))"
            ".querySelector('canvas'); return [...canvas.getContext('2d').getImageData(canvas.width / 2,"
            " canvas.height / 2, 1, 1).data]; }"
        )
        self.assertTrue(reds[0] > 150 and reds[1] < 110, reds)

        def dog_waits() -> bool:
            if self.demo.api("tasks")[0]["status"] == "COMPLETED":
                # On a slow machine the dogs search for longer than the phone needs for its task.
                self.demo.api("tasks", {"name": "watch-target"})
            found = self.statuses()
            waits = any(status == "WAITING" for name, status in found.items() if name.startswith("dog"))
            return waits and found["anna"] == "EXECUTING"

        self.until(dog_waits, page=page)
        page.close()
        self.until(lambda: any(s == "EXECUTING" for n, s in self.statuses().items() if n.startswith("dog")))
        self.assertNotIn("EXECUTING", [self.statuses().get("anna", "GONE")])
        self.assertEqual(self.faults, [])
