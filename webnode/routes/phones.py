"""Routes of phones that take part as devices: joining, pictures, leaving.

A phone sends ten pictures a second; they bypass the worker threads.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from twisted.internet.defer import Deferred
from twisted.web.http import Request

from webnode.board import Board, Phones
from webnode.errors import Refusal
from webnode.field import Json
from webnode.resource import JsonResource, answer
from webnode.route import API, Ask, Field, Route
from webnode.visitor import Visitor

SECRET = 32
"""Length of a phone's secret in bytes; sent as twice as many hexadecimal digits."""
TICKET_S = 12 * 3600.0
BOUND = "phone/"
"""Prefix of the name in a phone's ticket, before the phone's uuid; the ticket is valid for that phone only."""
MAX_VALUES = 1000
MOST_SIDE = 640
"""Maximum side of a picture in pixels: a small file can declare huge dimensions, and viewers would decode it."""
FPS = 10.0


@dataclass(frozen=True)
class Measure:
    """The range of a value that a phone measures."""

    least: float
    most: float
    unit: str


MEASURES: Mapping[str, Measure] = {
    "target.bearing": Measure(-math.pi, math.pi, "rad"),
    "target.distance": Measure(0.0, 100.0, "m"),
    "orientation.yaw": Measure(0.0, math.tau, "rad"),
    "orientation.pitch": Measure(-math.pi, math.pi, "rad"),
    "orientation.roll": Measure(-math.pi, math.pi, "rad"),
    "position.lat": Measure(-90.0, 90.0, "deg"),
    "position.lon": Measure(-180.0, 180.0, "deg"),
    "position.accuracy": Measure(0.0, 1e6, "m"),
}
TOGETHER = (("target.bearing", "target.distance"), ("position.lat", "position.lon"))
"""Pairs of values of which both or none have to be present."""


def join(ask: Ask) -> Deferred[Json]:
    """Register a phone as a device."""
    if ask.board.phones is None:
        raise Refusal("phone", "this node does not accept phones", "use another web node", 409)
    if ask.who.name.startswith(BOUND):
        raise Refusal("ticket", "it is valid for one phone's pictures only", "sign in and use that token", 403)
    given = ask.given
    secret, name = given["secret"], given["name"]
    if not re.fullmatch(rf"[0-9a-fA-F]{{{2 * SECRET}}}", secret):
        raise Refusal("secret", "invalid secret", f"send {2 * SECRET} hexadecimal digits, always the same")
    if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
        raise Refusal("name", "invalid device name", "send 1 to 40 letters, digits, _ or -")
    can = {key: given[key] for key in ("width", "height", "orientation", "position")}

    def joined(uuid: str) -> Json:
        token = ask.board.sessions.derived(ask.who, f"{BOUND}{uuid}", "phone", ask.now, TICKET_S)
        return {"uuid": uuid, "ticket": token.ticket, "until": token.until, "fps": FPS}

    return ask.board.phones.join(bytes.fromhex(secret), name, can).addCallback(joined)


def values_of(text: str) -> dict[str, float]:
    """Parse the values measured with a picture; raises ``Refusal``."""
    try:
        found = json.loads(text or "{}") if len(text) <= MAX_VALUES else None
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise Refusal("values", "not a JSON object", 'send for example {"target.bearing": 0.1}')
    for name, value in found.items():
        measure = MEASURES.get(name)
        if measure is None:
            raise Refusal("values", f"unknown value {name[:40]!r}", f"send some of {', '.join(MEASURES)}")
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not measure.least <= value <= measure.most:
            bounds = f"{measure.least:.4g} to {measure.most:.4g} {measure.unit}"
            raise Refusal("values", f"{name} is out of range", f"send a number from {bounds}")
    for pair in TOGETHER:
        if len([name for name in pair if name in found]) == 1:
            raise Refusal("values", f"{' and '.join(pair)} belong together", "send both, or neither")
    return {name: float(value) for name, value in found.items()}


class OfPhone(JsonResource):
    """Native resource for a phone's requests, authorized by its ticket or by an operator."""

    isLeaf = True
    methods = (b"POST",)

    def __init__(self, board: Board, take: Callable[[Board, Phones, str, Request], Json]) -> None:
        super().__init__()
        self._board = board
        self._handle = take

    def render_POST(self, request: Request) -> bytes:
        """Process the request, or refuse it."""
        uuid = request.prepath[-2].decode("ascii", "replace")  # type: ignore[attr-defined]
        who = who_asks(request)
        try:
            if self._board.phones is None:
                raise Refusal("phone", "this node does not accept phones", "use another web node", 409)
            if who.role == "phone" and who.name != f"{BOUND}{uuid}":
                raise Refusal("ticket", "it belongs to another phone", f"join by POST {API}/phones", 403)
            reply = self._handle(self._board, self._board.phones, uuid, request)
        except Refusal as refusal:
            return answer(request, refusal)
        request.setHeader("Content-Type", "application/json")
        request.setHeader("Cache-Control", "no-store")
        return json.dumps(reply).encode()


def who_asks(request: Request) -> Visitor:
    """Return the visitor of a native request."""
    return getattr(request, "who", Visitor())


def look(board: Board, phones: Phones, uuid: str, request: Request) -> Json:
    """Take one picture and its measured values."""
    given: bytes = (request.args or {}).get(b"values", [b""])[0]
    values = values_of(given.decode("utf-8", "replace"))
    wanted = phones.look(uuid, request.content.read() if request.content is not None else b"", values)
    return {"fps": wanted.fps, "say": wanted.say}


def leave(board: Board, phones: Phones, uuid: str, request: Request) -> Json:
    """Remove the phone; sent by a page that is closed or hidden."""
    phones.leave(uuid)
    source = str(getattr(request.getClientAddress(), "host", ""))
    board.audit.note(who_asks(request), source, f"POST {API}/phones/{{uuid}}/leave", uuid[:64], "200")
    return {}


UUID = Field("uuid", "text", "the phone", "path", most=64)
ROUTES = (
    Route(
        "POST",
        f"{API}/phones",
        "Register a phone as a device, which this node connects to the team; can be repeated",
        "phone",
        join,
        (
            Field(
                "secret", "text", "the phone's secret in hexadecimal digits; it identifies the device", most=2 * SECRET
            ),
            Field("name", "text", "display name: letters, digits, _ or -", most=40),
            Field("width", "whole", "of its pictures", least=16, most=MOST_SIDE, unit="pixels"),
            Field("height", "whole", "of its pictures", least=16, most=MOST_SIDE, unit="pixels"),
            Field("orientation", "flag", "whether it measures its orientation", default=False),
            Field("position", "flag", "whether it measures its position", default=False),
        ),
        gives="uuid, ticket (for its pictures only, in the query), until (unix seconds), fps",
        limit_s=4.5,
    ),
    Route(
        "POST",
        f"{API}/phones/{{uuid}}/look",
        "A picture of the phone, and the values measured with it",
        "phone",
        None,
        (
            UUID,
            Field(
                "values",
                "text",
                "measured values as a JSON object: "
                + ", ".join(f"{name} ({measure.unit})" for name, measure in MEASURES.items()),
                "query",
                least=0,
                most=MAX_VALUES,
                default="",
            ),
        ),
        gives="fps (requested pictures per second), say (text to show on the phone)",
        native=lambda board, reactor: OfPhone(board, look),
        takes="image/jpeg",
    ),
    Route(
        "POST",
        f"{API}/phones/{{uuid}}/leave",
        "Remove the phone from the team",
        "phone",
        None,
        (UUID,),
        native=lambda board, reactor: OfPhone(board, leave),
    ),
)
