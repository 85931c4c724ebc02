"""Tests that the page shows scripts as text and runs none; 200 scripts are used as names, tasks and messages."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.live.page import DESK, PageCase

BARE = """\
<script>ran()</script>
<script src=//evil.example/x.js></script>
<img src=x onerror=ran()>
<svg onload=ran()>
<svg><script>ran()</script></svg>
<body onload=ran()>
<iframe src=javascript:ran()>
<iframe srcdoc='<script>parent.ran()</script>'>
<a href=javascript:ran()>x</a>
<details open ontoggle=ran()>
<input autofocus onfocus=ran()>
<video><source onerror=ran()></video>
<math href=javascript:ran()>x</math>
<object data=javascript:ran()>
<embed src=javascript:ran()>
<form action=javascript:ran()><button>x</form>
<base href=//evil.example/>
<link rel=stylesheet href=//evil.example/x.css>
<meta http-equiv=refresh content=0>
<style>@import '//evil.example/x.css'</style>
<div style=background:url(//evil.example/x.png)>x</div>
<template><script>ran()</script></template>
<marquee onstart=ran()>x</marquee>
<img src=//evil.example/x.png>
<svg><animate onbegin=ran() attributeName=x dur=1s></svg>
"""
WAYS = (
    "{}",
    "\"'>{}",
    "</title></style></script></textarea>{}",
    "${{ran()}}{{{{ran()}}}}<%= ran() %>{}",
    "javascript:ran()//{}",
    "\N{RIGHT-TO-LEFT OVERRIDE}\N{FULLWIDTH LESS-THAN SIGN}script\N{FULLWIDTH GREATER-THAN SIGN}{}",
    "&lt;script&gt;ran()&lt;/script&gt;&#60;img src=x onerror=ran()&#62;{}",
    "data: x\n\nevent: state\ndata: {{}}\n\n{}",
)
BATCH = 8
PAYLOADS = [way.format(bare) for way in WAYS for bare in BARE.splitlines()]
WATCH = """
globalThis.violations = [];
globalThis.ran = () => { globalThis.hasRun = true; };
addEventListener("securitypolicyviolation", ({ effectiveDirective }) => violations.push(effectiveDirective));
"""


class ScriptTests(PageCase):
    def setUp(self) -> None:
        super().setUp()
        self.page = self.tab(DESK)
        self.dialogs: list[str] = []
        self.page.on("dialog", self.on_dialog)
        self.page.add_init_script(WATCH)

    def on_dialog(self, dialog: Any) -> None:
        self.dialogs.append(dialog.message)
        dialog.dismiss()

    def show(self, words: list[str]) -> None:
        """Replace the team's texts with ``words``."""
        path = Path(self.mktemp()).absolute()
        path.write_text(json.dumps(words), encoding="utf-8")
        self.team.order(f"strange {path}")

    def test_show_scripts_as_text(self) -> None:
        """None of 200 scripts in names, titles, notes, messages and capabilities runs or violates the CSP."""
        self.assertEqual(len(set(PAYLOADS)), 200)
        self.show(PAYLOADS)
        self.page.goto(f"{self.team.url}#code={self.team.code}")
        self.page.locator(".device").nth(199).wait_for()
        shown = self.page.locator(".device b").all_inner_texts()
        self.assertEqual(len(shown), 200)
        self.assertTrue(any("<script>ran()</script>" in name for name in shown))
        for number in (1, 27, 52, 180):
            self.page.evaluate(f"location.hash = 'device/{f'{number:02x}' * 16}'")
            self.page.locator("dialog[open]").wait_for()
            self.assertIn("<", self.page.locator("dialog[open]").inner_text())
            self.page.keyboard.press("Escape")
            self.page.locator("dialog[open]").wait_for(state="hidden")
        # The page lists only the newest tasks, so the scripts are shown in batches.
        for number in range(len(PAYLOADS) // BATCH):
            self.show(PAYLOADS[number * BATCH : (number + 1) * BATCH])
            self.page.locator(f"#tasks li[data-key=s{2 + number}-{BATCH}]").wait_for()
            self.page.evaluate("document.querySelectorAll('details').forEach((each) => { each.open = true; })")
        self.page.wait_for_timeout(1000)
        self.assertEqual(self.page.evaluate("[globalThis.hasRun ?? false, violations]"), [False, []])
        self.assertEqual((self.dialogs, self.faults), ([], []))
        self.assertEqual([url for url in self.asked if not url.startswith((self.team.url, "data:"))], [])
        self.assertEqual(
            self.page.locator("main :is(script, iframe, object, embed, base, link, style, img)").count(), 0
        )

    def test_notice_what_would_run(self) -> None:
        """The test above would notice a script that runs: the browser reports inserted markup as a CSP violation."""
        self.page.goto(f"{self.team.url}#code={self.team.code}")
        self.page.locator(".device").first.wait_for()
        self.page.evaluate("document.body.insertAdjacentHTML('beforeend', '<img src=x onerror=ran()>')")
        self.page.wait_for_function("() => violations.length > 0")
