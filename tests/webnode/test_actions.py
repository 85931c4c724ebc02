"""Tests of the operator routes: emergency stop, preview of tasks, moves of robots, settings and messages."""

from __future__ import annotations

import logging
from typing import Any

from flask.testing import FlaskClient
from twisted.internet.defer import Deferred, fail
from twisted.trial.unittest import SynchronousTestCase

from tests.webnode.guests import Guests
from tests.webnode.memory import MemoryStopControl, MemoryTeamControl
from webnode.app import create_app
from webnode.errors import Refusal
from webnode.event_log import EventLog
from webnode.services import Services
from webnode.state import format_state

DOG = {"name": "dog1", "x": 0.5, "y": 0.5, "heading": 0.25, "stripes": 1}
API = "/api/v1"


class ActionTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.control = MemoryTeamControl([{"name": "search"}], {"walls": [3.0, 2.4], "dogs": [DOG], "target": None})
        self.stop_control = MemoryStopControl("01", "02")
        self.event_log = EventLog()
        self.control.settings["01"] = [["description", "a dog", "A line", "", None, 200.0]]
        self.services = Services(self.control, Guests(), event_log=self.event_log, stop_control=self.stop_control)
        state = format_state([{"uuid": "01", "name": "dog1", "joined": 1}], [], {}, node="vaio")
        app = create_app(lambda: {**state, "halted": self.stop_control.is_halted()}, self.services, wall=lambda: 1e9)
        app.logger.setLevel(logging.CRITICAL + 1)
        self.client: FlaskClient = app.test_client()

    def ask(self, method: str, path: str, body: Any = None, role: str = "operator") -> tuple[int, Any]:
        """Send a request; return the status and the JSON of the response."""
        headers = {"Authorization": f"Bearer {role}", "X-Swarm": "1"}
        answer = self.client.open(f"{API}/{path}", method=method, json=body, headers=headers)
        return answer.status_code, answer.get_json()

    def test_stop_and_go_on(self) -> None:
        """Requests to stop and release return the state of each device, and are written to the audit log.

        Viewers can read the state of the stop.
        """
        stopped = (200, {"halted": True, "devices": {"01": "stands", "02": "stands"}})
        self.assertEqual(self.ask("POST", "halt", {}), stopped)
        self.assertEqual(self.ask("GET", "halt", role="viewer"), (200, {"halted": True}))
        self.assertEqual(self.ask("DELETE", "halt")[1]["devices"], {"01": "goes on", "02": "goes on"})
        self.assertEqual(self.stop_control.said, [("halt", "operator"), ("release", "operator")])
        self.assertEqual(
            [line["route"] for line in self.services.audit.list_newest(2)], [f"DELETE {API}/halt", f"POST {API}/halt"]
        )

    def test_stop_is_for_operators(self) -> None:
        """A viewer cannot stop the team; a web node without this function rejects the request and explains why."""
        for method in ("POST", "DELETE"):
            self.assertEqual(self.ask(method, "halt", {}, "viewer")[0], 403)
        self.assertEqual(self.stop_control.said, [])
        self.services.stop_control = None
        status, answer = self.ask("POST", "halt", {})
        self.assertEqual((status, answer["error"]["field"]), (409, "halt"))

    def test_preview_is_for_viewers(self) -> None:
        """A viewer can read which devices would take a task; the error for an unknown task contains its name."""
        preview = {"able": [{"uuid": "01", "name": "dog1", "busy": ""}], "refused": {"vaio": ["no camera"]}}
        self.control.previews["search"] = {**preview, "likely": None}
        told = {**preview, "likely": None, "together": []}
        self.assertEqual(self.ask("POST", "tasks/preview", {"name": "search"}, "viewer"), (200, told))
        status, answer = self.ask("POST", "tasks/preview", {"name": "fly"}, "viewer")
        self.assertEqual((status, answer["error"]["field"]), (404, "name"))
        self.assertEqual(self.control.asked, [])

    def test_lift_a_robot(self) -> None:
        """A robot is moved to the given place, and keeps its heading unless the request contains a heading."""
        self.assertEqual(self.ask("PUT", "yard/robots/dog1", {"x": 1, "y": 2})[0], 202)
        self.assertEqual(self.ask("PUT", "yard/robots/dog1", {"x": 1, "y": 2, "heading": -1.5})[0], 202)
        self.assertEqual(self.control.asked, [("robot", "dog1", 1.0, 2.0, 0.25), ("robot", "dog1", 1.0, 2.0, -1.5)])

    def test_refuse_what_no_robot_can(self) -> None:
        """An unknown robot, a place outside the map and an invalid heading are rejected.

        The error has field and remedy.
        """
        wrong: list[tuple[str, Any, int, str]] = [
            ("cat", {"x": 1, "y": 1}, 404, "name"),
            ("dog1", {"x": 9, "y": 1}, 400, "robot"),
            ("dog1", {"x": 1}, 400, "y"),
            ("dog1", {"x": 1, "y": 1, "heading": 99}, 400, "heading"),
            ("dog1", {"x": 1, "y": 1, "heading": "north"}, 400, "heading"),
        ]
        for name, body, status, field in wrong:
            came, answer = self.ask("PUT", f"yard/robots/{name}", body)
            self.assertEqual((came, answer["error"]["field"]), (status, field), body)
            self.assertTrue(answer["error"]["remedy"])
        self.assertEqual(self.control.asked, [])
        self.control.map = None
        self.assertEqual(self.ask("PUT", "yard/robots/dog1", {"x": 1, "y": 1})[0], 409)

    def test_settings(self) -> None:
        """A viewer reads the settings of a device, an operator changes them; errors of the device are forwarded."""
        status, rows = self.ask("GET", "devices/01/settings", role="viewer")
        self.assertEqual(
            (status, rows[0]["key"], rows[0]["value"], rows[0]["most"]), (200, "description", "a dog", 200.0)
        )
        self.assertEqual(self.ask("PUT", "devices/01/settings", {"description": "x"}, "viewer")[0], 403)
        self.assertEqual(self.ask("PUT", "devices/01/settings", {"description": ""})[1][0]["value"], "")
        wrong: list[tuple[str, Any, int, str]] = [
            ("01", {}, 400, "body"),
            ("01", {"desription": "x"}, 400, "desription"),
            ("01", {"description": 5}, 400, "description"),
            ("01", {"camera_fps": 5}, 400, "camera_fps"),
            ("07", {"description": "x"}, 404, "device"),
        ]
        for uuid, body, expected, field in wrong:
            status, answer = self.ask("PUT", f"devices/{uuid}/settings", body)
            self.assertEqual((status, answer["error"]["field"]), (expected, field), body)

    def test_orders_answer_what_became_of_them(self) -> None:
        """The response to a message lists its recipients; for a device that has left, it is an error."""
        self.assertEqual(self.ask("POST", "message", {"text": "sit"}), (202, {"delivered": [], "failed": {}}))
        self.assertEqual(self.ask("POST", "devices/01/message", {"text": "sit"})[1]["id"], "01")
        left = Refusal("device", "dog1 left during the request", "wait until the device is back", 409)

        def lost(*wish: object) -> Deferred[Any]:
            return fail(left)

        control: Any = self.control
        control.send_message = control.disconnect = lost
        for path, body in (("message", {"text": "sit"}), ("disconnect", {})):
            self.assertEqual(self.ask("POST", f"devices/01/{path}", body), (409, left.fields))
        self.assertEqual(self.event_log.list_since(0), [])

    def test_disconnecting_is_a_fault_on_purpose(self) -> None:
        """Disconnecting a device is logged as an injected fault, so the takeover time counts from that moment."""
        self.ask("POST", "devices/01/disconnect", {"seconds": 5})
        (entry,) = self.event_log.list_since(0)
        self.assertEqual((entry.kind, entry.uuid, entry.at), ("fault", "01", 1e9))
