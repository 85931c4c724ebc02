"""Tests of every route of a real page with every role and with invalid requests: permissions and errors."""

from __future__ import annotations

import http.client
import json
import re
import socket
import time
from collections.abc import Callable
from email.message import Message
from importlib.util import find_spec
from typing import Any, get_args

from tests.live.keys import key_of
from tests.live.page import TeamCase
from webnode.auth import Role
from webnode.request_guard import HEADERS
from webnode.route import ALLOWED_ROLES, Route
from webnode.routes.phones import PHONE_PREFIX
from webnode.routes.registry import TABLE
from webnode.token import Claim

MISSING = [name for name in ("flask", "cv2") if find_spec(name) is None]
NAMES = {"uuid": "01" * 16, "task_id": "t1", "file": "page.js"}
REFUSED_S = 0.05
DEEP = b'{"text": ' + b"[" * 100_000 + b"]" * 100_000 + b"}"
Answer = tuple[int, Message, bytes]


def path_of(route: Route) -> str:
    """Return the path of a route, with the names of existing objects if the test knows them."""
    return re.sub(r"\{(\w+)\}", lambda found: NAMES.get(found[1], "x"), route.path)


class SafetyTests(TeamCase):
    if MISSING:
        skip = f"THE SAFETY OF THE PAGE IS NOT TESTED: missing {', '.join(MISSING)}"

    def setUp(self) -> None:
        super().setUp()
        self._key = key_of("vaio")
        self._number = 0

    def token(self, role: Role, ticket: bool = False, name: str = "") -> str:
        """Return an unused token of this role; an empty string for the role ``anyone``."""
        if role == "anyone":
            return ""
        self._number += 1
        claim = Claim(f"{self._number:016x}", name or role, role, int(time.time()) + 600)
        return self._key.sign_token(claim.ticket if ticket else claim)

    def asked(self, method: str, path: str, body: bytes | None = None, **headers: str) -> Answer:
        """Send one request on a new connection and return the response; of a stream, read only the headers."""
        given = {name.replace("_", "-"): value for name, value in headers.items()}
        connection = http.client.HTTPConnection("127.0.0.1", self.team.port, timeout=10)
        try:
            connection.request(method, path, body, {"Content-Type": "application/json", **given})
            answer = connection.getresponse()
            is_stream = answer.getheader("Content-Type", "").startswith("text/event-stream")
            return answer.status, answer.headers, b"" if is_stream else answer.read()
        finally:
            connection.close()

    def bearer(self, role: Role, name: str = "") -> dict[str, str]:
        """Return the headers of a client that has this role."""
        token = self.token(role, name=name)
        return {"Authorization": f"Bearer {token}"} if token else {}

    def test_let_in_whom_the_table_says(self) -> None:
        """Each route accepts tokens of the roles that the table permits, and rejects all other tokens with 401 or 403.

        Every response has all security headers and does not identify the server.
        """
        wrong: list[object] = []
        for route in TABLE:
            # Requests of a phone need a token that is bound to this phone.
            name = f"{PHONE_PREFIX}{NAMES['uuid']}" if route.role == "phone" else ""
            for role in get_args(Role):
                body = None if route.method == "GET" else b"{}"
                status, headers, _ = self.asked(route.method, path_of(route), body, **self.bearer(role, name))
                wrong += self.lax(f"{route.name} {role}", headers)
                wanted = 200 if role in ALLOWED_ROLES[route.role] else 401 if role == "anyone" else 403
                if (status if status in (401, 403) else 200) != wanted:
                    wrong.append((route.name, role, status))
        self.assertEqual(wrong, [])

    def test_let_a_ticket_look_only(self) -> None:
        """An operator's ticket gives access to the routes for viewers, but not to changes and secrets."""
        wrong = []
        for route in TABLE:
            if route.role not in ("viewer", "operator"):
                continue
            body = None if route.method == "GET" else b"{}"
            status = self.asked(route.method, f"{path_of(route)}?ticket={self.token('operator', True)}", body)[0]
            if (status == 403) != (route.role == "operator"):
                wrong.append((route.name, status))
        self.assertEqual(wrong, [])

    def lax(self, name: str, headers: Message) -> list[object]:
        """Return the problems with the headers of a response."""
        lacks = [key for key, value in HEADERS.items() if headers.get(key) != value]
        lacks += [key for key in ("Server", "Set-Cookie", "X-Powered-By") if headers.get(key)]
        return [(name, lacks)] if lacks else []

    def test_send_every_header_with_errors(self) -> None:
        """Every kind of error response has all security headers and does not identify the server."""
        wrong = []
        for method, path in (("GET", "/nothing"), ("PUT", "/"), ("PUT", "/events"), ("GET", "/static/../app.py")):
            wrong += self.lax(f"{method} {path}", self.asked(method, path)[1])
        wrong += self.lax("host", self.asked("GET", "/", Host="evil.example")[1])
        for data in (
            b"nonsense\r\n\r\n",
            b"GET / HTTP/1.1\r\nno colon\r\n\r\n",
            b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 10485760\r\n\r\n",
        ):
            wrong += self.lax(data.decode(), self.raw(data)[1])
        self.assertEqual(wrong, [])

    def raw(self, data: bytes) -> Answer:
        """Return the response to bytes that no regular client would send."""
        with socket.create_connection(("127.0.0.1", self.team.port), 5.0) as client:
            client.sendall(data)
            answer = http.client.HTTPResponse(client)
            answer.begin()
            return answer.status, answer.headers, answer.read()

    def test_refuse_at_once_and_in_words(self) -> None:
        """An invalid request is refused within 50 ms, with a JSON error that contains field and remedy."""
        signed = self.bearer("operator")
        dog = f"/api/v1/devices/{'01' * 16}"

        def told(path: str, body: bytes, method: str = "POST", **headers: str) -> Any:
            return lambda: self.asked(method, path, body, **{**signed, **headers})

        head = b"POST /api/v1/message HTTP/1.1\r\nHost: localhost\r\n"
        cases = (
            ("10 MiB", 413, lambda: self.raw(head + b"Content-Length: 10485760\r\n\r\n")),
            ("65 KiB", 413, told("/api/v1/message", b"x" * 65 * 1024 + b"x")),
            ("deep", 413, told("/api/v1/message", DEEP)),
            ("deep, and small", 400, told("/api/v1/message", DEEP[:30_000])),
            ("many keys", 400, told("/api/v1/message", json.dumps({str(n): 1 for n in range(6000)}).encode())),
            ("NaN", 400, told("/api/v1/target", b'{"x": NaN, "y": 1}')),
            ("infinite", 400, told("/api/v1/target", b'{"x": 1e999, "y": 1}')),
            ("huge", 400, told("/api/v1/target", b'{"x": 1' + b"0" * 4000 + b', "y": 1}')),
            ("type", 400, told("/api/v1/message", b'{"text": {"a": 1}}')),
            ("list", 400, told("/api/v1/message", b"[1]")),
            ("no JSON", 400, told("/api/v1/message", b"{'text': 'x'}")),
            ("no UTF-8", 400, told("/api/v1/message", b'{"text": "\xff\xfe"}')),
            ("unknown field", 400, told("/api/v1/message", b'{"txet": "x"}')),
            ("host", 403, told("/api/v1/message", b'{"text": "x"}', Host="evil.example")),
            ("origin", 403, told("/api/v1/message", b'{"text": "x"}', Origin="http://evil.example")),
            ("form", 403, told("/api/v1/message", b"text=x", Content_Type="application/x-www-form-urlencoded")),
            ("method", 405, told("/api/v1/message", b"{}", "PUT")),
            ("override", 405, told("/api/v1/state", b"{}", X_HTTP_Method_Override="GET")),
            ("unknown device", 404, told(f"{dog}0/message", b'{"text": "x"}')),
            ("traversal", 404, told("/static/../../setup.cfg", b"", "GET")),
            ("hidden traversal", 404, told("/static/%2e%2e%2fapp.py", b"", "GET")),
            ("zero byte", 404, told("/static/page.js%00", b"", "GET")),
            ("both lengths", 400, lambda: self.raw(head + b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n")),
            ("two lengths", 400, lambda: self.raw(head + b"Content-Length: 5\r\nContent-Length: 6\r\n\r\n")),
            ("long line", 400, lambda: self.raw(b"GET /" + b"x" * 20_000 + b" HTTP/1.1\r\n\r\n")),
            ("many headers", 400, lambda: self.raw(head + b"X: y\r\n" * 600 + b"\r\n")),
            ("wrong code", 401, told("/api/v1/session", b'{"code": "nonsense"}')),
        )  # fmt: skip
        slow = []
        for name, wanted, ask in cases:
            status, headers, body = ask()
            self.assertEqual(status, wanted, (name, body[:300]))
            self.assertTrue(headers["Content-Type"].startswith("application/json"), name)
            self.assertEqual(set(json.loads(body)["error"]), {"field", "problem", "remedy"}, name)
            self.assertNotIn(b"Traceback", body, name)
            took = self.best(ask)
            # On a loaded machine even a valid request is slow.
            if took > REFUSED_S and took > 3 * self.best(lambda: self.asked("GET", "/api/v1/tasks", None, **signed)):
                slow.append((name, took))
        self.assertEqual(slow, [])

    def best(self, ask: Callable[[], object]) -> float:
        """Return the shortest of five durations in seconds."""
        took = []
        for _ in range(5):
            began = time.perf_counter()
            ask()
            took.append(time.perf_counter() - began)
        return min(took)
