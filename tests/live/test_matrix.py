"""Every view on every screen: reached and used by touch and by the keyboard alone, light and dark, without a fault."""

from __future__ import annotations

from typing import Any

from tests.live.page import DESK, PHONE, TABLET, VIEWS, PageCase

FURTHER = ("groups", "network", "events")
"""To these a phone leads by *More*."""
USED = {
    "devices": ".device",
    "tasks": "#task",
    "map": "#map .dog",
    "more": "#theme",
    "events": "#events",
}
"""What the keyboard reaches in a view; the others are to be looked at only."""
SHOWN = "id => document.getElementById(id).checkVisibility()"


class MatrixTests(PageCase):
    timeout = 170

    def reach(self, page: Any, view: str, is_phone: bool, by_key: bool) -> None:
        """Go to a view as one does on that screen; a larger one shows it already."""
        for place in [*["more"] * (view in FURTHER), view] if is_phone else []:
            if by_key:
                self.tab_to(page, f"a[href='#{place}']")
                page.keyboard.press("Enter")
            else:
                page.locator(f"a[href='#{place}']").tap()
            page.locator(f"body[data-view={place}]").wait_for()
        if not is_phone and not by_key:
            page.locator(f"#place-{view}").scroll_into_view_if_needed()
        if view == "network":
            page.locator("#place-network").scroll_into_view_if_needed()
            page.locator("#round-trips td").first.wait_for()
        self.assertTrue(page.evaluate(SHOWN, f"place-{view}"), view)
        if by_key and view in USED:
            self.tab_to(page, USED[view])

    def look_through(self, screen: dict[str, Any]) -> None:
        """All views on one screen, by touch in the light and by keyboard in the dark, and a device."""
        for scheme, by_key in (("light", "has_touch" not in screen), ("dark", True)):
            page = self.opened(screen, scheme)
            page.locator(".preview li").first.wait_for(state="attached")
            for view in VIEWS:
                self.reach(page, view, screen is PHONE, by_key)
                # A larger screen shows all at once, so once is enough there.
                if screen is PHONE or view in ("network", "map"):
                    self.sound(page)
            if by_key:
                self.tab_to(page, ".device")
                page.keyboard.press("Enter")
            else:
                page.locator(".device").first.tap()
            page.locator("dialog[open] tr").first.wait_for()
            page.locator("dialog[open] .setting").first.wait_for()
            self.sound(page)
            page.context.close()
        self.assertEqual([url for url in self.asked if not url.startswith(self.team.url)], [])

    def test_phone(self) -> None:
        """On a phone."""
        self.look_through(PHONE)

    def test_tablet(self) -> None:
        """On a tablet."""
        self.look_through(TABLET)

    def test_desk(self) -> None:
        """On a desk, where there is no touch."""
        self.look_through(DESK)
