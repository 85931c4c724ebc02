"""Tests of ``webnode.app``."""

from __future__ import annotations

import gzip
import logging
import re
from pathlib import Path
from typing import Any

from flask.testing import FlaskClient
from twisted.trial.unittest import SynchronousTestCase

from tests.webnode.memory import MemoryTeamControl
from webnode.app import create_app
from webnode.auth import OpenSessions
from webnode.failover import Fallbacks, Page
from webnode.request_guard import HEADERS
from webnode.server import read_static
from webnode.services import Services
from webnode.state import DepartedDevices, State, format_state

YARD: dict[str, Any] = {"walls": [3.0, 2.4], "dogs": [], "target": None}


class AppTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.control = MemoryTeamControl([{"name": "search", "title": "Search", "requirements": {}}], YARD)
        dogs = [{"uuid": f"{n:02x}", "name": f"dog{n}", "joined": n} for n in (2, 1, 3)]
        departed = DepartedDevices()
        departed.update(dogs, 1.0)
        gone = departed.update(dogs[:2], 2.0)
        self.state = format_state(dogs[:2], [{"id": "t1", "title": "Search"}], {}, departed=gone, node="vaio")
        self.client = self.client_of(lambda: self.state)

    def client_of(self, read: Any) -> FlaskClient:
        fallbacks = Fallbacks(Page("02", "http://other:8080"))
        self.services = Services(self.control, OpenSessions(), fallbacks=fallbacks)
        app = create_app(read, self.services, wall=lambda: 1e9)
        app.logger.setLevel(logging.CRITICAL + 1)
        return app.test_client()

    def test_serve_page(self) -> None:
        """The page contains the name of its node, has the strict headers, and is revalidated by ETag."""
        page = self.client.get("/")
        self.assertIn(b'<b id="node">vaio</b>', page.data)
        for name, value in HEADERS.items():
            self.assertEqual(page.headers[name], value)
        self.assertEqual(page.headers["Cache-Control"], "no-cache")
        self.assertEqual(self.client.get("/", headers={"If-None-Match": page.headers["ETag"]}).status_code, 304)

    def test_page_escapes_names(self) -> None:
        """Markup in a node's name is escaped."""
        self.state["node"] = "<script>alert(1)</script>"
        self.assertNotIn(b"<script>alert", self.client.get("/").data)

    def test_read(self) -> None:
        """State, devices in the order of joining, tasks and catalogue are returned as JSON."""
        self.assertEqual(self.client.get("/api/v1/state").get_json(), self.state)
        devices = self.client.get("/api/v1/devices").get_json()
        self.assertEqual([device["name"] for device in devices], ["dog1", "dog2", "dog3"])
        self.assertEqual([task["id"] for task in self.client.get("/api/v1/tasks").get_json()], ["t1"])
        self.assertEqual([task["name"] for task in self.client.get("/api/v1/catalogue").get_json()], ["search"])

    def test_grant(self) -> None:
        """Every valid request reaches the team control and gets status 202."""
        wishes: list[tuple[str, Any]] = [
            ("/api/v1/demo", {}),
            ("/api/v1/tasks", {"name": "search"}),
            ("/api/v1/tasks/t1/cancel", {}),
            ("/api/v1/tasks/t1/pause", {}),
            ("/api/v1/tasks/t1/resume", {}),
            ("/api/v1/message", {"text": "all of you"}),
            ("/api/v1/devices/01/message", {"text": "sit"}),
            ("/api/v1/devices/01/disconnect", {"seconds": 5}),
            ("/api/v1/devices/01/disconnect", {}),
            ("/api/v1/target", {"x": 1, "y": 2.4}),
        ]
        for path, body in wishes:
            self.assertEqual(self.client.post(path, json=body).status_code, 202, path)
        self.assertEqual(self.client.delete("/api/v1/target", headers={"X-Swarm": "1"}).status_code, 202)
        self.assertEqual(
            self.control.asked,
            [
                ("demo",),
                ("assign", "search"),
                ("cancel", "t1"),
                ("pause", "t1"),
                ("resume", "t1"),
                ("message", "", "all of you"),
                ("message", "01", "sit"),
                ("disconnect", "01", 5.0),
                ("disconnect", "01", 15.0),
                ("target", 1.0, 2.4),
                ("clear",),
            ],
        )

    def test_tell_who_can(self) -> None:
        """The response to an assignment contains the id, the able devices, and the refused devices with reasons."""
        answer = {"id": "t2", "able": ["dog1"], "refused": {"dog2": ["no camera"]}}
        self.control.assign = lambda name, tolerates=1, group="", task_id="": {**answer, "for": tolerates}  # type: ignore
        told = self.client.post("/api/v1/tasks", json={"name": "search"}).get_json()
        self.assertEqual(told, {**answer, "for": 1})
        told = self.client.post("/api/v1/tasks", json={"name": "search", "tolerates": 3}).get_json()
        self.assertEqual(told["for"], 3)

    def test_groups(self) -> None:
        """A task can be assigned to a group with a name of 1 to 64 characters."""
        asked: list[Any] = []
        self.control.assign = lambda *wish: asked.append(wish) or {"id": "t"}  # type: ignore
        for body, code in (({"group": "yard"}, 202), ({}, 202), ({"group": "x" * 65}, 400), ({"group": 5}, 400)):
            self.assertEqual(self.client.post("/api/v1/tasks", json={"name": "search", **body}).status_code, code)
        self.assertEqual(asked, [("search", 1, "yard", ""), ("search", 1, "", "")])

    def test_id_of_a_named_wish(self) -> None:
        """The id of a task is derived from the request's idempotency key, identically on every web node."""
        other = self.client_of(lambda: self.state)

        def asked(client: FlaskClient, path: str, key: str) -> str:
            body = {"name": "search"} if path == "tasks" else {}
            answer = client.post(f"/api/v1/{path}", json=body, headers={"Idempotency-Key": key})
            return str(answer.get_json()["id"])

        wishes = [(path, key) for path in ("tasks", "demo") for key in ("a-1", "a-2")]
        ids = [asked(self.client, path, key) for path, key in wishes]
        self.assertEqual(len(set(ids)), 4)
        self.assertEqual([asked(other, path, key) for path, key in wishes], ids)

    def test_refuse(self) -> None:
        """Every invalid request gets its status and an error with field, problem and remedy, but has no effect."""
        wishes: list[tuple[str, Any, int, str]] = [
            ("/api/v1/tasks", {"name": "fly"}, 404, "name"),
            ("/api/v1/tasks", {}, 400, "name"),
            ("/api/v1/tasks", [], 400, "body"),
            ("/api/v1/tasks", {"name": "search", "toleratse": 2}, 400, "toleratse"),
            ("/api/v1/tasks", {"name": "search", "tolerates": 4}, 400, "tolerates"),
            ("/api/v1/tasks/t9/cancel", {}, 404, "task"),
            ("/api/v1/tasks/t9/pause", {}, 404, "task"),
            ("/api/v1/tasks/t1/explode", {}, 404, "/api/v1/tasks/t1/explode"),
            ("/api/v1/devices/99/message", {"text": "x"}, 404, "device"),
            ("/api/v1/devices/03/message", {"text": "x"}, 409, "device"),
            ("/api/v1/devices/01/message", {"text": "x" * 141}, 400, "text"),
            ("/api/v1/devices/01/message", {"text": "\x00 "}, 400, "text"),
            ("/api/v1/devices/01/disconnect", {"seconds": 0}, 400, "seconds"),
            ("/api/v1/devices/01/disconnect", {"seconds": 601}, 400, "seconds"),
            ("/api/v1/devices/01/disconnect", {"seconds": True}, 400, "seconds"),
            ("/api/v1/target", {"x": 1}, 400, "y"),
            ("/api/v1/target", {"x": 3.1, "y": 1}, 400, "target"),
            ("/api/v1/target", {"x": 10**400, "y": 1}, 400, "x"),
        ]
        for path, body, status, field in wishes:
            answer = self.client.post(path, json=body)
            error = answer.get_json()["error"]
            self.assertEqual((answer.status_code, error["field"]), (status, field), (path, error))
            self.assertTrue(error["problem"] and error["remedy"])
        self.assertEqual(self.control.asked, [])

    def test_refuse_broken_bodies(self) -> None:
        """Malformed, deeply nested and non-finite bodies get status 400."""
        headers = {"Content-Type": "application/json"}
        for body in (b"{", b"\xff", b'{"x": NaN, "y": 1}', b'{"x": 1e999, "y": 1}', b"[" * 60000):
            answer = self.client.post("/api/v1/target", data=body, headers=headers)
            self.assertEqual(answer.status_code, 400, body[:20])

    def test_do_once_what_is_asked_twice(self) -> None:
        """A request that is repeated with its idempotency key is executed once; an invalid key is rejected."""
        answers = [self.client.post("/api/v1/demo", json={}, headers={"Idempotency-Key": "a1"}) for _ in range(2)]
        self.assertEqual([answer.status_code for answer in answers], [202, 202])
        self.assertEqual(answers[0].get_json(), answers[1].get_json())
        self.assertEqual(self.control.asked, [("demo",)])
        bad = self.client.post("/api/v1/demo", json={}, headers={"Idempotency-Key": "x" * 65})
        self.assertEqual((bad.status_code, bad.get_json()["error"]["field"]), (400, "Idempotency-Key"))

    def test_share_with_the_team(self) -> None:
        """A page of another web node of the team may read and send requests, also after a CORS preflight.

        A page of any other origin may not.
        """
        other, evil = {"Origin": "http://other:8080"}, {"Origin": "http://evil:8080"}
        for headers, told in ((other, "http://other:8080"), (evil, None)):
            answer = self.client.get("/api/v1/state", headers=headers)
            self.assertEqual(answer.headers.get("Access-Control-Allow-Origin"), told)
        self.assertEqual(self.client.options("/api/v1/demo", headers=other).status_code, 204)
        self.assertEqual(self.client.options("/api/v1/demo", headers=evil).status_code, 403)
        self.assertEqual(self.client.post("/api/v1/demo", json={}, headers=other).status_code, 202)

    def test_hide_failures(self) -> None:
        """An internal error gives status 500 without details. Unknown paths and methods also give errors in JSON."""

        def fail() -> State:
            raise RuntimeError("secret path")

        answer = self.client_of(fail).get("/api/v1/state")
        self.assertEqual(answer.status_code, 500)
        self.assertNotIn(b"secret", answer.data)
        self.assertEqual(self.client.get("/nowhere").get_json()["error"]["problem"], "not found")
        wrong = self.client.put("/api/v1/demo", json={})
        self.assertEqual((wrong.status_code, wrong.headers["Allow"]), (405, "OPTIONS, POST"))
        self.assertEqual(self.client.get("/api/state").status_code, 404)

    def test_weigh_page(self) -> None:
        """The first load stays below 100 kB, or 36 kB compressed, and no file of the page refers to another origin."""
        room = Path(__file__).parents[2] / "webnode"
        first, wanted = [], [room / "templates" / "index.html"]
        for path in wanted:
            first.append(path)
            named = re.findall(r"""(?:href|src)="/static/([^"]+)"|^import [^;]*?"./([^"]+)";""", path.read_text(), re.M)
            found = [room / "static" / (here or beside) for here, beside in named]
            wanted += [each for each in dict.fromkeys(found) if each not in wanted]
        self.assertIn(room / "static" / "stream.js", first)
        # The page loads the texts of one language; the largest catalogue is counted.
        first.append(max((room / "static" / "texts").iterdir(), key=lambda path: path.stat().st_size))
        self.assertLess(sum(len(read_static(path)) for path in first), 100_000)
        self.assertLess(sum(len(gzip.compress(read_static(path))) for path in first), 36_000)
        files = [path for folder in ("static", "templates") for path in (room / folder).rglob("*") if path.is_file()]
        for path in files:
            words = (
                path.read_text()
                .replace("http://www.w3.org/2000/svg", "")
                .replace('"https:")', "")
                .replace('"http:"', "")
            )
            self.assertNotIn("http:", words, path.name)
            self.assertNotIn("https:", words, path.name)
