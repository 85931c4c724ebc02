"""Tests of the real demonstration (six processes and the page) by touch and on a desktop, in Chromium."""

from __future__ import annotations

from typing import Any

from tests.live.demonstration import DemonstrationPageCase
from tests.live.page import DESK, PHONE, TEXTS

SMALL = """index => {
  const seen = document.querySelectorAll("#cameras canvas")[index];
  const small = new OffscreenCanvas(26, 20).getContext("2d");
  small.drawImage(seen, 0, 0, 26, 20);
  return Array.from(small.getImageData(0, 0, 26, 20).data);
}"""
"""Return a camera's picture, scaled down to average its noise."""
MOVED = 4.0
"""A mean pixel difference (0 to 255) of two such pictures: above the noise, below the change when a dog turns."""


STOPPED = """async () => {
  const { model } = await import("/static/model.js");
  const moving = () => model.yard.dogs.filter((dog) => dog.moving).length;
  const wait = (ms) => new Promise((go) => setTimeout(go, ms));
  while (!moving()) await wait(20);
  document.querySelector(".stop").click();
  const pressed = performance.now();
  while (moving()) await wait(5);
  const took = performance.now() - pressed;
  let moved = 0;
  for (let n = 0; n < 150; n += 1) {
    await wait(20);
    moved += moving();
  }
  return { took, moved };
}"""
"""Press stop while a dog moves; return the milliseconds until all dogs stand still on the map, and later motions."""
STANDING_MS = 6000.0
"""The time limit until all dogs stand still: 200 ms to brake, 200 ms age of the map, the rest for a loaded machine."""


class DemonstrationPageTests(DemonstrationPageCase):
    def fits(self, page: Any) -> None:
        """Check that the page is accessible and that no content is cut off."""
        self.sound(page)
        cut = page.evaluate(
            "[...document.querySelectorAll('button, select, dialog, .badge, .device, li, dd')]"
            ".filter(e => e.offsetParent && e.scrollWidth > e.clientWidth + 1).map(e => e.outerHTML)"
        )
        self.assertEqual(cut, [], page.url)

    def test_be_driven_and_looked_at(self) -> None:
        """A phone controls the team by touch; a desktop shows devices, cameras and the map during a search."""
        phone = self.opened(PHONE)
        self.drive(phone)
        phone.context.close()
        self.look(self.opened(DESK))

    def drive(self, page: Any) -> None:
        """Run the demo, stop and release the team; open, message and disconnect a device, and move the target."""
        self.fits(page)
        page.locator("#demo").tap()
        self.stop(page)
        self.view(page, "devices")
        page.locator(".device[data-state=EXECUTING]").first.wait_for()
        self.view(page, "groups")
        page.locator(".point[data-agree=true]").wait_for()
        self.fits(page)
        self.view(page, "tasks")
        page.locator("#tasks li", has_text="completed").wait_for()
        self.assertIn("Done by dog", page.locator("#tasks li").first.inner_text())

        self.view(page, "devices")
        page.locator(".device", has_text="dog2").tap()
        page.locator("dialog[open]").wait_for()
        self.assertIn("camera", page.locator("#d-capabilities").inner_text())
        self.fits(page)
        page.locator("#d-text").fill("good dog")
        page.locator("#d-message button").tap()
        page.locator("#d-messages", has_text="operator: good dog").wait_for()
        page.locator("#d-seconds").fill("3")
        page.locator("#d-leave button").tap()
        page.locator("#d-result", has_text="3 s").wait_for()
        page.locator("#d-close").tap()
        page.locator(".device[data-state=GONE]", has_text="dog2").wait_for()
        self.fits(page)
        page.locator(".device[data-state=IDLE]", has_text="dog2").wait_for()

        self.view(page, "map")
        page.locator("#remove-target").tap()
        page.locator("#target-position", has_text=TEXTS["target.none"]).wait_for()
        page.locator("#set-target").tap()
        page.locator("#target-position", has_text="Target at").wait_for()
        floor = page.locator(".floor")
        floor.scroll_into_view_if_needed()
        box = floor.bounding_box()
        # A position that a dog occupies is refused; three dogs cannot occupy all four corners.
        for right, down in ((0.15, 0.15), (0.85, 0.15), (0.15, 0.85), (0.85, 0.85)):
            with page.expect_response("**/api/v1/target"):
                page.touchscreen.tap(box["x"] + right * box["width"], box["y"] + down * box["height"])
            page.wait_for_function(
                "() => !document.querySelector('#status-line').textContent.includes('Moving the target')"
            )
            if "Target moved" in page.locator("#status-line").inner_text():
                break
        else:
            self.fail(page.locator("#status-line").inner_text())

    def stop(self, page: Any) -> None:
        """A stop during the search halts all three dogs immediately and for 3 s; after the release they continue."""
        seen = page.evaluate(STOPPED)
        self.assertLess(seen["took"], STANDING_MS, seen)
        self.assertEqual(seen["moved"], 0)
        page.locator(".halted").wait_for()
        self.fits(page)
        page.locator(".halted button").tap()
        page.locator(".halted").wait_for(state="hidden")

    def look(self, page: Any) -> None:
        """Check that the page shows devices in joining order, three cameras with changing views, and the map."""
        devices = self.demo.api("devices")
        self.assertEqual(page.locator(".device b").all_inner_texts(), [device["name"] for device in devices])
        joined = [device["joined"] for device in devices]
        self.assertEqual(joined, sorted(joined))
        page.locator("figure[data-camera=live]").nth(2).wait_for()
        self.assertEqual(page.locator("#map .dog").count() or page.locator("#map .body").count(), 3)
        self.fits(page)

        page.locator("#demo").click()
        page.locator(".device[data-state=SEARCHING]").first.wait_for()
        views = [page.evaluate(SMALL, index) for index in range(3)]
        for index, before in enumerate(views):
            for _ in range(40):  # the view of a dog may be almost constant for some time
                page.wait_for_timeout(250)
                differ = sum(abs(a - b) for a, b in zip(before, page.evaluate(SMALL, index), strict=True)) / len(before)
                if differ > MOVED:
                    break
            else:
                self.fail(f"camera {index} shows a dog that does not turn")
        page.locator("#tasks li button:visible").first.click()
        page.locator("#tasks li", has_text="cancelled").first.wait_for()
        self.fits(page)
