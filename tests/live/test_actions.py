"""Tests of an operator's actions on the page in a real browser: by touch, by mouse and by keyboard."""

from __future__ import annotations

import re

from tests.live.page import DESK, PHONE, TEXTS, PageCase


class ActionPageTests(PageCase):
    timeout = 170

    def test_stop_from_everywhere(self) -> None:
        """At any scroll position and in any dialog, one touch stops the team and another touch releases it."""
        page = self.opened(PHONE)
        corner = page.locator(".stop").bounding_box()
        page.locator(".stop").tap()
        self.told(page, "Stopped: 3 robots stand.")
        page.locator(".halted").wait_for()
        page.locator(".halted button").tap()
        self.told(page, TEXTS["stop.released"])
        page.locator(".halted").wait_for(state="hidden")
        self.view(page, "tasks")
        page.locator("#assign").scroll_into_view_if_needed()
        self.assertEqual(page.locator(".stop").bounding_box(), corner)
        self.view(page, "devices")
        page.locator(".device").first.tap()
        page.locator("dialog[open] .stop").wait_for()
        self.assertEqual(page.locator(".stop").bounding_box(), corner)
        page.locator(".stop").tap()
        page.locator("body[data-halted=true]").wait_for()
        page.locator("#d-close").tap()
        page.locator("header .stop").wait_for()
        self.assertEqual(page.locator(".stop").bounding_box(), corner)
        self.assertEqual(self.faults, [])

    def test_stop_by_keyboard(self) -> None:
        """The keys Tab and Enter are enough to stop and release the team.

        The stop button is among the first elements.
        """
        page = self.opened(DESK)
        page.keyboard.press("Tab")
        page.keyboard.press("Tab")
        self.tab_to(page, ".stop")
        page.keyboard.press("Enter")
        self.told(page, "Stopped")
        page.locator(".halted").wait_for()
        self.tab_to(page, ".halted button")
        page.keyboard.press("Enter")
        self.told(page, TEXTS["stop.released"])

    def test_ask_before_assigning(self) -> None:
        """Before a task is assigned, the page lists the devices that can execute it.

        For every other device, the page states the reason why the device cannot execute the task.
        """
        page = self.opened(PHONE)
        self.view(page, "tasks")
        page.locator(".preview [data-can=can]", has_text="dog1, dog2 (now: Patrol the yard)").wait_for()
        self.assertIn("dog3: no gripper, no lift", page.locator(".preview").inner_text())
        page.locator("#task").select_option("patrol")
        page.locator(".preview [data-can=nobody]", has_text=TEXTS["preview.nobody"]).wait_for()

    def test_assign_to_a_group(self) -> None:
        """A task is added to a group by touch and by keyboard; the preview lists the other tasks of the group."""
        for screen, type_on in ((PHONE, False), (DESK, True)):
            page = self.opened(screen)
            self.view(page, "tasks")
            page.locator(".preview li").first.wait_for()
            self.assertEqual(page.locator(".preview [data-can=with]").count(), 0)
            self.assertIn("assigned jointly", page.locator("label[for=group]").inner_text())
            if type_on:
                self.tab_to(page, "#group")
                page.keyboard.type("yard")
            else:
                page.locator("#group").tap()
                page.locator("#group").fill("yard")
            page.locator("[data-can=with]", has_text="jointly with: Find and touch the red target.").wait_for()
            with page.expect_request(lambda asked: asked.method == "POST" and asked.url.endswith("/tasks")) as asked:
                if type_on:
                    page.keyboard.press("Enter")
                else:
                    page.locator("#assign button").tap()
            self.assertEqual(asked.value.post_data_json, {"name": "search", "group": "yard"})
            self.told(page, "Assigned")
            page.locator("#group").fill("elsewhere")
            page.locator(
                "[data-can=with]", has_text="no other task yet; this is the first of group elsewhere"
            ).wait_for()
            self.sound(page)

    def test_lift_a_robot(self) -> None:
        """A robot is moved by dragging and with arrow keys, and turned by a click or Enter.

        The target is not moved by these actions.
        """
        page = self.opened(DESK)
        at = self.floor(page)
        page.locator(".dog .grip").nth(2).wait_for(state="attached")
        target = page.locator("#target-position").inner_text()
        page.mouse.move(*at(0.6, 0.6))
        page.mouse.down()
        page.mouse.move(*at(1.0, 0.8), steps=4)
        page.locator(".ghost").wait_for(state="attached")
        page.mouse.move(*at(2.2, 2.0), steps=4)
        page.mouse.up()
        self.told(page, "dog1 moved to 2.2")
        self.assertEqual(page.locator(".ghost").count(), 0)
        page.locator(".dog[data-key=dog2]").focus()
        page.keyboard.press("ArrowRight")
        self.told(page, "dog2 moved to 1.45, 1.20")
        nose = page.locator(".dog[data-key=dog2] > g").get_attribute("transform")
        page.keyboard.press("Enter")
        page.wait_for_function(
            "nose => document.querySelector('.dog[data-key=dog2] > g').getAttribute('transform') !== nose", arg=nose
        )
        nose = page.locator(".dog[data-key=dog3] > g").get_attribute("transform")
        page.mouse.click(*at(2.5, 0.7))
        page.wait_for_function(
            "nose => document.querySelector('.dog[data-key=dog3] > g').getAttribute('transform') !== nose", arg=nose
        )
        self.assertEqual(page.locator("#target-position").inner_text(), target)
        self.assertEqual(self.faults, [])

    def test_lift_a_robot_by_touch(self) -> None:
        """A finger on a robot or the target moves it, and does not scroll the page; a tap turns a robot."""
        page = self.opened(PHONE)
        page.locator(".dog .grip").nth(2).wait_for(state="attached")
        self.view(page, "map")
        page.locator("#map").scroll_into_view_if_needed()
        at = self.floor(page)
        touch = page.context.new_cdp_session(page)

        def finger(kind: str, *places: tuple[float, float]) -> None:
            points = [dict(zip("xy", at(*place), strict=True)) for place in places]
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

        before = page.evaluate("scrollY")
        finger("touchStart", (0.6, 0.6))
        for step in range(1, 6):
            finger("touchMove", (0.6, 0.6 + 0.2 * step))
        finger("touchEnd")
        self.told(page, "dog1 moved to")
        x, y = (float(word.strip(",")) for word in page.locator("#status-line").inner_text().split()[3:5])
        self.assertLess(abs(x - 0.6) + abs(y - 1.6), 0.1)
        finger("touchStart", (1.8, 1.7))
        for step in range(1, 6):
            finger("touchMove", (1.8, 1.7 - 0.2 * step))
        finger("touchEnd")
        page.locator(
            "#target-position", has_text=re.compile(r"Target at 1\.8\d, 0\.[67]|Target at 1\.7\d, 0\.[67]")
        ).wait_for()
        self.assertEqual(page.evaluate("scrollY"), before)
        nose = page.locator(".dog[data-key=dog3] > g").get_attribute("transform")
        finger("touchStart", (2.5, 0.7))
        finger("touchEnd")
        page.wait_for_function(
            "nose => document.querySelector('.dog[data-key=dog3] > g').getAttribute('transform') !== nose", arg=nose
        )
        self.assertEqual(self.faults, [])

    def test_change_settings(self) -> None:
        """A device's settings are shown, changed and saved by keyboard.

        Invalid settings are refused with the reason.
        """
        page = self.opened(PHONE)
        page.locator(".device").first.tap()
        name = page.locator("[name=description]")
        name.fill("lame")
        page.keyboard.press("Enter")
        answer = page.locator(".settings + .hint")
        page.locator(".settings + .hint", has_text=TEXTS["settings.saved"]).wait_for()
        self.assertEqual(name.input_value(), "lame")
        page.get_by_role("button", name="Save settings").tap()
        self.assertEqual(answer.inner_text(), "No changes to save.")
        page.locator("[name=capabilities]").fill("{arm")
        page.get_by_role("button", name="Save settings").tap()
        self.assertIn("capabilities: not a table", answer.inner_text())
        page.locator("[name=presence_lease]").fill("99")
        page.get_by_role("button", name="Save settings").tap()
        self.assertFalse(page.locator("[name=presence_lease]").evaluate("e => e.checkValidity()"))
        page.locator("#d-close").tap()
        page.locator(".device").nth(1).tap()
        page.locator(".settings + .hint", has_text="no settings that can be changed").wait_for()
        self.assertEqual(self.faults, [])

    def test_be_accessible(self) -> None:
        """On phone and desktop, in light and dark, the page of a stopped team has no accessibility violation."""
        for screen in (PHONE, DESK):
            page = self.opened(screen)
            page.locator(".preview li").first.wait_for(state="attached")
            page.locator(".stop").click()
            page.locator(".halted").wait_for()
            self.sound_by_day_and_night(page)
            page.context.close()
