"""Tests of the network view in a real browser: the paths to each device, the members, and the rejections."""

from __future__ import annotations

from typing import Any

from tests.live.page import DESK, PHONE, PageCase


class PathsTests(PageCase):
    def open_network(self, screen: dict[str, Any]) -> Any:
        """Open the network view, wait until both panels are shown, and return the page."""
        page = self.opened(screen)
        self.view(page, "network")
        page.locator("#paths li").nth(2).wait_for()
        page.locator("#team-kind").scroll_into_view_if_needed()
        page.locator("#members li").nth(2).wait_for()
        return page

    def test_tell_the_ways(self) -> None:
        """Each path shows its score, rating, kind and duration; among the links of other nodes the worst is first."""
        page = self.open_network(PHONE)
        rows = [item.inner_text().split("\n") for item in page.locator("#paths li").all()]
        self.assertEqual(
            [(row[0], row[1], row[2]) for row in rows],
            [
                ("dog1", "98 \N{EN DASH} well", "LAN, for 2 min"),
                ("dog2", "63 \N{EN DASH} fair", "hole punched, for 2 min"),
                ("dog3", "24 \N{EN DASH} poor", "relayed by dog1, for 2 min"),
            ],
        )
        self.assertEqual(rows[2][3], "110 ms, jitter 11 ms, 20 % lost")
        lit = "e => [...e.querySelectorAll('rect')].filter(bar => bar.dataset.lit === 'true').length"
        self.assertEqual([page.locator("#paths .score").nth(n).evaluate(lit) for n in range(3)], [4, 3, 2])
        page.locator("#paths-others summary").tap()
        others = [item.inner_text().split("\n")[:2] for item in page.locator("#paths-between li").all()]
        self.assertEqual(
            others, [["dog2 \N{EN DASH} dog1", "70 \N{EN DASH} fair"], ["dog2 \N{EN DASH} dog3", "measuring"]]
        )
        self.assertEqual(page.locator("#paths-line").inner_text(), "5 links: 1 poor, 2 fair. 1 did not answer.")
        self.sound_by_day_and_night(page)

    def test_tell_who_was_turned_away(self) -> None:
        """A rejection that several nodes report is one line with the peer, the reporters, the reason and the remedy."""
        page = self.open_network(DESK)
        told = [item.inner_text().split("\n") for item in page.locator("#refusals li").all()]
        self.assertEqual(
            told,
            [
                [
                    "dog9 is rejected by vaio, dog1; 3 min ago, 6 times",
                    "revoked: the operator revoked the certificate",
                    "Remedy: admit the node again with a new code (swarm invite, swarm join)",
                ],
                [
                    "a newcomer at 192.0.2.66:8484 is rejected by vaio; 3 min ago",
                    "used: this code has no uses left",
                    "Remedy: ask the operator for a new code (swarm invite)",
                ],
            ],
        )

    def test_tell_the_team(self) -> None:
        """A closed team shows its name, fingerprint and members; certificates that expire soon are first and marked.

        An operator sees the command that revokes a member; a viewer sees the members without commands and buttons. The
        name of a member with many roles still fits on one line.
        """
        page = self.open_network(DESK)
        self.assertEqual(page.locator("#team-kind").inner_text(), "Closed team yard")
        self.assertIn("Fingerprint 1a2b 3c4d 5e6f 7081", page.locator("#team-about").inner_text())
        first, second, third = (item.inner_text() for item in page.locator("#members li").all())
        self.assertIn("! expires in 9 d", first)
        self.assertIn("device, bootstrap", second)
        self.assertIn("not here", third)
        self.assertNotIn("!", second + third)
        self.assertEqual(page.locator("#members code").all_inner_texts(), [f"swarm revoke dog{n}" for n in (2, 1, 7)])
        self.assertEqual(page.locator("#place-network button").count(), 0)
        lines = """item => {
          item.querySelector(".roles").textContent = "device, operator, gateway, bootstrap";
          const name = document.createRange();
          name.selectNodeContents(item.querySelector("b"));
          return name.getClientRects().length;
        }"""
        self.assertEqual(page.locator("#members li").first.evaluate(lines), 1)
        page.evaluate("import('/static/model.js').then(({ model }) => { model.me = { name: '', role: 'viewer' }; })")
        page.wait_for_function("() => !document.querySelector('#members code:not(:empty)')")
        self.assertEqual(page.locator("#members li").count(), 3)

    def test_ask_while_somebody_looks(self) -> None:
        """The page requests measurements only while its network view is shown."""
        page = self.opened(PHONE, has_clock=True)

        def asks() -> bool:
            self.asked.clear()
            self.pass_by(page, 10.0)
            return any(url.endswith(("/links", "/team")) for url in self.asked)

        self.assertFalse(asks())
        self.view(page, "network")
        page.locator("#paths li").first.wait_for()
        self.assertTrue(asks())
        self.view(page, "devices")
        self.assertFalse(asks())
