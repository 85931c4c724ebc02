"""Tests of invitations in a real browser: the QR code, its text, and the hints on HTTPS."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

from tests.live.page import DESK, MISSING, PHONE, TABLET, PageCase

ABSENT = [*MISSING, *([] if find_spec("segno") else ["the Python package segno"])]
PHONES = """async () => {
  const { model } = await import("/static/model.js");
  model.has = [...model.has, "phones"];
}"""
"""Add the feature ``phones`` to the page's model."""


class InviteTests(PageCase):
    if ABSENT:
        skip = f"INVITING IS NOT TESTED IN A BROWSER: missing {'; '.join(ABSENT)}"

    def invite(self, page: Any) -> None:
        """Open the dialog by keyboard."""
        self.informed(page)
        page.evaluate(PHONES)
        page.evaluate("location.hash = 'more'")
        page.get_by_role("button", name="Invite").focus()
        page.keyboard.press("Enter")
        page.locator("#invite[open]").wait_for()

    def read(self, page: Any, number: int = 0) -> str:
        """Return the text in a QR code on the screen."""
        import cv2
        import numpy as np

        shot = page.locator("#invite .code").nth(number).screenshot()
        picture: Any = cv2.imdecode(np.frombuffer(shot, np.uint8), 1)
        return str(cv2.QRCodeDetector().detectAndDecode(picture)[0])

    def another(self, page: Any) -> None:
        """Request a new invitation; this is needed because OpenCV's reader fails for one QR code in a hundred."""
        before = page.locator("#i-link").input_value()
        for kind in ("viewer", "phone"):
            page.locator("#i-kind").select_option(kind)
            page.wait_for_function("before => document.querySelector('#i-link').value !== before", arg=before)
            before = page.locator("#i-link").input_value()

    def test_read_the_code(self) -> None:
        """On each screen, in light and dark, the QR code contains the displayed URL, and axe finds no violation."""
        for screen in (PHONE, TABLET, DESK):
            page = self.opened(screen)
            self.invite(page)
            for scheme in ("light", "dark"):
                page.emulate_media(color_scheme=scheme)
                for _ in range(3):
                    if self.read(page):
                        break
                    self.another(page)
                link = page.locator("#i-link").input_value()
                self.assertTrue(link.startswith("https://192.168.0.7:8443/#code=") and link.endswith("/phone"), link)
                self.assertEqual(self.read(page), link)
                self.assertEqual(self.read(page, 1), "http://192.168.0.7:8080/api/v1/ca.crt")
            page.locator("#invite summary").first.click()
            self.sound_by_day_and_night(page)
            page.context.close()

    def test_say_what_is_missing(self) -> None:
        """Over HTTP a hint says that the camera is unavailable; a URL of this machine is not offered to a phone."""
        page = self.opened(PHONE)
        self.invite(page)
        self.assertFalse(page.get_by_text("Browsers do not allow the camera over http").is_visible())
        page.locator("#i-page").select_option("http://192.168.0.7:8080")
        page.get_by_text("Browsers do not allow the camera over http").wait_for()
        self.assertTrue(page.locator("#i-link").input_value().startswith("http://192.168.0.7:8080/#code="))
        page.locator("#i-kind").select_option("viewer")
        page.locator("#invite", has_text="to view the team").wait_for()
        self.assertFalse(page.get_by_text("Browsers do not allow the camera over http").is_visible())
        page.locator("#i-page").select_option(index=2)
        page.get_by_text("WEB_HOST=0.0.0.0").wait_for()
        self.assertFalse(page.locator("#invite .code").first.is_visible())
        self.assertTrue(page.locator("#i-link").input_value().startswith("http://127.0.0.1:"))

    def test_lead_to_the_phone(self) -> None:
        """The link for a phone signs in with its role, opens the phone's view, and leaves no token in the URL."""
        page = self.opened(DESK)
        self.invite(page)
        link = page.locator("#i-link").input_value()
        page.get_by_role("button", name="Copy").first.click()
        page.locator("#invite [role=status]", has_text="op").wait_for()
        # The stop button works over the open dialog, and after the dialog is closed.
        page.get_by_role("button", name="Stop").click()
        page.locator("body[data-halted=true]").wait_for()
        page.keyboard.press("Escape")
        page.locator("#invite").wait_for(state="detached")
        self.assertTrue(page.get_by_role("button", name="Stop").is_visible())
        page.goto("about:blank")
        phone = self.tab(PHONE)
        phone.goto(f"{self.team.url}#{link.partition('#')[2]}")
        # The URL changes immediately, but the session exists only after the node's response.
        phone.wait_for_function(
            "() => location.hash === '#phone' && "
            "JSON.parse(localStorage['swarm.sessions'] ?? '{}')[location.origin]?.token"
        )
        self.assertNotIn("code", phone.url)
        role = phone.evaluate(
            "fetch('/api/v1/session', {headers: {Authorization: 'Bearer ' + "
            "JSON.parse(localStorage['swarm.sessions'])[location.origin].token}}).then(answer => answer.json())"
        )
        self.assertEqual(role["role"], "phone")
