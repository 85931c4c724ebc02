"""Tests of ``webnode.routes.openapi``: the document matches the table of routes."""

from __future__ import annotations

import json
import re
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from tests.webnode.guests import Guests
from tests.webnode.memory import MemoryTeamControl
from webnode.app import create_app
from webnode.route import Field, Route
from webnode.routes.openapi import make_document
from webnode.routes.registry import TABLE
from webnode.services import Services
from webnode.state import format_state

FIELDS = (
    Field("uuid", "text", "which", "path", maximum=64),
    Field("after", "whole", "a number", "query", minimum=0, maximum=9, default=0),
    Field("x", "number", "where", unit="m"),
    Field("kind", "choice", "what", choices=("a", "b"), default="a"),
    Field("name", "text", "who", default=""),
)


class DocumentTests(SynchronousTestCase):
    def operation(self, route: Route) -> Any:
        return make_document([route])["paths"][route.path][route.method.lower()]

    def test_have_every_route(self) -> None:
        """The document has exactly the routes of the table, each with a unique operation id."""
        told = make_document(TABLE)
        found = {f"{method.upper()} {path}" for path, each in told["paths"].items() for method in each}
        self.assertEqual(found, {route.name for route in TABLE})
        names = [each["operationId"] for methods in told["paths"].values() for each in methods.values()]
        self.assertEqual(len(set(names)), len(TABLE))
        self.assertEqual(json.loads(json.dumps(told)), told)

    def test_say_what_a_field_may_be(self) -> None:
        """Bounds, choices, defaults, units and locations of fields are documented as they are checked."""
        told = self.operation(Route("POST", "/api/v1/things/{uuid}", "About", "operator", lambda ask: {}, FIELDS))
        by_name = {each["name"]: each for each in told["parameters"]}
        self.assertEqual(by_name["uuid"]["schema"]["maxLength"], 64)
        self.assertTrue(by_name["uuid"]["required"])
        self.assertEqual((by_name["after"]["in"], by_name["after"]["required"]), ("query", False))
        self.assertEqual([by_name["after"]["schema"][key] for key in ("minimum", "maximum", "default")], [0, 9, 0])
        body = told["requestBody"]["content"]["application/json"]["schema"]
        self.assertEqual((body["required"], body["additionalProperties"]), (["x"], False))
        self.assertEqual(body["properties"]["x"]["description"], "where (m)")
        self.assertEqual(body["properties"]["kind"]["enum"], ["a", "b"])
        self.assertNotIn("default", body["properties"]["name"])
        self.assertFalse(by_name["X-Swarm"]["required"])

    def test_say_who_may(self) -> None:
        """Public routes need no credentials, routes for viewers a token or ticket, operator routes a token."""
        for role, method, wanted in (
            ("anyone", "GET", ()),
            ("viewer", "GET", ("token", "ticket")),
            ("operator", "GET", ("token",)),
            ("operator", "POST", ("token",)),
            ("phone", "POST", ("token", "ticket")),
        ):
            told = self.operation(Route(method, "/api/v1/x", "X", role, lambda ask: {}))  # type: ignore[arg-type]
            self.assertEqual((told["security"], told["x-role"]), ([{each: []} for each in wanted], role))

    def test_say_what_is_given(self) -> None:
        """A response with a media type is documented with this type, any other as JSON with a description.

        Errors are documented by a reference to a shared description.
        """
        picture = self.operation(Route("GET", "/shot", "A picture", "viewer", None, response="image/jpeg"))
        self.assertEqual(list(picture["responses"]["200"]["content"]), ["image/jpeg"])
        order = self.operation(Route("POST", "/api/v1/x", "X", "operator", lambda ask: {}, response="id", status=202))
        self.assertEqual(order["responses"]["202"]["description"], "id")
        self.assertEqual(order["responses"]["default"], {"$ref": "#/components/responses/Refused"})

    def test_refer_to_what_is_there(self) -> None:
        """The target of every reference in the document exists."""
        told = make_document(TABLE)
        for reference in re.findall(r'"\$ref": "#/([^"]+)"', json.dumps(told)):
            part: Any = told
            for step in reference.split("/"):
                part = part[step]
            self.assertTrue(part)

    def test_be_served(self) -> None:
        """A viewer receives the document, which contains the served routes and the node's name."""
        state = format_state([], [], {}, node="vaio")
        client = create_app(lambda: state, Services(MemoryTeamControl(), Guests())).test_client()
        self.assertEqual(client.get("/api/v1/openapi.json").status_code, 401)
        told = client.get("/api/v1/openapi.json?ticket=viewer").get_json()
        self.assertIn("vaio", told["info"]["title"])
        self.assertEqual(set(told["paths"]), {route.path for route in TABLE})
