"""Route: one line of the API as data, from which it is checked, guarded, carried out and documented.  Pure.

A route says what may stand in its path, its query and its body; ``checked`` turns what came into what was asked for, or
refuses it in words that name the field.  An answer gets an ``Ask`` and knows neither HTTP nor Flask.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, Literal

from webnode.board import Board, Role, Visitor
from webnode.errors import Refusal
from webnode.field import Json, text
from webnode.state import GONE, State

API = "/api/v1"
MAX_NUMBER = 1e9
MAX_ENTRIES = 64
MAX_TEXT = 300
ALLOWED: Mapping[Role, tuple[Role, ...]] = {
    "anyone": ("anyone", "viewer", "operator", "phone"),
    "viewer": ("viewer", "operator", "phone"),
    "operator": ("operator",),
    "phone": ("phone", "operator"),
}
"""For each role that a route wants, the roles that have it."""

Kind = Literal["text", "number", "whole", "flag", "choice", "table", "list"]
Answer = Callable[["Ask"], Any]
"""Called on the reactor's thread; returns JSON or ``Content``, or a Deferred of it, and raises ``Refusal``."""
Native = Callable[[Board, Any], Any]
"""Makes the Twisted resource of a route from the board and the reactor, once, when the page is opened."""


@dataclass(frozen=True)
class Field:
    """One value that a route takes.

    ``least`` and ``most`` bound a number, the characters of a text (1 to 300 where they are not given) or the entries
    of a list.  ``default`` holds where a field that is not required is missing.
    """

    name: str
    kind: Kind
    about: str
    where: Literal["path", "query", "body"] = "body"
    least: float | None = None
    most: float | None = None
    choices: tuple[str, ...] = ()
    default: Json = None
    is_required: bool = True
    unit: str = ""


@dataclass(frozen=True)
class Ask:
    """What is asked of a route, checked.

    ``id`` is the client's own name for it (header ``Idempotency-Key``), empty where it gave none: what is asked twice
    by one id is done once.  ``source`` is the address that it came from, ``now`` unix seconds, ``table`` every route.
    """

    given: Mapping[str, Any]
    who: Visitor
    board: Board
    state: State
    id: str = ""
    source: str = ""
    now: float = 0.0
    table: tuple[Route, ...] = ()


@dataclass(frozen=True)
class Content:
    """An answer that is no JSON."""

    body: bytes
    kind: str


@dataclass(frozen=True)
class Route:
    """One line of the API.

    ``answer`` None: the route is not Flask's but a Twisted resource's, made by ``native`` or by the front door.
    ``limit_s`` is for answers that may take longer than the others; ``takes`` is the media type of a native body.
    """

    method: Literal["GET", "POST", "PUT", "DELETE"]
    path: str
    about: str
    role: Role
    answer: Answer | None
    fields: tuple[Field, ...] = ()
    gives: str = ""
    status: int = 200
    native: Native | None = None
    limit_s: float | None = None
    takes: str = ""

    @property
    def name(self) -> str:
        """Method and path."""
        return f"{self.method} {self.path}"


def guarded(role: Role, who: Visitor) -> None:
    """Let ``who`` ask what wants ``role``, or raise ``Refusal``."""
    if who.role in ALLOWED[role]:
        return
    if who.role == "anyone":
        remedy = f"sign in at POST {API}/session, and send 'Authorization: Bearer TOKEN' or ?ticket=TICKET"
        raise Refusal("Authorization", "nobody is signed in", remedy, 401)
    raise Refusal("Authorization", f"a {who.role} may not do this", f"sign in as {role}", 403)


def checked(route: Route, path: Mapping[str, str], query: Mapping[str, str], body: object) -> dict[str, Any]:
    """What was asked for, by field name; raises ``Refusal`` with the field, the problem and the remedy."""
    if not isinstance(body, Mapping):
        raise Refusal("body", "it is not a JSON object", 'send something like {"name": "value"}')
    places: dict[str, Mapping[str, Any]] = {"path": path, "query": query, "body": body}
    known = {field.name for field in route.fields if field.where == "body"}
    for name in body:
        if name not in known:
            raise Refusal(text(name, "body", 64), "there is no such field", _nearest(name, known))
    given: dict[str, Any] = dict(path)
    for field in route.fields:
        place = places[field.where]
        if field.name in place:
            value = place[field.name]
            given[field.name] = _value(field, value if field.where == "body" else _read(field, value))
        elif field.is_required:
            raise Refusal(field.name, "it is missing or empty", _wanted(field))
        else:
            given[field.name] = field.default
    return given


def device(ask: Ask) -> State:
    """The device that the path names by ``uuid``; raises ``Refusal`` 404 where there is none, 409 where it is gone."""
    found = [each for each in ask.state["devices"] if each["uuid"] == ask.given["uuid"]]
    if not found:
        raise Refusal("device", "there is no such device", f"choose one of {API}/devices", 404)
    if found[0]["status"] == GONE:
        raise Refusal("device", f"{found[0]['name']} has left the network", "wait until it is back", 409)
    return dict(found[0])


def _nearest(name: object, known: Iterable[str]) -> str:
    near = get_close_matches(str(name)[:64], sorted(known), n=1, cutoff=0.0)
    return f"leave it out; the nearest is {near[0]}" if near else "leave it out; this route takes no fields"


def _read(field: Field, word: str) -> object:
    """What the text of a path or query stands for, or the text itself, of which the check then complains."""
    if field.kind in ("number", "whole"):
        try:
            return float(word)
        except ValueError:
            return word
    return {"true": True, "false": False}.get(word, word) if field.kind == "flag" else word


def _value(field: Field, value: object) -> Any:
    match field.kind:
        case "text":
            return _text(field, value)
        case "number" | "whole":
            return _number(field, value)
        case "flag" if isinstance(value, bool):
            return value
        case "choice" if isinstance(value, str) and value in field.choices:
            return value
        case "table" if isinstance(value, Mapping):
            return dict(value)
        case "list" if isinstance(value, list):
            if not (field.least or 0) <= len(value) <= (field.most or MAX_ENTRIES):
                raise Refusal(field.name, f"it has {len(value)} entries", _wanted(field))
            return value
    problem = "it is none of the choices" if field.kind == "choice" else f"it is no {_WORDS[field.kind]}"
    raise Refusal(field.name, problem, _wanted(field))


def _text(field: Field, value: object) -> str:
    least, most = _lengths(field)
    if not isinstance(value, str):
        raise Refusal(field.name, "it is missing or empty", _wanted(field))
    if len(value) > most:
        raise Refusal(field.name, f"it has {len(value)} characters", f"give at most {most}")
    cleaned = text(value, limit=most)
    if len(cleaned) < least:
        raise Refusal(field.name, "it is missing or empty" if not cleaned else "it is too short", _wanted(field))
    return cleaned


def _number(field: Field, value: object) -> float | int:
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > MAX_NUMBER or math.isnan(value):
        raise Refusal(field.name, "it is missing or no number", _wanted(field))
    if field.kind == "whole" and value != int(value):
        raise Refusal(field.name, f"{value:g} is no whole number", _wanted(field))
    least = -MAX_NUMBER if field.least is None else field.least
    if not least <= value <= (MAX_NUMBER if field.most is None else field.most):
        raise Refusal(field.name, f"{value:g} is out of range", _wanted(field))
    return int(value) if field.kind == "whole" else float(value)


_WORDS = {"flag": "true or false", "table": "table", "list": "list", "choice": "choice"}


def _lengths(field: Field) -> tuple[int, int]:
    return 1 if field.least is None else int(field.least), MAX_TEXT if field.most is None else int(field.most)


def _wanted(field: Field) -> str:
    """What to give instead."""
    unit = f" {field.unit}" if field.unit else ""
    match field.kind:
        case "text":
            least, most = _lengths(field)
            return f"give a text of {least} to {most} characters"
        case "choice":
            return f"give one of {', '.join(field.choices)}"
        case "flag":
            return "give true or false"
        case "table":
            return 'give an object such as {"key": "value"}'
        case "list":
            return f"give a list of {field.least or 0:g} to {field.most or MAX_ENTRIES:g} entries"
    kind = "whole" if field.kind == "whole" else "finite"
    bounds = [f"at least {field.least:g}"] if field.least is not None else []
    bounds += [f"at most {field.most:g}"] if field.most is not None else []
    return f"give a {kind} number{unit}" + (f", {' and '.join(bounds)}" if bounds else "")
