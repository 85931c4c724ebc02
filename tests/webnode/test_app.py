"""What ``webnode.app`` promises."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from flask.testing import FlaskClient
from twisted.trial.unittest import SynchronousTestCase

from webnode.app import create_app
from webnode.desk import MemoryDesk
from webnode.guard import HEADERS, MAX_BODY
from webnode.state import Departed, State, state_of

YARD: dict[str, Any] = {"walls": [3.0, 2.4], "dogs": [], "target": None}


class AppTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.desk = MemoryDesk([{"name": "search", "title": "Search", "requirements": {}}], YARD)
        dogs = [{"uuid": f"{n:02x}", "name": f"dog{n}", "joined": n} for n in (2, 1, 3)]
        departed = Departed()
        departed.of(dogs, 1.0)
        gone = departed.of(dogs[:2], 2.0)
        self.state = state_of(dogs[:2], [{"id": "t1", "title": "Search"}], {}, departed=gone, node="vaio")
        self.client = self.client_of(lambda: self.state)

    def client_of(self, read: Any) -> FlaskClient:
        app = create_app(read, self.desk)
        app.logger.setLevel(logging.CRITICAL + 1)
        return app.test_client()

    def test_serve_page(self) -> None:
        """The page names the node that serves it, carries the strict headers, and is revalidated by ETag."""
        page = self.client.get("/")
        self.assertIn(b'<b id="node">vaio</b>', page.data)
        for name, value in HEADERS.items():
            self.assertEqual(page.headers[name], value)
        self.assertEqual(page.headers["Cache-Control"], "no-cache")
        self.assertEqual(self.client.get("/", headers={"If-None-Match": page.headers["ETag"]}).status_code, 304)

    def test_page_escapes_names(self) -> None:
        """A node whose name is markup is shown as text."""
        self.state["node"] = "<script>alert(1)</script>"
        self.assertNotIn(b"<script>alert", self.client.get("/").data)

    def test_read(self) -> None:
        """State, devices in the order of joining, tasks and catalogue are JSON."""
        self.assertEqual(self.client.get("/api/state").get_json(), self.state)
        devices = self.client.get("/api/devices").get_json()
        self.assertEqual([device["name"] for device in devices], ["dog1", "dog2", "dog3"])
        self.assertEqual([task["id"] for task in self.client.get("/api/tasks").get_json()], ["t1"])
        self.assertEqual([task["name"] for task in self.client.get("/api/catalogue").get_json()], ["search"])

    def test_grant(self) -> None:
        """Every lawful wish reaches the desk and is answered with 202."""
        wishes: list[tuple[str, Any]] = [
            ("/api/demo", {}),
            ("/api/tasks", {"name": "search"}),
            ("/api/tasks/t1/cancel", {}),
            ("/api/tasks/t1/pause", {}),
            ("/api/tasks/t1/resume", {}),
            ("/api/message", {"text": "all of you"}),
            ("/api/devices/01/message", {"text": "sit"}),
            ("/api/devices/01/disconnect", {"seconds": 5}),
            ("/api/devices/01/disconnect", {}),
            ("/api/target", {"x": 1, "y": 2.4}),
        ]
        for path, body in wishes:
            self.assertEqual(self.client.post(path, json=body).status_code, 202, path)
        self.assertEqual(self.client.delete("/api/target", headers={"X-Swarm": "1"}).status_code, 202)
        self.assertEqual(
            self.desk.asked,
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
        """Assigning answers the id, who is able, and who was refused and why."""
        answer = {"id": "t2", "able": ["dog1"], "refused": {"dog2": ["no camera"]}}
        self.desk.assign = lambda name, tolerates=1: {**answer, "for": tolerates}  # type: ignore[method-assign]
        told = self.client.post("/api/tasks", json={"name": "search"}).get_json()
        self.assertEqual(told, {**answer, "for": 1})
        told = self.client.post("/api/tasks", json={"name": "search", "tolerates": 3}).get_json()
        self.assertEqual(told["for"], 3)

    def test_refuse(self) -> None:
        """Every unlawful wish gets its code and an error with field, problem and remedy, and reaches nobody."""
        wishes: list[tuple[str, Any, int, str]] = [
            ("/api/tasks", {"name": "fly"}, 404, "name"),
            ("/api/tasks", {}, 400, "name"),
            ("/api/tasks", [], 400, "body"),
            ("/api/tasks/t9/cancel", {}, 404, "task"),
            ("/api/tasks/t9/pause", {}, 404, "task"),
            ("/api/tasks/t1/explode", {}, 404, "/api/tasks/t1/explode"),
            ("/api/devices/99/message", {"text": "x"}, 404, "device"),
            ("/api/devices/03/message", {"text": "x"}, 409, "device"),
            ("/api/devices/01/message", {"text": "x" * 141}, 400, "text"),
            ("/api/devices/01/message", {"text": "\x00 "}, 400, "text"),
            ("/api/devices/01/disconnect", {"seconds": 0}, 400, "seconds"),
            ("/api/devices/01/disconnect", {"seconds": 601}, 400, "seconds"),
            ("/api/devices/01/disconnect", {"seconds": True}, 400, "seconds"),
            ("/api/target", {"x": 1}, 400, "y"),
            ("/api/target", {"x": 3.1, "y": 1}, 400, "target"),
            ("/api/target", {"x": 10**400, "y": 1}, 400, "x"),
        ]
        for path, body, status, field in wishes:
            answer = self.client.post(path, json=body)
            error = answer.get_json()["error"]
            self.assertEqual((answer.status_code, error["field"]), (status, field), (path, error))
            self.assertTrue(error["problem"] and error["remedy"])
        self.assertEqual(self.desk.asked, [])

    def test_refuse_broken_bodies(self) -> None:
        """No body, however broken, nested or not a number, becomes anything but a 400."""
        headers = {"Content-Type": "application/json"}
        for body in (b"{", b"\xff", b'{"x": NaN, "y": 1}', b'{"x": 1e999, "y": 1}', b"[" * 60000):
            answer = self.client.post("/api/target", data=body, headers=headers)
            self.assertEqual(answer.status_code, 400, body[:20])

    def test_cap_body(self) -> None:
        """A body of more than 64 KiB is refused."""
        answer = self.client.post("/api/message", json={"text": "x" * MAX_BODY})
        self.assertEqual((answer.status_code, answer.get_json()["error"]["remedy"]), (413, "send less"))

    def test_refuse_foreign_sites(self) -> None:
        """A foreign form, a foreign origin and a foreign name for this node change nothing and read nothing."""
        form = self.client.post("/api/demo", data={"a": "b"})
        origin = self.client.post("/api/demo", json={}, headers={"Origin": "http://evil.example"})
        name = self.client.get("/api/state", headers={"Host": "evil.example"})
        self.assertEqual([answer.status_code for answer in (form, origin, name)], [403, 403, 403])
        self.assertEqual(self.desk.asked, [])

    def test_refuse_without_yard(self) -> None:
        """Without a yard a target is refused in words."""
        self.desk.ground = None
        self.assertEqual(self.client.post("/api/target", json={"x": 1, "y": 1}).status_code, 409)

    def test_hide_failures(self) -> None:
        """A failure inside is answered with 500 and no trace; an unknown path and method with theirs, all as JSON."""

        def fail() -> State:
            raise RuntimeError("secret path")

        answer = self.client_of(fail).get("/api/state")
        self.assertEqual(answer.status_code, 500)
        self.assertNotIn(b"secret", answer.data)
        self.assertEqual(self.client.get("/nowhere").get_json()["error"]["problem"], "not found")
        self.assertEqual(self.client.put("/api/demo", json={}).status_code, 405)

    def test_weigh_page(self) -> None:
        """The whole page, scripts and icon included, stays under 42 kB, and names no other origin."""
        room = Path(__file__).parents[2] / "webnode"
        files = [path for folder in ("static", "templates") for path in (room / folder).iterdir() if path.is_file()]
        self.assertLess(sum(path.stat().st_size for path in files), 42_000)
        for path in files:
            words = path.read_text().replace("http://www.w3.org/2000/svg", "")
            self.assertNotIn("http:", words, path.name)
            self.assertNotIn("https:", words, path.name)
