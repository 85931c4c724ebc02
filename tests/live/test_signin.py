"""Signing in to the page in a real browser: by a link, by hand, as a viewer, and out again."""

from __future__ import annotations

from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from tests.live.test_page import CHROMIUM, DESK, FLAGS, MISSING, PHONE, Team


class SigningInTests(SynchronousTestCase):
    if MISSING:
        skip = f"SIGNING IN IS NOT TESTED IN A BROWSER: missing {'; '.join(MISSING)}"

    def setUp(self) -> None:
        from playwright.sync_api import sync_playwright

        self.team = Team()
        self.addCleanup(lambda: self.team.stop())
        play = sync_playwright().start()
        self.addCleanup(play.stop)
        self.browser = play.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        self.addCleanup(self.browser.close)

    def opened(self, screen: dict[str, Any], fragment: str = "", scheme: Any = "light") -> Any:
        context = self.browser.new_context(**screen, color_scheme=scheme, reduced_motion="reduce")
        self.addCleanup(context.close)
        page = context.new_page()
        page.set_default_timeout(8000)
        self.faults: list[str] = []
        page.on("pageerror", lambda error: self.faults.append(str(error)))
        page.goto(self.team.url + fragment)
        return page

    def is_in(self, page: Any) -> None:
        page.locator("#link[data-link=live]").wait_for()
        page.locator(".device").nth(2).wait_for()

    def see(self, page: Any, view: str) -> None:
        """Look at a view; a phone shows one at a time."""
        page.evaluate(f"location.hash = '{view}'")
        page.locator(f"body[data-view={view}]").wait_for()

    def test_sign_in_by_hand(self) -> None:
        """Without a session the page shows nothing of the team and asks; wrong is told, Escape leads nowhere."""
        from axe_playwright_python.sync_playwright import Axe

        for screen, scheme in ((PHONE, "light"), (DESK, "dark")):
            page = self.opened(screen, scheme=scheme)
            page.locator("#signin-code").wait_for()
            self.assertEqual(page.locator(".device").count(), 0)
            self.assertEqual(Axe().run(page).response["violations"], [])
            self.assertLessEqual(page.evaluate("document.documentElement.scrollWidth - innerWidth"), 0)
            page.keyboard.press("Escape")
            page.keyboard.press("Escape")
            self.assertTrue(page.locator("#signin").is_visible())
            page.locator("#signin-code").fill("quiet-ottr")
            page.keyboard.press("Enter")
            page.locator("#signin [role=alert]", has_text="not the code").wait_for()
            page.get_by_role("button", name="Show").click()
            self.assertEqual(page.locator("#signin-code").get_attribute("type"), "text")
            page.locator("#signin-code").fill("correct horse")
            page.get_by_role("button", name="Sign in").click()
            self.is_in(page)
            self.assertEqual(self.faults, [])

    def test_stay_signed_in(self) -> None:
        """A link with the code signs in at once and leaves no trace of it; so it stays, until one signs out."""
        page = self.opened(DESK, f"#code={self.team.code}")
        self.is_in(page)
        self.assertNotIn("code", page.url)
        page.reload()
        self.is_in(page)
        page.get_by_role("button", name="Sign out").click()
        page.locator("#signin-code").wait_for()
        page.reload()
        page.locator("#signin-code").wait_for()
        self.assertEqual(page.locator(".device").count(), 0)

    def test_look_as_a_viewer(self) -> None:
        """An operator's invitation makes a viewer, who sees all and is offered nothing that it may not do."""
        page = self.opened(DESK, f"#code={self.team.code}")
        self.is_in(page)
        viewer = self.opened(PHONE, f"#code={self.invitation(page)}")
        self.is_in(viewer)
        self.see(viewer, "more")
        viewer.locator(".session", has_text="viewer").wait_for()
        offered = [button.inner_text() for button in viewer.locator("button:not(.device):visible").all()]
        self.assertEqual(offered, ["Sign out"])
        self.see(viewer, "cameras")
        viewer.locator("#cameras").scroll_into_view_if_needed()
        viewer.locator("figure[data-camera=live]").first.wait_for()
        told = viewer.evaluate(
            "fetch('/api/v1/demo', {method: 'POST', headers: {'X-Swarm': '1', Authorization: 'Bearer ' + "
            "JSON.parse(localStorage['swarm-session']).token}}).then(answer => answer.status)"
        )
        self.assertEqual(told, 403)

    def test_read_the_audit(self) -> None:
        """An operator opens who changed what by keyboard, reads what it just did, and a viewer is not offered it."""
        from axe_playwright_python.sync_playwright import Axe

        for screen, scheme in ((PHONE, "dark"), (DESK, "light")):
            page = self.opened(screen, f"#code={self.team.code}", scheme)
            self.is_in(page)
            page.get_by_role("button", name="Run Demo").click()
            page.locator("#line", has_text="The demo runs").wait_for()
            self.see(page, "more")
            page.get_by_text("Who changed what").focus()
            page.keyboard.press("Enter")
            page.locator(".audit li", has_text="POST demo").first.wait_for()
            self.assertIn("operator", page.locator(".audit li").first.inner_text())
            page.get_by_role("button", name="Look again").click()
            self.assertEqual(Axe().run(page).response["violations"], [])
            self.assertLessEqual(page.evaluate("document.documentElement.scrollWidth - innerWidth"), 0)
        viewer = self.opened(DESK, f"#code={self.invitation(page)}")
        self.is_in(viewer)
        self.assertEqual(viewer.get_by_text("Who changed what").count(), 0)

    def invitation(self, page: Any) -> str:
        page.get_by_role("button", name="Invite").click()
        page.locator("#i-kind").select_option("viewer")
        page.locator("#invite", has_text="may look").wait_for()
        link = str(page.locator("#i-link").input_value())
        page.get_by_role("button", name="Close").click()
        page.locator("#invite").wait_for(state="detached")
        return link.partition("#code=")[2]

    def test_ask_again_when_the_session_ends(self) -> None:
        """When the node no longer knows the session, the page asks, and goes on where it was."""
        page = self.opened(DESK, f"#code={self.team.code}")
        self.is_in(page)
        page.evaluate(
            "fetch('/api/v1/session', {method: 'DELETE', headers: {'X-Swarm': '1', Authorization: 'Bearer ' + "
            "JSON.parse(localStorage['swarm-session']).token}})"
        )
        self.team.order("freeze 3")
        page.locator("#signin-code").fill(self.team.code, timeout=15_000)
        page.keyboard.press("Enter")
        self.is_in(page)
