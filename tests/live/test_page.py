"""Tests of the page in a real browser: an operator's views and actions, on a phone and on a desktop."""

from __future__ import annotations

import time
from typing import Any

from tests.live.page import DESK, PHONE, TEXTS, PageCase, Team

TWINS = """async () => {
  const { updateList } = await import("/static/element.js");
  const list = document.createElement("ul");
  const seen = ["abab", "aba", "baa"].map((items) => {
    const before = new Set(list.children);
    const update = (child, item) => { child.textContent = item; };
    updateList(list, [...items], (item) => item, () => document.createElement("li"), update);
    return [list.textContent, [...list.children].filter((child) => !before.has(child)).length];
  });
  return seen;
}"""
"""Update a list with items of which two are equal; return the text of the list and the number of new rows."""
PANELS = """async () => {
  const { registerPanel } = await import("/static/panel.js");
  const { model } = await import("/static/model.js");
  globalThis.seen = { model };
  const needs = { role: "operator", has: "wings" };
  const noted = (root) => {
    root.textContent = "second";
    return {
      update: (_, event) => { root.dataset.told = `${root.dataset.told ?? "told"} ${event}`; },
      close: () => { document.body.dataset.closed = root.dataset.told; },
    };
  };
  registerPanel({ place: "groups", order: 20, needs, load: async () => ({ make: noted }) });
  registerPanel({ place: "groups", order: 10, needs, make: (root) => {
    root.textContent = "first";
    return { update: (_, event) => { if (event === "state") throw new Error("a fault of one"); } };
  } });
}"""
"""Two panels that the page shows to operators of a node with faults; one of them raises an exception at each state."""


class PageTests(PageCase):
    def names(self, page: Any) -> list[str]:
        return list(page.locator(".device b").all_inner_texts())

    def test_reach_each_view(self) -> None:
        """On a phone at most two taps open any view, which then fills the screen.

        Keys, the browser's back button and links open views as well.
        """
        page = self.opened(PHONE)
        shown = "[...document.querySelectorAll('main section, footer')].filter(e => e.checkVisibility()).map(e => e.id)"
        for name, links in {
            "devices": ["devices"],
            "tasks": ["tasks"],
            "cameras": ["cameras"],
            "map": ["map"],
            "groups": ["more", "groups"],
            "network": ["more", "network"],
            "events": ["more", "events"],
            "more": ["more"],
        }.items():
            for link in links:
                page.locator(f"a[href='#{link}']").tap()
            page.locator(f"body[data-view={name}]").wait_for()
            beside = ["place-groups"] if name == "tasks" else []
            self.assertEqual(sorted(page.evaluate(shown)), sorted([f"place-{name}", *beside]))
            self.assertEqual(page.locator("#views [aria-current=page]").count(), len(links) == 1)
            page.wait_for_function("() => scrollY === 0")
        page.go_back()
        page.locator("body[data-view=events]").wait_for()
        page.locator("#views a").nth(2).focus()
        page.keyboard.press("Enter")
        page.locator("body[data-view=cameras]").wait_for()
        page.evaluate("location.hash = 'device/' + '01'.repeat(16)")
        page.locator("dialog[open]").wait_for()
        page.keyboard.press("Escape")
        page.locator("dialog[open]").wait_for(state="hidden")
        self.assertEqual(page.evaluate(shown), ["place-cameras"])
        self.assertEqual(self.faults, [])

    def test_choose_colours(self) -> None:
        """The page follows the system's colours; choosing light or dark overrides them and is stored."""
        page = self.opened(DESK, "light")
        dark = "getComputedStyle(document.body).backgroundColor"
        before = page.evaluate(dark)
        page.emulate_media(color_scheme="dark")
        self.assertNotEqual(page.evaluate(dark), before)
        page.emulate_media(color_scheme="light")
        self.assertEqual(page.evaluate(dark), before)
        page.locator("#theme").select_option("dark")
        chosen = page.evaluate(dark)
        self.assertNotEqual(chosen, before)
        page.reload()
        page.locator(".device").first.wait_for()
        self.assertEqual((page.evaluate(dark), page.locator("#theme").input_value()), (chosen, "dark"))

    def test_fill_a_wall(self) -> None:
        """A large screen shows all views simultaneously, or a single view in full size."""
        page = self.opened({"viewport": {"width": 2560, "height": 1440}})
        heights = page.evaluate("[...document.querySelectorAll('main section')].map(e => e.getBoundingClientRect())")
        self.assertEqual(len([box for box in heights if box["top"] < 1440]), 7)
        page.goto(f"{self.team.url}?view=cameras")
        page.locator("figure[data-camera=live]").nth(2).wait_for()
        self.assertEqual(page.locator("main section:visible").count(), 1)
        self.assertGreater(page.locator("canvas").first.bounding_box()["width"], 600)

    def test_ask_devices(self) -> None:
        """The page queries the network only while the network view is shown.

        It queries the storage of a device when the dialog of the device opens.
        """
        page = self.opened(PHONE, has_clock=True)

        def asks() -> bool:
            self.asked.clear()
            self.pass_by(page, 10.0)
            return any(url.endswith("/network") for url in self.asked)

        self.assertFalse(asks())
        self.view(page, "network")
        page.locator("#network-line", has_text="dog3 did not answer").wait_for()
        rows = [row.split("\t") for row in page.locator("#round-trips tr").all_inner_texts()]
        self.assertEqual(rows[1:], [["dog1", "", "3.6", "5.4"], ["dog2", "1.8", "", "unknown"]])
        self.assertEqual(page.locator(".tie").count(), 2)
        self.assertIn("5 asked in 2 hops, 8 found", page.locator("#lookups").inner_text())
        self.view(page, "devices")
        page.locator(".device").first.tap()
        page.locator("dialog", has_text="9 records, 4120 B of 8.0 MiB").wait_for()
        self.assertIn("4 of devices", page.locator("dialog").inner_text())
        page.evaluate("location.hash = 'device/' + '03'.repeat(16)")
        page.locator("dialog", has_text="it did not answer").wait_for()
        self.assertFalse(asks())

    def test_tell_why(self) -> None:
        """For each task the page lists the agents that agree on the decision and the agents that differ.

        The details show the rule and the reports of each decision.
        """
        for screen in (PHONE, DESK):
            page = self.opened(screen)
            self.view(page, "tasks")
            why = page.locator("#tasks .why").first
            self.assertEqual(why.locator("summary").inner_text(), "dog2 \N{EN DASH} 2 of 3 agree, dog3 differs")
            self.assertFalse(why.locator("table").first.is_visible())
            why.locator("summary").click()
            self.assertIn("by nearest 1: dog2 is better by more than 10%", why.locator("p").first.inner_text())
            rows = why.locator("table").first.locator("tr").all_inner_texts()
            self.assertEqual(
                [row.split("\t")[:2] for row in rows], [["dog2", "0.62"], ["dog1", "1.04"], ["dog3", "1.37"]]
            )
            self.assertIn("differs: names dog3; knew no report of dog2", rows[2])
            self.team.order("status dog1 SEARCHING")
            page.locator(".device .badge[data-state=SEARCHING]").nth(1).wait_for(state="attached")
            self.assertTrue(why.locator("table").first.is_visible())
            self.sound(page)
            self.assertEqual(page.locator("#tasks .why:visible").count(), 1)
            self.team.order("status dog1 WAITING")

    def test_show_cameras(self) -> None:
        """A desktop shows three live cameras.

        The pictures of a camera are not requested if its device is absent or if the camera is scrolled out of view.
        """
        page = self.opened(DESK)
        page.locator("figure[data-camera=live]").nth(2).wait_for()
        self.team.order("gone dog2")
        page.locator("figure[data-camera=gone]", has_text="dog2").wait_for()
        self.assertIn("gone", page.locator("figure", has_text="dog2").inner_text())
        page.wait_for_timeout(300)
        self.asked.clear()
        for _ in range(2):
            with page.expect_request(lambda request: "/shot/0101" in request.url):
                page.wait_for_timeout(300)
        self.assertFalse([url for url in self.asked if "/shot/0202" in url])
        page.context.close()
        phone = self.opened(PHONE, has_clock=True)
        self.pass_by(phone, 10.0)
        self.assertFalse([url for url in self.asked if "/shot/" in url])
        phone.locator("a[href='#cameras']").tap()
        phone.locator("figure[data-camera=live]").first.wait_for()

    def test_show_who_left(self) -> None:
        """A device that leaves stays in the list and is marked as gone, with the time since it left.

        When the device returns, the mark disappears automatically.
        """
        page = self.opened(DESK)
        self.assertEqual(self.names(page), ["dog1", "dog2", "dog3"])
        self.team.order("gone dog1")
        page.locator(".device[data-state=GONE]", has_text="dog1").wait_for()
        self.assertEqual(self.names(page), ["dog1", "dog2", "dog3"])
        self.assertIn("gone", page.locator(".device").first.inner_text())
        self.told(page, "dog1 is gone")
        self.team.order("back dog1")
        page.locator(".device[data-state=WAITING]", has_text="dog1").wait_for()

    def test_open_a_device(self) -> None:
        """A double click, the key Enter or the URL of a device opens its dialog; a single click does not.

        Escape, the button Close and the browser's back button close the dialog.
        """
        page = self.opened(DESK)
        dialog = page.locator("dialog[open]")
        page.locator(".device").nth(1).click()
        page.wait_for_timeout(200)
        self.assertEqual(dialog.count(), 0)
        page.locator(".device").nth(1).dblclick()
        dialog.wait_for()
        self.assertIn("#device/0202", page.url)
        for words in ("dog2", "base2d", "192.168.0.12:7000", "red target seen at 0.62 m"):
            self.assertIn(words, dialog.inner_text())
        page.go_back()
        dialog.wait_for(state="hidden")
        page.locator(".device").first.focus()
        page.keyboard.press("Enter")
        dialog.wait_for()
        page.keyboard.press("Escape")
        dialog.wait_for(state="hidden")
        page.evaluate("location.hash = 'device/' + '01'.repeat(16)")
        page.locator("#d-name", has_text="dog1").wait_for()
        page.locator("#d-text").fill("sit")
        page.keyboard.press("Enter")
        page.locator("#d-result", has_text=TEXTS["message.sent"].rstrip(".")).wait_for()
        self.assertEqual(page.locator("#d-text").input_value(), "")
        page.locator("#d-leave button").click()
        page.locator("#d-result", has_text="15 s").wait_for()
        page.locator("#d-close").click()
        dialog.wait_for(state="hidden")
        self.assertNotIn("#device", page.url)
        page.evaluate("location.hash = 'nowhere/%'")
        page.locator(".device").first.dblclick()
        dialog.wait_for()
        self.assertEqual(self.faults, [])

    def test_run_the_parts_of_the_page(self) -> None:
        """A panel is shown at its position to the permitted roles, receives events, and is removed.

        Rows with equal content stay separate rows.
        """
        page = self.informed(self.opened(DESK))
        self.assertEqual(page.evaluate(TWINS), [["abab", 4], ["aba", 0], ["baa", 0]])
        page.evaluate(PANELS)
        self.assertEqual(page.locator("#place-groups > [data-order]").all_inner_texts(), [])
        page.evaluate("seen.model.has = [...seen.model.has, 'wings']")
        page.locator("#place-groups > [data-order]").nth(1).wait_for()
        self.assertEqual(page.locator("#place-groups > [data-order]").all_inner_texts(), ["first", "second"])
        self.team.order("status dog3 DONE")
        page.locator("[data-told*=state]").wait_for()
        page.evaluate("seen.model.me = { name: '', role: 'viewer' }")
        page.locator("body[data-closed^='told  ']").wait_for()
        self.assertEqual(page.locator("#place-groups > [data-order]").count(), 0)
        self.assertEqual(len(self.faults), 1, self.faults)
        self.assertIn("a fault of one", self.faults[0])
        page.locator(".device[data-state=DONE]", has_text="dog3").wait_for()

    def test_tell_what_happened(self) -> None:
        """Events are listed as text, newest first; a filter selects the events of one kind, device or task."""
        page = self.opened(DESK)
        story = page.locator("#events li")
        page.locator("#events li", has_text="starts to observe").wait_for()
        self.team.order("gone dog2")
        page.locator("#events li[data-kind=gone]", has_text="dog2 is gone").wait_for()
        self.team.order("status dog1 EXECUTING")
        page.locator(
            "#events [data-kind=takeover]", has_text="dog1 takes over Find and touch the red target"
        ).wait_for()
        self.assertIn("takes over", story.first.inner_text() + story.nth(1).inner_text())
        page.locator("#event-kind").select_option("faults")
        self.assertEqual({item.get_attribute("data-kind") for item in story.all()}, {"gone", "takeover"})
        page.locator("#tasks .history summary").first.click()
        page.locator("#tasks .history li[data-kind=takeover]").first.wait_for()
        page.locator(".device").first.dblclick()
        page.locator("#d-events li", has_text="dog1: waiting").wait_for()
        self.team.order("status dog1 DONE")
        page.locator("#d-events li", has_text="dog1: executing").wait_for()
        self.assertFalse([words for words in page.locator("#d-events").all_inner_texts() if "dog3" in words])
        self.assertEqual(self.faults, [])

    def test_give_tasks(self) -> None:
        """On a phone, buttons assign and cancel a task; the group shows its bids and the assigned agent."""
        page = self.opened(PHONE)
        page.locator("#demo").tap()
        self.told(page, TEXTS["demo.runs"])
        page.locator("a[href='#tasks']").tap()
        page.locator("#task").select_option("patrol")
        page.locator("#assign button").tap()
        self.told(page, "Assigned")
        page.get_by_role("button", name="Cancel").first.tap()
        self.told(page, "sent")
        self.assertIn("dog1: no gripper", page.locator("#tasks").inner_text())
        self.view(page, "groups")
        self.assertEqual(page.locator(".point").inner_text(), "dog2 – 3 of 3 agree")
        self.assertEqual(page.locator(".cost").all_inner_texts(), ["1.04 m", "0.62 m", "1.37 m"])
        self.assertEqual(page.locator(".choice").first.inner_text(), "chose dog2, token 1 (waiting as number 1)")
        self.view(page, "devices")
        shapes = [path.get_attribute("d") for path in page.locator("#devices .badge path").all()]
        self.assertEqual(len(set(shapes)), 3)
        self.team.order("status dog3 DONE")
        page.locator(".device[data-state=DONE]", has_text="done").wait_for()
        # If the events fill the screen, the user scrolls the page, not a list within the page.
        self.view(page, "events")
        page.locator("#events li", has_text="starts to observe").wait_for()
        inside = """events => {
          for (let n = 0; n < 100; n += 1) events.append(events.firstElementChild.cloneNode(true));
          return events.scrollHeight - events.clientHeight;
        }"""
        self.assertEqual(page.locator("#events").evaluate(inside), 0)
        page.evaluate("scrollTo(0, document.body.scrollHeight)")
        self.assertLessEqual(page.locator("#events").bounding_box()["y"], 0)

    def test_move_the_target(self) -> None:
        """A click, a drag and the arrow keys move the target; a button removes it."""
        page = self.opened(DESK)
        at = self.floor(page)
        page.mouse.click(*at(2.03, 2.0))
        page.locator("#target-position", has_text="Target at 2.0").wait_for()
        ball = page.locator(".target .ball").bounding_box()
        page.mouse.move(ball["x"] + ball["width"] / 2, ball["y"] + ball["height"] / 2)
        page.mouse.down()
        page.mouse.move(*at(1.5, 1.5), steps=4)
        page.mouse.move(*at(1.03, 1.0), steps=4)
        page.mouse.up()
        self.told(page, "Target moved to 1.0")
        page.locator("#target-position", has_text="Target at 1.0").wait_for()
        page.locator(".target").focus()
        for _ in range(4):
            page.keyboard.press("ArrowRight")
        page.locator("#target-position", has_text="Target at 1.2").wait_for()
        page.locator("#remove-target").click()
        page.locator("#target-position", has_text=TEXTS["target.none"]).wait_for()
        page.locator("#set-target").click()
        page.locator("#target-position", has_text="Target at 1.50, 1.20").wait_for()

    def test_survive_loss(self) -> None:
        """A frozen node is detected after about two seconds, a killed node immediately; later the page recovers."""
        page = self.opened(DESK)
        started = time.monotonic()
        self.team.freeze()
        page.locator("#link[data-link=lost]").wait_for()
        self.assertLess(time.monotonic() - started, 3.5)
        self.team.thaw()
        page.locator("#link[data-link=live]").wait_for()
        self.team.stop()
        page.locator("#link[data-link=lost]").wait_for()
        self.told(page, TEXTS["connection.lost_status"])
        page.locator("#demo").click()
        self.told(page, "does not answer")
        self.team = Team(self.team.port)
        page.locator("#link[data-link=live]").wait_for()
        page.locator("figure[data-camera=live]").nth(2).wait_for()
