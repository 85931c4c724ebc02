"""Tests of ``webnode.routes.phones``: joining over the API, pictures through native routes, and errors."""

from __future__ import annotations

import json
import random
from typing import Any
from urllib.parse import quote

from twisted.internet.defer import succeed
from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase
from twisted.web.resource import Resource

from middleware.entangled.identity import Identity
from swarmnode.gateway import check_picture
from tests.webnode.browser import Connection, site_of
from tests.webnode.memory import MemoryPhones, MemoryTeamControl
from tests.webnode.picture import jpeg
from webnode.app import create_app
from webnode.audit import AuditLog
from webnode.auth import OpenSessions
from webnode.failover import Fallbacks, Page
from webnode.limits import AddressLimits
from webnode.request_guard import MAX_BODY
from webnode.routes.phones import ROUTES, VALUE_RANGES
from webnode.server import Root
from webnode.services import Services
from webnode.session import ANONYMOUS, SignedSessions
from webnode.state import format_state
from webnode.token import TokenKey

SECRET = "0f" * 32
JOIN: dict[str, Any] = {"secret": SECRET, "name": "anna", "width": 208, "height": 156}


class PhoneRouteTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.sessions = SignedSessions(
            TokenKey(Identity(bytes(32))), lambda _: True, "quiet-otter", "", random.Random(1), lambda *_: succeed(0)
        )
        self.phones = MemoryPhones(max_phones=2, check=check_picture)
        self.services = Services(MemoryTeamControl(), self.sessions, AuditLog(), phones=self.phones)
        state = format_state([], [], {}, node="vaio")
        self.client = create_app(lambda: state, self.services, wall=lambda: 1000.0).test_client()
        native: dict[str, Resource] = {
            route.path: route.native(self.services, None) for route in ROUTES if route.native is not None
        }
        self.site = site_of(Root(Resource(), native, self.services, lambda: 1000.0), Clock(), AddressLimits())
        self.token = self.token_of("phone")

    def token_of(self, role: Any) -> str:
        return self.sessions.issue_guest_token(ANONYMOUS, "guest", role, 1000.0, 60.0).text

    def join(self, token: str = "", **changes: Any) -> Any:
        bearer = {"Authorization": f"Bearer {token or self.token}"}
        return self.client.post("/api/v1/phones", json={**JOIN, **changes}, headers=bearer)

    def joined(self, **changes: Any) -> dict[str, Any]:
        answer = self.join(**changes)
        self.assertEqual(answer.status_code, 200, answer.get_json())
        return dict(answer.get_json())

    def send(self, path: str, body: bytes = b"", **headers: str) -> tuple[int, Any]:
        """Send a request to a native route; return the status and the JSON of the response."""
        connection = Connection(self.site)
        head = {"Host": "localhost", "Content-Length": str(len(body)), **headers}
        lines = "".join(f"{name}: {value}\r\n" for name, value in head.items())
        data = connection.send(f"POST /api/v1/{path} HTTP/1.1\r\n{lines}\r\n".encode() + body).taken()
        status, told = int(data.split(b" ", 2)[1]), data.split(b"\r\n\r\n", 1)[1]
        connection.leave()
        return status, json.loads(told)

    def look(self, phone: dict[str, Any], body: bytes, values: str = "{}", ticket: str = "") -> tuple[int, Any]:
        asked = f"ticket={ticket or phone['ticket']}&values={quote(values)}"
        return self.send(f"phones/{phone['uuid']}/look?{asked}", body)

    def test_join_look_and_leave(self) -> None:
        """A phone joins with a secret, sends pictures with a ticket, and leaves with a plain POST."""
        phone = self.joined(orientation=True)
        self.assertEqual(self.phones.can, {"width": 208, "height": 156, "orientation": True, "position": False})
        status, told = self.look(phone, jpeg(), '{"target.bearing": 0.1, "target.distance": 1}')
        self.assertEqual((status, told["fps"]), (200, 10.0))
        self.assertEqual(
            self.phones.pictures, [(phone["uuid"], jpeg(), {"target.bearing": 0.1, "target.distance": 1.0})]
        )
        self.assertEqual(self.joined()["uuid"], phone["uuid"], "the same secret is the same phone")
        status, told = self.send(f"phones/{phone['uuid']}/leave?ticket={phone['ticket']}")
        self.assertEqual((status, told, self.phones.registered), (200, {}, {}))
        self.assertEqual(self.look(phone, jpeg())[0], 404)
        self.assertEqual([line["outcome"] for line in self.services.audit.list_newest(9)], ["200"] * 3)

    def test_ask_for_the_role(self) -> None:
        """Phones and operators may join.

        Viewers, unknown users, and phones with the ticket of another phone may not.
        """
        self.assertEqual(self.join(self.token_of("operator")).status_code, 200)
        self.assertEqual(self.join(self.token_of("viewer")).status_code, 403)
        self.assertEqual(self.client.post("/api/v1/phones", json=JOIN).status_code, 401)
        phone = self.joined()
        answer = self.client.post(f"/api/v1/phones?ticket={phone['ticket']}", json={**JOIN, "secret": "ab" * 32})
        self.assertEqual((answer.status_code, answer.get_json()["error"]["field"]), (403, "ticket"))

    def test_ticket_is_of_one_phone(self) -> None:
        """The ticket of a phone is valid only at the routes of that phone.

        The token of an operator is valid at the routes of all phones.
        """
        one, other = self.joined(), self.joined(secret="1e" * 32, name="ben")
        self.assertEqual(self.look(one, jpeg(), ticket=other["ticket"])[0], 403)
        self.assertEqual(self.send(f"phones/{one['uuid']}/leave?ticket={other['ticket']}")[0], 403)
        self.assertEqual(self.look(one, jpeg(), ticket=self.token_of("viewer"))[0], 403)
        self.assertEqual(self.look(one, jpeg(), ticket="nonsense")[0], 401)
        self.assertEqual(self.look(one, jpeg(), ticket=self.token)[0], 403)
        self.assertEqual(sorted(self.phones.registered.values()), ["anna", "ben"])
        bearer = {"Authorization": f"Bearer {self.token_of('operator')}"}
        self.assertEqual(self.send(f"phones/{one['uuid']}/look", jpeg(), **bearer)[0], 200)

    def test_refuse_wrong_fields(self) -> None:
        """For each invalid field of a joining phone the error contains the field.

        A phone beyond the limit is rejected.
        """
        wrong: list[tuple[str, Any]] = [
            ("secret", "xyz"),
            ("secret", "0f" * 31),
            ("secret", "zz" * 32),
            ("name", ""),
            ("name", "Anna's phone"),
            ("name", "a" * 41),
            ("width", 641),
            ("width", 20.5),
            ("height", 0),
            ("position", "yes"),
            ("colour", "red"),
        ]
        for field, value in wrong:
            answer = self.join(**{field: value})
            self.assertEqual((answer.status_code, answer.get_json()["error"]["field"]), (400, field), value)
        for secret in ("0f", "1e"):
            self.joined(secret=secret * 32)
        self.assertEqual(self.join(secret="2d" * 32).status_code, 409)

    def test_refuse_wrong_looks(self) -> None:
        """Invalid pictures and values are rejected, and no part of them reaches the team."""
        phone = self.joined()
        for body in (b"", b"GIF89a", b"\xff\xd8\xff\xd9", jpeg(641, 10), jpeg()[:-1]):
            status, told = self.look(phone, body)
            self.assertEqual((status, told["error"]["field"]), (400, "body"))
            self.assertTrue(told["error"]["remedy"])
        wrong = [
            '{"target.bearing": 4, "target.distance": 1}',
            '{"target.distance": 1}',
            '{"warp": 1}',
            "[]",
            "{",
            "nul",
        ]
        wrong += ['{"position.lat": NaN, "position.lon": 1}', '{"orientation.yaw": true}', '{"orientation.yaw": "1"}']
        wrong += ["[" * 900, '{"orientation.yaw": 1e999}', " " * 1001, '{"orientation.yaw": ' + "9" * 900 + "}"]
        for values in wrong:
            status, told = self.look(phone, jpeg(), values)
            self.assertEqual((status, told["error"]["field"]), (400, "values"), values[:50])
        self.assertEqual(self.phones.pictures, [])
        self.assertEqual(self.look(phone, jpeg() + bytes(MAX_BODY))[0], 413)
        at_bounds = {name: measure.maximum for name, measure in VALUE_RANGES.items()}
        self.assertEqual(self.look(phone, jpeg(), json.dumps(at_bounds))[0], 200)

    def test_answer_posts_alone(self) -> None:
        """Methods except POST get status 405 with ``Allow``; longer paths get status 404."""
        self.services.sessions = OpenSessions()
        for method, path, status in (("GET", "look", 405), ("PUT", "leave", 405), ("POST", "look/more", 404)):
            asked = Connection(self.site).ask(f"/api/v1/phones/01/{path}", method, X_Swarm="1").taken()
            self.assertIn(b" %d " % status, asked)
            self.assertIn(b'"error"', asked)
            self.assertEqual(b"Allow: POST" in asked, status == 405)

    def test_share_with_the_team(self) -> None:
        """A page of another web node of the team may send pictures to this node.

        A page of an unknown origin may not.
        """
        self.services.fallbacks = Fallbacks(Page("02", "http://other:8080"))
        phone = self.joined()
        path = f"phones/{phone['uuid']}/look?ticket={phone['ticket']}"
        self.assertEqual(self.send(path, jpeg(), Origin="http://other:8080")[0], 200)
        self.assertEqual(self.send(path, jpeg(), Origin="http://evil:8080")[0], 403)

    def test_node_without_phones(self) -> None:
        """A node without support for phones rejects phones with status 409."""
        phone = self.joined()
        self.services.phones = None
        self.assertEqual(self.join().status_code, 409)
        self.assertEqual(self.look(phone, jpeg())[0], 409)
