"""Tests of fault injection on the page in a real browser, by touch and by keyboard."""

from __future__ import annotations

from typing import Any

from tests.live.page import DESK, PHONE, TABLET, PageCase


class FaultPageTests(PageCase):
    def opened(self, screen: dict[str, Any], scheme: Any = "light", has_clock: bool = False) -> Any:
        """Return the page with the open dialog of dog2, which shows the faults."""
        page = super().opened(screen, scheme, has_clock)
        page.evaluate("location.hash = 'device/' + '02'.repeat(16)")
        page.locator(".fault-buttons button").first.wait_for()
        return page

    def test_let_it_fail(self) -> None:
        """A tap injects a fault for the given seconds; its timer is shown in the dialog and in the list of devices."""
        page = self.opened(PHONE)
        page.locator("#f-seconds").fill("30")
        page.get_by_role("button", name="Cut radio").tap()
        page.get_by_role("status").filter(has_text="Cut radio: ends after 30 s.").wait_for()
        clock = page.locator("#place-device .fault[data-clock=runs] strong")
        first = clock.inner_text()
        self.assertIn("no takeover yet: ", first)
        page.wait_for_function("before => document.querySelector('.fault strong').textContent !== before", arg=first)
        page.get_by_role("button", name="Close").tap()
        page.locator("#place-devices .fault", has_text="Cut radio").wait_for()
        page.context.close()

    def test_by_keyboard(self) -> None:
        """Tab reaches each button and Enter injects the fault; if no seconds are given, nothing happens."""
        page = self.opened(DESK)
        page.locator("#f-seconds").focus()
        page.keyboard.press("Tab")
        page.keyboard.press("Tab")
        self.assertEqual(page.evaluate("document.activeElement.textContent"), "Freeze")
        page.keyboard.press("Enter")
        page.get_by_role("status").filter(has_text="Freeze: ends after 15 s.").wait_for()
        self.assertEqual(page.evaluate("document.activeElement.textContent"), "Freeze")
        page.locator("#f-seconds").fill("")
        page.locator("#f-seconds").press("Tab")
        page.keyboard.press("Enter")
        page.wait_for_timeout(300)
        self.assertEqual(page.locator("#place-device .fault").count(), 1)

    def test_be_accessible(self) -> None:
        """On phone, tablet and desktop, light and dark, axe finds no violation, and no button is small or cut off."""
        for screen in (PHONE, TABLET, DESK):
            page = self.opened(screen)
            if screen is PHONE:
                page.get_by_role("button", name="Lose 20 %").tap()
            page.locator("#place-device .fault").first.wait_for()
            self.sound_by_day_and_night(page)
            page.context.close()
