"""Resource: what the native resources have in common: whatever they refuse is JSON, as Flask's refusals are."""

from __future__ import annotations

import json

from twisted.web.http import Request
from twisted.web.resource import Resource

from webnode.errors import Refusal


class JsonResource(Resource):
    """A resource that answers GET; every other method, and every path below it, is refused in JSON."""

    methods: tuple[bytes, ...] = (b"GET",)
    """What it answers; a stream leaves HEAD out, as nobody would end it."""

    def getChild(self, path: bytes, request: Request) -> Resource:
        """There is nothing below."""
        return Refused(
            Refusal(path_of(request), "not found", "look at docs/reference/http-api.md for what can be asked", 404)
        )

    def render(self, request: Request) -> int | bytes:
        """Answer with one of ``methods``."""
        is_there = self.isLeaf or hasattr(self, "render_GET") or request.method not in (b"GET", b"HEAD")
        if not is_there or (self.isLeaf and getattr(request, "postpath", None)):
            refusal = Refusal(
                path_of(request), "not found", "look at docs/reference/http-api.md for what can be asked", 404
            )
            return answer(request, refusal)
        if request.method not in self.methods:
            request.setHeader("Allow", b", ".join(self.methods).decode())
            allowed = " or ".join(method.decode() for method in self.methods)
            return answer(request, Refusal(path_of(request), "method not allowed", f"use {allowed}", 405))
        told: int | bytes = super().render(request)
        return told


class Refused(Resource):
    """A resource that is refused, whatever is asked of it."""

    isLeaf = True

    def __init__(self, refusal: Refusal) -> None:
        super().__init__()
        self._refusal = refusal

    def render(self, request: Request) -> bytes:
        """Say why."""
        return answer(request, self._refusal)


def answer(request: Request, refusal: Refusal) -> bytes:
    """The body of a native resource's refusal, with its status and type set."""
    request.setResponseCode(refusal.status)
    request.setHeader("Content-Type", "application/json")
    request.setHeader("Cache-Control", "no-store")
    return json.dumps(refusal.fields).encode()


def argument(request: Request, name: bytes) -> bytes:
    """The first value of that name in the query, at most 40 bytes of it; empty where there is none."""
    values: list[bytes] = (request.args or {}).get(name, [b""])
    return values[0][:40]


def path_of(request: Request) -> str:
    """The path that was asked for, for people: without its query, which may hold a ticket, and not too long."""
    path: bytes = request.path or b""
    return path.decode("ascii", "replace")[:100]
