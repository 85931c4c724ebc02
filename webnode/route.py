"""Describe a route of the API as data, and check requests against it.  Pure.

A route lists the fields of its path, query and body.  ``check_request`` converts a request or refuses it with the name
of the field.  A handler gets a ``RouteRequest`` and depends neither on HTTP nor on Flask.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from msgspec import Meta

from formats.convert import InvalidValue, Secret, Unit, convert_value, find_nearest
from webnode.auth import Role, User
from webnode.errors import Refusal
from webnode.sanitize import MAX_ENTRIES, MAX_TEXT, clean_text
from webnode.services import Services
from webnode.state import GONE, State

API = "/api/v1"
MAX_NUMBER = 1e9
REQUIRED: Any = object()
"""The default of a required field."""
ALLOWED_ROLES: Mapping[Role, tuple[Role, ...]] = {
    "anyone": ("anyone", "viewer", "operator", "phone"),
    "viewer": ("viewer", "operator", "phone"),
    "operator": ("operator",),
    "phone": ("phone", "operator"),
}
"""For each role that a route requires, the roles that satisfy it."""

Kind = Literal["text", "number", "whole", "flag", "choice", "table", "list"]
Handler = Callable[["RouteRequest"], Any]
"""Called on the reactor's thread; returns JSON or ``Content``, or a Deferred of it, and raises ``Refusal``."""
Native = Callable[[Services, Any], Any]
"""Makes the Twisted resource of a route from the services and the reactor, once, when the service is created."""


@dataclass(frozen=True)
class Field:
    """One parameter of a route.

    ``minimum`` and ``maximum`` bound a number, the characters of a text (default 1 to 300) or the entries of a list.
    ``default`` is used if the field is missing; a field without a default is required.
    """

    name: str
    kind: Kind
    description: str
    where: Literal["path", "query", "body"] = "body"
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()
    default: Any = REQUIRED
    unit: str = ""


DEVICE = Field("uuid", "text", "the device", "path", maximum=64)


@dataclass(frozen=True)
class RouteRequest:
    """A checked request for a route.

    ``id`` is the client's ``Idempotency-Key`` or empty: repeated requests with one id are carried out once.  ``source``
    is the client's address, ``now`` unix seconds, ``routes`` all routes.
    """

    values: Mapping[str, Any]
    user: User
    services: Services
    state: State
    id: str = ""
    source: str = ""
    now: float = 0.0
    routes: tuple[Route, ...] = ()


@dataclass(frozen=True)
class Content:
    """An answer that is not JSON."""

    body: bytes
    kind: str


@dataclass(frozen=True)
class Route:
    """One route of the API.

    If ``handler`` is None, not Flask but a Twisted resource serves the route, made by ``native`` or by ``server``.
    ``limit_s`` replaces the usual time limit of an answer; ``body_type`` is the media type of a native body.
    """

    method: Literal["GET", "POST", "PUT", "DELETE"]
    path: str
    description: str
    role: Role
    handler: Handler | None
    fields: tuple[Field, ...] = ()
    response: str = ""
    status: int = 200
    native: Native | None = None
    limit_s: float | None = None
    body_type: str = ""

    @property
    def name(self) -> str:
        """Method and path."""
        return f"{self.method} {self.path}"


def check_role(role: Role, user: User) -> None:
    """Check that ``user`` has the role ``role``; raises ``Refusal`` otherwise."""
    if user.role in ALLOWED_ROLES[role]:
        return
    if user.role == "anyone":
        remedy = f"sign in at POST {API}/session, and send 'Authorization: Bearer TOKEN' or ?ticket=TICKET"
        raise Refusal("Authorization", "not signed in", remedy, 401)
    raise Refusal("Authorization", f"a {user.role} may not do this", f"sign in as {role}", 403)


def check_request(route: Route, path: Mapping[str, str], query: Mapping[str, str], body: object) -> dict[str, Any]:
    """Return the values by field name; raises ``Refusal`` with the field, the problem and the remedy."""
    if not isinstance(body, Mapping):
        raise Refusal("body", "the body is not a JSON object", 'send something like {"name": "value"}')
    places: dict[str, Mapping[str, Any]] = {"path": path, "query": query, "body": body}
    known = {field.name for field in route.fields if field.where == "body"}
    for name in body:
        if name not in known:
            raise Refusal(clean_text(name, "body", 64), "unknown field", _suggest_field(name, known))
    values: dict[str, Any] = dict(path)
    for field in route.fields:
        place = places[field.where]
        if field.name in place:
            value = place[field.name]
            values[field.name] = _convert_field(field, value if field.where == "body" else _convert_text(field, value))
        elif field.default is REQUIRED:
            raise Refusal(field.name, "the field is missing", f"send {field.description}")
        else:
            values[field.name] = field.default
    return values


def find_device(request: RouteRequest) -> State:
    """Return the device of the path's ``uuid``; raises ``Refusal`` 404 if it is unknown, 409 if it has left."""
    found = [each for each in request.state["devices"] if each["uuid"] == request.values["uuid"]]
    if not found:
        raise Refusal("device", "unknown device", f"choose one of {API}/devices", 404)
    if found[0]["status"] == GONE:
        raise Refusal("device", f"{found[0]['name']} has left the network", "wait until the device is back", 409)
    return dict(found[0])


def _suggest_field(name: object, known: Collection[str]) -> str:
    near = f"the nearest is {find_nearest(str(name), known)}" if known else "this route takes no fields"
    return f"remove the field; {near}"


def _convert_text(field: Field, text: str) -> object:
    """Convert the text of a path or query field; an invalid text stays as it is and fails the check."""
    if field.kind in ("number", "whole"):
        try:
            return float(text)
        except ValueError:
            return text
    return {"true": True, "false": False}.get(text, text) if field.kind == "flag" else text


def make_type_hint(field: Field) -> Any:
    """Return the type of a field with its bounds, for conversion and documentation."""
    minimum, maximum = field.minimum, field.maximum
    match field.kind:
        case "text":  # the value may be a password, so errors must not repeat it
            return Annotated[
                str,
                Meta(min_length=int(1 if minimum is None else minimum), max_length=_get_max_length(field)),
                Secret(),
            ]
        case "number" | "whole":
            low, high = -MAX_NUMBER if minimum is None else minimum, MAX_NUMBER if maximum is None else maximum
            if field.kind == "whole":
                return Annotated[int, Meta(ge=int(low), le=int(high))]
            return Annotated[float, Meta(ge=low, le=high), *([Unit(field.unit)] if field.unit else [])]
        case "choice":
            return Literal[field.choices]
        case "list":
            return Annotated[list[Any], Meta(min_length=int(minimum or 0), max_length=int(maximum or MAX_ENTRIES))]
    return {"flag": bool, "table": dict[str, Any]}[field.kind]


def _get_max_length(field: Field) -> int:
    return MAX_TEXT if field.maximum is None else int(field.maximum)


def _convert_field(field: Field, value: object) -> Any:
    hint = make_type_hint(field)
    if field.kind == "whole" and isinstance(value, float) and value.is_integer():
        value = int(value)
    try:
        converted = convert_value(value, hint, field.name)
        return (
            convert_value(clean_text(converted, limit=_get_max_length(field)), hint)
            if field.kind == "text"
            else converted
        )
    except InvalidValue as error:
        raise Refusal(field.name, f"it {error.problem}", error.remedy) from None
