"""Tests of each view on each screen, opened and used by touch and by keyboard, in light and in dark colours."""

from __future__ import annotations

from typing import Any

from tests.live.page import DESK, PHONE, TABLET, VIEWS, PageCase

FURTHER = ("groups", "network", "events")
"""The views that a phone opens through *More*."""
USED = {
    "devices": ".device",
    "tasks": "#task",
    "map": "#map .dog",
    "more": "#theme",
    "events": "#events",
}
"""The elements that the keyboard reaches in a view; the other views are only shown."""
SHOWN = "id => document.getElementById(id).checkVisibility()"


class MatrixTests(PageCase):
    timeout = 170

    def reach(self, page: Any, view: str, is_phone: bool, by_key: bool) -> None:
        """Open a view as a user of that screen does; on a larger screen the view is already open."""
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
        """Open all views and a device on one screen, by touch in light colours and by keyboard in dark colours."""
        for scheme, by_key in (("light", "has_touch" not in screen), ("dark", True)):
            page = self.opened(screen, scheme)
            page.locator(".preview li").first.wait_for(state="attached")
            for view in VIEWS:
                self.reach(page, view, screen is PHONE, by_key)
                # A larger screen shows all views simultaneously, so one check is enough.
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
        """All views work on a phone."""
        self.look_through(PHONE)

    def test_tablet(self) -> None:
        """All views work on a tablet."""
        self.look_through(TABLET)

    def test_desk(self) -> None:
        """All views work on a desktop without touch."""
        self.look_through(DESK)
