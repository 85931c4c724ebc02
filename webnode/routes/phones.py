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

from webnode.auth import User
from webnode.errors import Refusal
from webnode.resource import JsonResource, write_refusal
from webnode.route import API, Field, Route, RouteRequest
from webnode.sanitize import Json
from webnode.services import Phones, Services

SECRET_BYTES = 32
"""Length of a phone's secret in bytes; sent as twice as many hexadecimal digits."""
TICKET_S = 12 * 3600.0
PHONE_PREFIX = "phone/"
"""Prefix of the name in a phone's ticket, before the phone's uuid; the ticket is valid for that phone only."""
MAX_VALUES_CHARS = 1000
MAX_SIDE_PIXELS = 640
"""Maximum side of a picture in pixels: a small file can declare huge dimensions, and viewers would decode it."""
REQUESTED_FPS = 10.0


@dataclass(frozen=True)
class ValueRange:
    """The range of a value that a phone measures."""

    minimum: float
    maximum: float
    unit: str


VALUE_RANGES: Mapping[str, ValueRange] = {
    "target.bearing": ValueRange(-math.pi, math.pi, "rad"),
    "target.distance": ValueRange(0.0, 100.0, "m"),
    "orientation.yaw": ValueRange(0.0, math.tau, "rad"),
    "orientation.pitch": ValueRange(-math.pi, math.pi, "rad"),
    "orientation.roll": ValueRange(-math.pi, math.pi, "rad"),
    "position.lat": ValueRange(-90.0, 90.0, "deg"),
    "position.lon": ValueRange(-180.0, 180.0, "deg"),
    "position.accuracy": ValueRange(0.0, 1e6, "m"),
}
PAIRED_VALUES = (("target.bearing", "target.distance"), ("position.lat", "position.lon"))
"""Pairs of values; a picture must have both values of a pair, or neither."""


def register_phone(request: RouteRequest) -> Deferred[Json]:
    """Register a phone as a device."""
    if request.services.phones is None:
        raise Refusal("phone", "this node does not accept phones", "use another web node of the team", 409)
    if request.user.name.startswith(PHONE_PREFIX):
        raise Refusal(
            "ticket", "the ticket is valid for the pictures of one phone only", "sign in and use that token", 403
        )
    values = request.values
    secret, name = values["secret"], values["name"]
    if not re.fullmatch(rf"[0-9a-fA-F]{{{2 * SECRET_BYTES}}}", secret):
        raise Refusal("secret", "invalid secret", f"send {2 * SECRET_BYTES} hexadecimal digits, always the same")
    if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
        raise Refusal("name", "invalid device name", "send 1 to 40 letters, digits, _ or -")
    can = {key: values[key] for key in ("width", "height", "orientation", "position")}

    def joined(uuid: str) -> Json:
        token = request.services.sessions.issue_derived_token(
            request.user, f"{PHONE_PREFIX}{uuid}", "phone", request.now, TICKET_S
        )
        return {"uuid": uuid, "ticket": token.ticket, "until": token.until, "fps": REQUESTED_FPS}

    return request.services.phones.join(bytes.fromhex(secret), name, can).addCallback(joined)


def parse_values(text: str) -> dict[str, float]:
    """Parse the values measured with a picture; raises ``Refusal``."""
    try:
        found = json.loads(text or "{}") if len(text) <= MAX_VALUES_CHARS else None
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise Refusal("values", "the values are not a JSON object", 'send for example {"target.bearing": 0.1}')
    for name, value in found.items():
        value_range = VALUE_RANGES.get(name)
        if value_range is None:
            raise Refusal("values", f"unknown value {name[:40]!r}", f"send some of {', '.join(VALUE_RANGES)}")
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not value_range.minimum <= value <= value_range.maximum:
            bounds = f"{value_range.minimum:.4g} to {value_range.maximum:.4g} {value_range.unit}"
            raise Refusal("values", f"{name} is out of range", f"send a number from {bounds}")
    for pair in PAIRED_VALUES:
        if len([name for name in pair if name in found]) == 1:
            raise Refusal("values", f"{' and '.join(pair)} belong together", "send both, or neither")
    return {name: float(value) for name, value in found.items()}


class PhoneResource(JsonResource):
    """Native resource for a phone's requests, authorized by its ticket or by an operator."""

    isLeaf = True
    methods = (b"POST",)

    def __init__(self, services: Services, handle: Callable[[Services, Phones, str, Request], Json]) -> None:
        super().__init__()
        self._services = services
        self._handle = handle

    def render_POST(self, request: Request) -> bytes:
        """Process the request, or refuse it."""
        uuid = request.prepath[-2].decode("ascii", "replace")  # type: ignore[attr-defined]
        user = get_user(request)
        try:
            if self._services.phones is None:
                raise Refusal("phone", "this node does not accept phones", "use another web node of the team", 409)
            if user.role == "phone" and user.name != f"{PHONE_PREFIX}{uuid}":
                raise Refusal("ticket", "the ticket belongs to another phone", f"join with POST {API}/phones", 403)
            reply = self._handle(self._services, self._services.phones, uuid, request)
        except Refusal as refusal:
            return write_refusal(request, refusal)
        request.setHeader("Content-Type", "application/json")
        request.setHeader("Cache-Control", "no-store")
        return json.dumps(reply).encode()


def get_user(request: Request) -> User:
    """Return the authenticated user of a native request."""
    return getattr(request, "authenticated_user", User())


def receive_picture(services: Services, phones: Phones, uuid: str, request: Request) -> Json:
    """Take one picture and its measured values."""
    encoded: bytes = (request.args or {}).get(b"values", [b""])[0]
    values = parse_values(encoded.decode("utf-8", "replace"))
    reply = phones.receive_picture(uuid, request.content.read() if request.content is not None else b"", values)
    return {"fps": reply.fps, "say": reply.say}


def remove_phone(services: Services, phones: Phones, uuid: str, request: Request) -> Json:
    """Remove the phone; a page sends this request when it is closed or hidden."""
    phones.leave(uuid)
    source = str(getattr(request.getClientAddress(), "host", ""))
    services.audit.write(get_user(request), source, f"POST {API}/phones/{{uuid}}/leave", uuid[:64], "200")
    return {}


UUID = Field("uuid", "text", "the phone", "path", maximum=64)
ROUTES = (
    Route(
        "POST",
        f"{API}/phones",
        "Register a phone as a device, which this node connects to the team; can be repeated",
        "phone",
        register_phone,
        (
            Field(
                "secret",
                "text",
                "the phone's secret in hexadecimal digits; it identifies the device",
                maximum=2 * SECRET_BYTES,
            ),
            Field("name", "text", "display name: letters, digits, _ or -", maximum=40),
            Field("width", "whole", "of its pictures", minimum=16, maximum=MAX_SIDE_PIXELS, unit="pixels"),
            Field("height", "whole", "of its pictures", minimum=16, maximum=MAX_SIDE_PIXELS, unit="pixels"),
            Field("orientation", "flag", "whether it measures its orientation", default=False),
            Field("position", "flag", "whether it measures its position", default=False),
        ),
        response="uuid, ticket (for its pictures only, in the query), until (unix seconds), fps",
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
                + ", ".join(f"{name} ({value_range.unit})" for name, value_range in VALUE_RANGES.items()),
                "query",
                minimum=0,
                maximum=MAX_VALUES_CHARS,
                default="",
            ),
        ),
        response="fps (requested pictures per second), say (text to show on the phone)",
        native=lambda services, reactor: PhoneResource(services, receive_picture),
        body_type="image/jpeg",
    ),
    Route(
        "POST",
        f"{API}/phones/{{uuid}}/leave",
        "Remove the phone from the team",
        "phone",
        None,
        (UUID,),
        native=lambda services, reactor: PhoneResource(services, remove_phone),
    ),
)
