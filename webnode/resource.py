"""Answer errors of native resources as JSON, as Flask's routes do."""

from __future__ import annotations

import json

from twisted.web.http import Request
from twisted.web.resource import Resource

from webnode.errors import Refusal


class JsonResource(Resource):
    """A resource that answers ``methods``; other methods and unknown paths below it are refused as JSON."""

    methods: tuple[bytes, ...] = (b"GET",)
    """The supported methods; streams do not support HEAD, because the request would not end."""

    def getChild(self, path: bytes, request: Request) -> Resource:
        """Reject a path below this resource."""
        return RefusedResource(
            Refusal(get_path(request), "not found", "see docs/reference/http-api.md for the routes", 404)
        )

    def render(self, request: Request) -> int | bytes:
        """Answer a request with one of ``methods``."""
        is_there = self.isLeaf or hasattr(self, "render_GET") or request.method not in (b"GET", b"HEAD")
        if not is_there or (self.isLeaf and getattr(request, "postpath", None)):
            refusal = Refusal(get_path(request), "not found", "see docs/reference/http-api.md for the routes", 404)
            return write_refusal(request, refusal)
        if request.method not in self.methods:
            request.setHeader("Allow", b", ".join(self.methods).decode())
            allowed = " or ".join(method.decode() for method in self.methods)
            return write_refusal(request, Refusal(get_path(request), "method not allowed", f"use {allowed}", 405))
        body: int | bytes = super().render(request)
        return body


class RefusedResource(Resource):
    """A resource that answers every request with the same refusal."""

    isLeaf = True

    def __init__(self, refusal: Refusal) -> None:
        super().__init__()
        self._refusal = refusal

    def render(self, request: Request) -> bytes:
        """Send the refusal."""
        return write_refusal(request, self._refusal)


def write_refusal(request: Request, refusal: Refusal) -> bytes:
    """Set status and type of a refusal, and return its JSON body."""
    request.setResponseCode(refusal.status)
    request.setHeader("Content-Type", "application/json")
    request.setHeader("Cache-Control", "no-store")
    return json.dumps(refusal.fields).encode()


def read_argument(request: Request, name: bytes) -> bytes:
    """Return the first value of a query parameter, cut to 40 bytes; empty if it is missing."""
    values: list[bytes] = (request.args or {}).get(name, [b""])
    return values[0][:40]


def get_path(request: Request) -> str:
    """Return the requested path for messages: cut, and without its query, which may contain a ticket."""
    path: bytes = request.path or b""
    return path.decode("ascii", "replace")[:100]
