"""Tests of signing in (by link, by hand and as a viewer) and signing out, on the page in a real browser."""

from __future__ import annotations

from typing import Any

from tests.live.page import DESK, PHONE, TEXTS, PageCase


class SigningInTests(PageCase):
    def at_door(self, screen: dict[str, Any], fragment: str = "", scheme: Any = "light") -> Any:
        """Return a new page, opened with this link."""
        page = self.tab(screen, scheme)
        page.goto(self.team.url + fragment)
        return page

    def test_sign_in_by_hand(self) -> None:
        """Without a session the page shows only the sign-in form; a wrong code is refused, and Escape has no effect."""
        for screen, scheme in ((PHONE, "light"), (DESK, "dark")):
            page = self.at_door(screen, scheme=scheme)
            page.locator("#signin-code").wait_for()
            self.assertEqual(page.locator(".device").count(), 0)
            self.sound(page)
            page.keyboard.press("Escape")
            page.keyboard.press("Escape")
            self.assertTrue(page.locator("#signin").is_visible())
            page.locator("#signin-code").fill("quiet-ottr")
            page.keyboard.press("Enter")
            page.locator("#signin [role=alert]", has_text="wrong code").wait_for()
            page.get_by_role("button", name="Show").click()
            self.assertEqual(page.locator("#signin-code").get_attribute("type"), "text")
            page.locator("#signin-code").fill("correct horse")
            page.get_by_role("button", name="Sign in").click()
            self.live(page)
            self.assertEqual(self.faults, [])

    def test_stay_signed_in(self) -> None:
        """A link with the code signs in and removes the code from the URL.

        The session lasts until the user signs out.
        """
        page = self.opened(DESK)
        self.assertNotIn("code", page.url)
        page.reload()
        self.live(page)
        page.get_by_role("button", name="Sign out").click()
        page.locator("#signin-code").wait_for()
        page.reload()
        page.locator("#signin-code").wait_for()
        self.assertEqual(page.locator(".device").count(), 0)

    def test_look_as_a_viewer(self) -> None:
        """An operator's invitation signs in a viewer; a viewer sees all views but no controls."""
        page = self.opened(DESK)
        viewer = self.at_door(PHONE, f"#code={self.invitation(page)}")
        self.live(viewer)
        self.view(viewer, "more")
        viewer.locator(".session", has_text="viewer").wait_for()
        offered = [button.inner_text() for button in viewer.locator("button:not(.device):visible").all()]
        self.assertEqual(offered, ["Sign out"])
        self.view(viewer, "cameras")
        viewer.locator("#cameras").scroll_into_view_if_needed()
        viewer.locator("figure[data-camera=live]").first.wait_for()
        told = viewer.evaluate(
            "fetch('/api/v1/demo', {method: 'POST', headers: {'X-Swarm': '1', Authorization: 'Bearer ' + "
            "JSON.parse(localStorage['swarm.sessions'])[location.origin].token}}).then(answer => answer.status)"
        )
        self.assertEqual(told, 403)

    def test_read_the_audit(self) -> None:
        """An operator opens the audit log by keyboard and sees the last action; the log is not offered to a viewer."""
        for screen, scheme in ((PHONE, "dark"), (DESK, "light")):
            page = self.opened(screen, scheme)
            page.locator("#demo").click()
            page.locator("#status-line", has_text=TEXTS["demo.runs"]).wait_for()
            self.view(page, "more")
            page.get_by_text("Audit log").focus()
            page.keyboard.press("Enter")
            page.locator(".audit li", has_text="POST demo").first.wait_for()
            self.assertIn("operator", page.locator(".audit li").first.inner_text())
            page.get_by_role("button", name="Refresh").click()
            self.sound(page)
        viewer = self.at_door(DESK, f"#code={self.invitation(page)}")
        self.live(viewer)
        self.assertEqual(viewer.get_by_text("Audit log").count(), 0)

    def invitation(self, page: Any) -> str:
        page.get_by_role("button", name="Invite").click()
        page.locator("#i-kind").select_option("viewer")
        page.locator("#invite", has_text="to view the team").wait_for()
        link = str(page.locator("#i-link").input_value())
        page.get_by_role("button", name="Close").click()
        page.locator("#invite").wait_for(state="detached")
        return link.partition("#code=")[2]

    def test_ask_again_when_the_session_ends(self) -> None:
        """If the node no longer accepts the session, the page asks for the code and then shows the same view again."""
        page = self.opened(DESK)
        page.evaluate(
            "fetch('/api/v1/session', {method: 'DELETE', headers: {'X-Swarm': '1', Authorization: 'Bearer ' + "
            "JSON.parse(localStorage['swarm.sessions'])[location.origin].token}})"
        )
        self.team.freeze()
        page.locator("#link[data-link=lost]").wait_for(state="attached")
        self.team.thaw()
        page.locator("#signin-code").fill(self.team.code, timeout=15_000)
        page.keyboard.press("Enter")
        self.live(page)

    def test_stay_for_days(self) -> None:
        """An open page renews its session each time before the session ends, and stays live."""
        # The page renews the session one hour before the session ends.
        self.team.order("session 3603")
        page = self.opened(DESK)
        first = page.evaluate("JSON.parse(localStorage['swarm.sessions'])[location.origin].token")
        held = first
        for _ in range(2):
            page.wait_for_function(
                "held => JSON.parse(localStorage['swarm.sessions'])[location.origin].token !== held", arg=held
            )
            held = page.evaluate("JSON.parse(localStorage['swarm.sessions'])[location.origin].token")
        self.assertNotEqual(page.locator("#link").get_attribute("data-link"), "lost")
        self.team.order("status dog3 IDLE")
        page.locator(".device[data-state=IDLE]", has_text="dog3").wait_for()
        # Signing out also ends earlier sessions of the page.
        page.get_by_role("button", name="Sign out").click()
        page.locator("#signin-code").wait_for()
        for token in (first, held):
            path, headers = f"{self.team.url}api/v1/session", {"Authorization": f"Bearer {token}"}
            self.assertEqual(page.request.get(path, headers=headers).json()["role"], "anyone")
        self.assertEqual(self.faults, [])
