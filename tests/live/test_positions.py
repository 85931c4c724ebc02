"""Tests of the positions that devices report, on a page without a simulator."""

from __future__ import annotations

from typing import Any

from tests.live.page import DESK, PHONE, TABLET, PageCase

# All positions in one call, because the page may scroll or grow between two calls.
CENTRES = """names => names.map((name) => {
    const box = document.querySelector(`.spot[aria-label^=${name}] .dot`).getBoundingClientRect();
    return [box.x + box.width / 2, box.y + box.height / 2];
})"""


class PositionTests(PageCase):
    def centres(self, page: Any, *names: str) -> list[list[float]]:
        """Return the centres of the devices' marks in pixels, all measured at the same time."""
        return list(page.evaluate(CENTRES, list(names)))

    def test_draw_to_scale(self) -> None:
        """Positions in metres are drawn to scale, with y upwards and a scale bar; a tap on a mark opens the device."""
        self.team.order("outdoors")
        for place in ("dog1 x=0 y=0 heading=0", "dog2 x=30 y=0 heading=1.5708", "dog3 x=0 y=12 heading=0"):
            self.team.order(f"place {place}")
        page = self.opened(PHONE)
        page.locator("a[href='#map']").tap()
        page.locator("#position-map .spot").nth(2).wait_for()
        one, two, three = self.centres(page, "dog1", "dog2", "dog3")
        metre = (two[0] - one[0]) / 30
        self.assertLess(abs(one[1] - three[1] - (12 * metre)), 2)
        self.assertLess(abs(one[1] - (two[1])), 1)
        self.assertEqual(page.locator(".scale text").text_content(), "10 m")
        bar = page.locator(".scale path").evaluate("e => e.getBoundingClientRect().width")
        self.assertLess(abs(bar - (10 * metre)), 4)
        self.assertIn("30.00, 0.00 m, heading 90°", page.locator(".places").inner_text())
        self.assertEqual(page.locator("#map:visible, #set-target:visible, #target-position:visible").count(), 0)
        self.team.order("place dog3 x=0 y=6 heading=0")
        page.locator(".spot[aria-label*='0.00, 6.00 m']").wait_for()
        one, three = self.centres(page, "dog1", "dog3")
        self.assertLess(abs(one[1] - three[1] - (6 * metre)), 2)
        page.locator(".spot[aria-label^=dog3] .reach").tap()
        page.locator("#d-name", has_text="dog3").wait_for()

    def test_draw_by_the_globe(self) -> None:
        """Positions on the globe are drawn north up with their accuracy; positions in metres are only listed."""
        self.team.order("outdoors")
        self.team.order("place dog1 lat=48.1371 lon=11.5754 accuracy=8")
        self.team.order("place dog2 lat=48.1372 lon=11.5757 accuracy=25")
        self.team.order("place dog3 x=1 y=1 heading=0")
        for screen, scheme in ((PHONE, "light"), (TABLET, "dark"), (DESK, "light")):
            page = self.opened(screen, scheme)
            self.view(page, "map")
            page.locator("#position-map .spot").nth(1).wait_for()
            # The scale is final only after the page has received all three positions.
            page.locator("#place-map", has_text="north is up. 1 more device uses another frame").wait_for()
            one, two = self.centres(page, "dog1", "dog2")
            # 22.3 m to the east and 11.1 m to the north
            self.assertLess(abs((two[0] - one[0]) / (one[1] - two[1]) - (22.3 / 11.13)), 0.1)
            self.assertIn("48.13710°, 11.57540°, ± 8.0 m", page.locator(".places").inner_text())
            self.assertIn("dog3 1.00, 1.00 m", page.locator(".places").inner_text())
            self.tab_to(page, ".spot[aria-label^=dog2]")
            page.keyboard.press("Enter")
            page.locator("#d-name", has_text="dog2").wait_for()
            page.keyboard.press("Escape")
            page.locator("dialog[open]").wait_for(state="hidden")
            self.sound(page)

    def test_leave_it_to_the_yard(self) -> None:
        """With a simulator the map of the simulator is shown, even if devices report positions."""
        self.team.order("place dog1 x=1 y=1 heading=0")
        page = self.opened(DESK)
        page.locator("#map .dog").nth(2).wait_for()
        page.wait_for_function("performance.getEntriesByType('resource').some(e => e.name.endsWith('positions.js'))")
        page.locator("#set-target").wait_for()
        self.assertFalse(page.locator("#position-map").is_visible())
        self.assertEqual(page.locator("#h-map").inner_text(), "Simulator")
