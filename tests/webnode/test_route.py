"""Tests of ``webnode.route`` and the table of routes."""

from __future__ import annotations

import re
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from tests.webnode.memory import MemoryTeamControl
from webnode.auth import OpenSessions, User
from webnode.errors import Refusal
from webnode.route import ALLOWED_ROLES, Field, Route, RouteRequest, check_request, check_role, find_device
from webnode.routes.registry import TABLE
from webnode.services import Services
from webnode.state import DepartedDevices, format_state


def route(*fields: Field) -> Route:
    return Route("POST", "/api/v1/things/{uuid}", "About a thing", "viewer", lambda request: {}, fields)


class CheckRequestTests(SynchronousTestCase):
    def refusal(self, field: Field, value: Any) -> Refusal:
        place = {field.name: value}
        query = place if field.where == "query" else {}
        body = place if field.where == "body" else {}
        found: Refusal = self.assertRaises(Refusal, check_request, route(field), {}, query, body)
        return found

    def test_take_each_kind(self) -> None:
        """Valid values of each kind are converted from path, query and body."""
        fields = (
            Field("uuid", "text", "", "path"),
            Field("after", "whole", "", "query"),
            Field("loud", "flag", "", "query"),
            Field("name", "text", "", maximum=5),
            Field("x", "number", "", minimum=-1.0, maximum=1.0),
            Field("n", "whole", "", minimum=1, maximum=3),
            Field("how", "choice", "", choices=("slow", "fast")),
            Field("can", "table", ""),
            Field("all", "list", "", maximum=2),
        )
        body = {"name": " a\tb ", "x": 1, "n": 2.0, "how": "fast", "can": {"see": 1}, "all": [1, 2]}
        given = check_request(route(*fields), {"uuid": "01"}, {"after": "7", "loud": "true", "other": "x"}, body)
        lawful = {"uuid": "01", "after": 7, "loud": True, "name": "a b", "x": 1.0, "n": 2}
        self.assertEqual(given, {**lawful, "how": "fast", "can": {"see": 1}, "all": [1, 2]})
        self.assertIs(type(given["n"]), int)

    def test_refuse_each_kind(self) -> None:
        """An invalid value of each kind is rejected; the error has field, problem and remedy."""
        wrong: list[tuple[Field, list[Any]]] = [
            (Field("name", "text", "", maximum=5), [5, None, "", " \x00", "abcdef", ["a"], {}]),
            (Field("code", "text", "", minimum=3), ["ab"]),
            (
                Field("x", "number", "", minimum=0.0, maximum=0.0),
                ["1", True, None, [], 0.1, -0.1, 10**400, float("nan")],
            ),
            (Field("x", "number", ""), [float("inf"), 2e9]),
            (Field("n", "whole", "", minimum=1, maximum=3), [0, 4, 1.5, "2"]),
            (Field("on", "flag", ""), [1, "true", None]),
            (Field("how", "choice", "", choices=("slow", "fast")), ["fas", 1, None, ["slow"]]),
            (Field("can", "table", ""), [[], "x", None]),
            (Field("all", "list", "", minimum=1, maximum=2), [{}, "x", [], [1, 2, 3]]),
            (Field("after", "whole", "", "query"), ["x", "1.5", "nan", "", "1e400"]),
            (Field("loud", "flag", "", "query"), ["yes", "1"]),
        ]
        for field, values in wrong:
            for value in values:
                refusal = self.refusal(field, value)
                self.assertEqual((refusal.field, refusal.status), (field.name, 400), value)
                self.assertTrue(refusal.problem and refusal.remedy, refusal)

    def test_ask_for_what_is_missing(self) -> None:
        """A missing field is rejected if it is required; otherwise its default is used."""
        name, seconds = Field("name", "text", ""), Field("s", "number", "", default=15.0)
        self.assertEqual(self.assertRaises(Refusal, check_request, route(name), {}, {}, {}).field, "name")
        self.assertEqual(check_request(route(seconds), {}, {}, {}), {"s": 15.0})

    def test_refuse_unknown_fields(self) -> None:
        """The error for an unknown field suggests the nearest known name; a body that is not an object is rejected."""
        refusal = self.assertRaises(
            Refusal, check_request, route(Field("tolerates", "whole", "")), {}, {}, {"toleratse": 1}
        )
        self.assertEqual(refusal.field, "toleratse")
        self.assertIn("tolerates", refusal.remedy)
        self.assertEqual(self.assertRaises(Refusal, check_request, route(), {}, {}, {"x": 1}).status, 400)
        bodies: list[object] = [None, [], "x", 5]
        for body in bodies:
            self.assertEqual(self.assertRaises(Refusal, check_request, route(), {}, {}, body).field, "body")


class CheckRoleTests(SynchronousTestCase):
    def test_let_in_by_role(self) -> None:
        """Each role may use the routes in ``ALLOWED_ROLES``; an unknown user gets status 401, other users 403."""
        for wanted, lawful in ALLOWED_ROLES.items():
            for role in ALLOWED_ROLES:
                if role in lawful:
                    check_role(wanted, User("x", role))
                else:
                    refusal = self.assertRaises(Refusal, check_role, wanted, User("x", role))
                    self.assertEqual(refusal.status, 401 if role == "anyone" else 403)


class DeviceTests(SynchronousTestCase):
    def test_find_the_device(self) -> None:
        """A present device is found; a lost device gives status 409, an unknown device 404."""
        departed, dogs = DepartedDevices(), [{"uuid": f"0{n}", "name": f"dog{n}", "joined": n} for n in (1, 2)]
        departed.update(dogs, 1.0)
        state = format_state(dogs[:1], [], {}, departed=departed.update(dogs[:1], 2.0))
        services = Services(MemoryTeamControl(), OpenSessions())
        self.assertEqual(find_device(RouteRequest({"uuid": "01"}, User(), services, state))["name"], "dog1")
        for uuid, status in (("02", 409), ("03", 404)):
            request = RouteRequest({"uuid": uuid}, User(), services, state)
            self.assertEqual(self.assertRaises(Refusal, find_device, request).status, status)


class TableTests(SynchronousTestCase):
    def test_each_route_is_whole(self) -> None:
        """Every route is unique, and has a description and a field for each parameter of its path."""
        for each in TABLE:
            named = {field.name for field in each.fields if field.where == "path"}
            self.assertEqual(named, set(re.findall(r"\{(\w+)\}", each.path)), each.name)
            self.assertTrue(each.description and all(field.description for field in each.fields), each.name)
            is_ours = each.path.startswith("/api/v1/") or each.path in ("/metrics", "/sw.js")
            self.assertTrue(each.handler is None or is_ours, each.name)
        names = [each.name for each in TABLE]
        self.assertEqual(len(names), len(set(names)))

    def test_orders_are_for_operators(self) -> None:
        """Changes require the role operator, except signing in and phones; reads require the role viewer."""
        for each in TABLE:
            if each.method != "GET" and each.role != "operator":
                self.assertTrue(each.role == "phone" or each.path in FOR_ALL, each.name)
            if each.method == "GET" and each.role == "anyone":
                self.assertIn(each.path, FOR_ALL, each.name)


FOR_ALL = ("/api/v1/node", "/api/v1/session", "/api/v1/tasks/preview", "/api/v1/ca.crt", "/static/{file}", "/sw.js")
"""The routes that are public: they reveal no secret, or are needed before signing in."""
