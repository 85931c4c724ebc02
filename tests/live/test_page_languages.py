"""Tests of the page in each of its languages, in a real browser."""

from __future__ import annotations

from typing import Any

from tests.live.page import DESK, PHONE, VIEWS, PageCase
from tests.webnode.texts import catalogue

MARKED = "[...document.querySelectorAll('[data-text]')].map(e => [e.dataset.text, e.textContent])"
"""The keys of the template's texts, each with the text that the page shows."""
BROKEN = "document.body.innerText.match(/undefined|NaN|\\{\\w+\\}|\\b[a-z]+\\.[a-z]+[._][a-z_]+\\b/g) ?? []"
"""Matches keys and placeholders in the text that the page shows."""


class LanguageTests(PageCase):
    def opened_in(self, locale: str, screen: dict[str, Any] = DESK) -> Any:
        """Return the page, signed in, in a browser with that locale."""
        page = self.tab(screen, locale=locale)
        page.goto(f"{self.team.url}#code={self.team.code}")
        return self.informed(self.live(page))

    def test_choose_the_language(self) -> None:
        """A German browser shows German texts and numbers, and translated API codes; a French browser shows English."""
        for locale, language, metres in (("de-DE", "de", "0,62 m"), ("fr-FR", "en", "0.62 m")):
            page = self.opened_in(locale)
            texts = catalogue(language)
            self.assertEqual(page.locator("html").get_attribute("lang"), language)
            for key, shown in page.evaluate(MARKED):
                self.assertEqual(shown, texts[key.replace("state.wait", "state.live")], key)
            self.assertEqual(page.locator("#filter").get_attribute("placeholder"), texts["devices.filter"])
            waiting = page.locator(".device[data-state=WAITING] .badge").first
            self.assertEqual(waiting.inner_text(), texts["status.WAITING"])
            page.locator(".cost", has_text=metres).wait_for()
            page.locator("#demo").click()
            self.told(page, texts["demo.runs"])
            page.context.close()

    def test_fit(self) -> None:
        """In German, no text is cut off in any view or dialog, and no view shows a text key or a placeholder."""
        for screen in (PHONE, {"viewport": {"width": 390, "height": 844}}, DESK):
            page = self.opened_in("de-DE", screen)
            for view in VIEWS:
                self.view(page, view)
                if view == "network":
                    page.locator("#members li").nth(2).wait_for(state="attached")
                self.sound(page)
                self.assertEqual(page.evaluate(BROKEN), [], view)
            stop, demo = (page.locator(each).bounding_box() for each in (".stop", "#demo"))
            self.assertTrue(demo["x"] + demo["width"] <= stop["x"] or demo["y"] >= stop["y"] + stop["height"])
            page.evaluate("location.hash = 'device/' + '01'.repeat(16)")
            page.locator("dialog[open] .setting").first.wait_for()
            self.sound(page)
            self.assertEqual(page.evaluate(BROKEN), [], "device")
            page.context.close()
