"""Route of the API's description: the routes as an OpenAPI 3.1 document.

Requests are checked against the same table.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import msgspec

from webnode.request_guard import MAX_BODY
from webnode.route import API, REQUIRED, Field, Route, RouteRequest, make_type_hint

VERSION = "1"
ERROR = {
    "type": "object",
    "required": ["error"],
    "properties": {
        "error": {
            "type": "object",
            "description": "The field, the problem and the remedy; for people.",
            "required": ["field", "problem", "remedy"],
            "properties": {name: {"type": "string"} for name in ("field", "problem", "remedy")},
        }
    },
}
DESCRIPTION = f"""The HTTP API of a node's page.

A request that changes something (any method but GET) is sent as JSON or with the header `X-Swarm: 1`, and is carried
out once per `Idempotency-Key`.  Bodies have at most {MAX_BODY // 1024} KiB; unknown fields are rejected.  A rejected
request is answered with a status of 400 or above and an `Error`."""


def make_document(routes: Sequence[Route], node: str = "") -> dict[str, Any]:
    """Return the document as JSON data; ``node`` is the name of the serving node."""
    paths: dict[str, dict[str, Any]] = {}
    for route in routes:
        paths.setdefault(route.path, {})[route.method.lower()] = _describe_operation(route)
    title = f"Swarm, served by {node}" if node else "Swarm"
    return {
        "openapi": "3.1.0",
        "info": {"title": title, "version": VERSION, "description": DESCRIPTION},
        "paths": paths,
        "components": {
            "schemas": {"Error": ERROR},
            "responses": {
                "Refused": {
                    "description": "Rejected.",
                    "content": _make_json_content({"$ref": "#/components/schemas/Error"}),
                }
            },
            "securitySchemes": {
                "token": {"type": "http", "scheme": "bearer", "description": f"From POST {API}/session."},
                "ticket": {"type": "apiKey", "in": "query", "name": "ticket", "description": "Read only."},
            },
        },
    }


def _describe_operation(route: Route) -> dict[str, Any]:
    body = [field for field in route.fields if field.where == "body"]
    operation: dict[str, Any] = {
        "operationId": _make_operation_id(route),
        "summary": route.description,
        "tags": [_get_tag(route)],
        "x-role": route.role,
        "security": _make_security(route),
        "parameters": [_make_parameter(field) for field in route.fields if field.where != "body"],
        "responses": {
            str(route.status): _describe_response(route),
            "default": {"$ref": "#/components/responses/Refused"},
        },
    }
    if route.method == "GET":
        return operation
    if route.handler is not None:
        operation["parameters"] += [_make_csrf_header(not body), _make_idempotency_header()]
    if route.body_type:
        operation["requestBody"] = {"required": True, "content": {route.body_type: {}}}
    if body:
        schema = {
            "type": "object",
            "properties": {field.name: _make_schema(field) for field in body},
            "required": [field.name for field in body if field.default is REQUIRED],
            "additionalProperties": False,
        }
        operation["requestBody"] = {"required": bool(schema["required"]), "content": _make_json_content(schema)}
    return operation


def _describe_response(route: Route) -> dict[str, Any]:
    """Describe the response: a media type if ``response`` is one, else text about JSON."""
    if re.fullmatch(r"\w+/[\w.+-]+", route.response):
        return {"description": route.description, "content": {route.response: {}}}
    if route.handler is None and route.method == "GET":
        return {"description": route.description}
    return {
        "description": route.response or "nothing more",
        "content": _make_json_content({"type": ["object", "array"]}),
    }


def _make_schema(field: Field) -> dict[str, Any]:
    schema = msgspec.json.schema(make_type_hint(field))
    schema["description"] = field.description + (f" ({field.unit})" if field.unit else "")
    if field.default not in (REQUIRED, None):
        schema["default"] = field.default
        if field.kind == "text" and field.default == "":
            # An omitted field may be empty, but a given one has a minimum length.
            del schema["default"]
    return schema


def _make_parameter(field: Field) -> dict[str, Any]:
    required = field.where == "path" or field.default is REQUIRED
    return {"name": field.name, "in": field.where, "required": required, "schema": _make_schema(field)}


def _make_security(route: Route) -> list[dict[str, list[str]]]:
    if route.role == "anyone":
        return []
    by_ticket = route.role == "phone" or (route.method == "GET" and route.role == "viewer")
    return [{"token": []}, {"ticket": []}] if by_ticket else [{"token": []}]


def _make_csrf_header(is_needed: bool) -> dict[str, Any]:
    description = "Shows that the request is not an HTML form of another site; required without a JSON body."
    schema = {"type": "string", "enum": ["1"]}
    return {"name": "X-Swarm", "in": "header", "required": is_needed, "description": description, "schema": schema}


def _make_idempotency_header() -> dict[str, Any]:
    description = "The client's id of the request: requests with the same id are carried out once."
    schema = {"type": "string", "maxLength": 64, "pattern": "^[!-~]*$"}
    return {"name": "Idempotency-Key", "in": "header", "required": False, "description": description, "schema": schema}


def _make_json_content(schema: dict[str, Any]) -> dict[str, Any]:
    return {"application/json": {"schema": schema}}


def _make_operation_id(route: Route) -> str:
    words = re.findall(r"\w+", route.path.removeprefix(API).replace("{", "").replace("}", ""))
    # Routes outside the API may have the same name as a route of the API.
    return "_".join([route.method.lower(), *([] if route.path.startswith(API) else ["page"]), *words])


def _get_tag(route: Route) -> str:
    found = re.search(r"\w+", route.path.removeprefix(API))
    return found[0] if found else "page"


def read_document(request: RouteRequest) -> dict[str, Any]:
    """Return the OpenAPI document."""
    return make_document(request.routes, str(request.state["node"]))


ROUTES = (
    Route(
        "GET",
        f"{API}/openapi.json",
        "This description, as OpenAPI 3.1",
        "viewer",
        read_document,
        response="the document",
    ),
)
