"""Routes of the API's own description: the table of routes as an OpenAPI 3.1 document.

What is documented is what is checked.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import msgspec

from webnode.guard import MAX_BODY
from webnode.route import API, REQUIRED, Ask, Field, Route, hint_of

VERSION = "1"
ERROR = {
    "type": "object",
    "required": ["error"],
    "properties": {
        "error": {
            "type": "object",
            "description": "Where, what, and what to do about it; for people.",
            "required": ["field", "problem", "remedy"],
            "properties": {name: {"type": "string"} for name in ("field", "problem", "remedy")},
        }
    },
}
ABOUT = f"""What the page of a node does, and how to do it without the page.

An order (any method but GET) is sent as JSON, or with the header `X-Swarm: 1`, and is done once for each
`Idempotency-Key`.  Bodies have at most {MAX_BODY // 1024} KiB; a field that a route does not know is refused.  What is
refused is answered with a status from 400 on and an `Error`."""


def document(table: Sequence[Route], node: str = "") -> dict[str, Any]:
    """The document, ready to be written as JSON; ``node`` is the name of the node that serves it."""
    paths: dict[str, dict[str, Any]] = {}
    for route in table:
        paths.setdefault(route.path, {})[route.method.lower()] = _operation(route)
    title = f"Swarm, served by {node}" if node else "Swarm"
    return {
        "openapi": "3.1.0",
        "info": {"title": title, "version": VERSION, "description": ABOUT},
        "paths": paths,
        "components": {
            "schemas": {"Error": ERROR},
            "responses": {
                "Refused": {"description": "It was refused.", "content": _json({"$ref": "#/components/schemas/Error"})}
            },
            "securitySchemes": {
                "token": {"type": "http", "scheme": "bearer", "description": f"From POST {API}/session."},
                "ticket": {"type": "apiKey", "in": "query", "name": "ticket", "description": "Lets look only."},
            },
        },
    }


def _operation(route: Route) -> dict[str, Any]:
    body = [field for field in route.fields if field.where == "body"]
    operation: dict[str, Any] = {
        "operationId": _name(route),
        "summary": route.about,
        "tags": [_tag(route)],
        "x-role": route.role,
        "security": _security(route),
        "parameters": [_parameter(field) for field in route.fields if field.where != "body"],
        "responses": {str(route.status): _answer(route), "default": {"$ref": "#/components/responses/Refused"}},
    }
    if route.method == "GET":
        return operation
    if route.answer is not None:
        operation["parameters"] += [_mark(not body), _key()]
    if route.takes:
        operation["requestBody"] = {"required": True, "content": {route.takes: {}}}
    if body:
        schema = {
            "type": "object",
            "properties": {field.name: _schema(field) for field in body},
            "required": [field.name for field in body if field.default is REQUIRED],
            "additionalProperties": False,
        }
        operation["requestBody"] = {"required": bool(schema["required"]), "content": _json(schema)}
    return operation


def _answer(route: Route) -> dict[str, Any]:
    """What is given: a media type where ``gives`` is one, else words about JSON."""
    if re.fullmatch(r"\w+/[\w.+-]+", route.gives):
        return {"description": route.about, "content": {route.gives: {}}}
    if route.answer is None and route.method == "GET":
        return {"description": route.about}
    return {"description": route.gives or "nothing more", "content": _json({"type": ["object", "array"]})}


def _schema(field: Field) -> dict[str, Any]:
    schema = msgspec.json.schema(hint_of(field))
    schema["description"] = field.about + (f" ({field.unit})" if field.unit else "")
    if field.default not in (REQUIRED, None):
        schema["default"] = field.default
        if field.kind == "text" and field.default == "":
            # What may be left out as an empty text may not be given as one, where there is a least length.
            del schema["default"]
    return schema


def _parameter(field: Field) -> dict[str, Any]:
    required = field.where == "path" or field.default is REQUIRED
    return {"name": field.name, "in": field.where, "required": required, "schema": _schema(field)}


def _security(route: Route) -> list[dict[str, list[str]]]:
    if route.role == "anyone":
        return []
    by_ticket = route.role == "phone" or (route.method == "GET" and route.role == "viewer")
    return [{"token": []}, {"ticket": []}] if by_ticket else [{"token": []}]


def _mark(is_needed: bool) -> dict[str, Any]:
    about = "Says that no foreign site's form sends this; needed where there is no JSON."
    schema = {"type": "string", "enum": ["1"]}
    return {"name": "X-Swarm", "in": "header", "required": is_needed, "description": about, "schema": schema}


def _key() -> dict[str, Any]:
    about = "The client's name for the order: what comes twice by one name is done once."
    schema = {"type": "string", "maxLength": 64, "pattern": "^[!-~]*$"}
    return {"name": "Idempotency-Key", "in": "header", "required": False, "description": about, "schema": schema}


def _json(schema: dict[str, Any]) -> dict[str, Any]:
    return {"application/json": {"schema": schema}}


def _name(route: Route) -> str:
    words = re.findall(r"\w+", route.path.removeprefix(API).replace("{", "").replace("}", ""))
    # What the page reads beside the API may have the name of a route of it.
    return "_".join([route.method.lower(), *([] if route.path.startswith(API) else ["page"]), *words])


def _tag(route: Route) -> str:
    found = re.search(r"\w+", route.path.removeprefix(API))
    return found[0] if found else "page"


def openapi(ask: Ask) -> dict[str, Any]:
    """The document, from the table that is asked through."""
    return document(ask.table, str(ask.state["node"]))


ROUTES = (
    Route("GET", f"{API}/openapi.json", "This description, as OpenAPI 3.1", "viewer", openapi, gives="the document"),
)
