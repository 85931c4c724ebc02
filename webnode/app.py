"""Serve the page and every route of the table with Flask.

Handlers run on worker threads.  They read a finished state and check the request.  The route's answer runs on the
reactor's thread; the worker thread waits at most for its time limit.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from functools import partial
from typing import Any

from flask import Flask, Response, g, jsonify, render_template, request
from twisted.internet.defer import Deferred
from twisted.python.failure import Failure
from werkzeug.exceptions import HTTPException

from webnode.dispatch import Dispatch
from webnode.errors import Refusal
from webnode.request_guard import (
    HEADERS,
    MAX_BODY,
    IsAllowedOrigin,
    choose_token,
    find_refusal,
    is_own_origin,
    make_headers,
)
from webnode.route import API, Content, Route, RouteRequest, check_request, check_role
from webnode.routes.registry import TABLE
from webnode.services import Services
from webnode.state import State

MAX_ID = 64
OnReactor = Callable[..., Any]


def _call_directly(call: Callable[..., Any], *arguments: Any, limit_s: float | None = None) -> Any:
    result = call(*arguments)
    if not isinstance(result, Deferred):
        return result
    outcomes: list[Any] = []
    result.addBoth(outcomes.append)
    if not outcomes:
        raise Refusal("node", "the node did not answer in time", "check the state, then try again", 503)
    if isinstance(outcomes[0], Failure):
        outcomes[0].raiseException()
    return outcomes[0]


def create_app(
    read: Callable[[], State],
    services: Services,
    on_reactor: OnReactor = _call_directly,
    hosts: Collection[str] = (),
    wall: Callable[[], float] = lambda: 0.0,
) -> Flask:
    """Return the Flask application.

    ``read`` returns the newest state and may be called from any thread.  ``on_reactor(f, *arguments)`` calls ``f`` on
    the reactor's thread and returns its result (``server.make_caller`` makes one; the default calls directly, for
    tests).  ``hosts`` are names of this machine in addition to its addresses and local names.  ``wall`` returns unix
    time.
    """
    app = Flask("webnode", static_folder=None)
    app.config["MAX_CONTENT_LENGTH"] = MAX_BODY
    app.json.sort_keys = False  # type: ignore[attr-defined]

    # navigator.sendBeacon, which a phone uses when its page is closed, cannot set headers.
    without_csrf_header = {(str(route.method), _to_flask_rule(route.path)) for route in TABLE if route.role == "phone"}
    is_allowed_origin = partial(on_reactor, services.fallbacks.is_allowed_origin)
    _add_checks(
        app, is_allowed_origin, hosts, lambda: (request.method, str(request.url_rule)) not in without_csrf_header
    )
    _add_error_handlers(app)
    _serve_page(app, read)
    dispatch = Dispatch()

    def serve(route: Route) -> None:
        def answer(**path: str) -> Response:
            now = wall()
            user = on_reactor(services.sessions.authenticate, _read_token(), now)
            check_role(route.role, user)
            values = check_request(route, path, request.args, {} if route.method == "GET" else _read_body())
            route_request = RouteRequest(
                values, user, services, read(), _read_idempotency_key(), request.remote_addr or "", now, TABLE
            )
            result = on_reactor(dispatch.carry_out, route, route_request, limit_s=route.limit_s)
            is_content = isinstance(result, Content)
            response = app.response_class(result.body, content_type=result.kind) if is_content else jsonify(result)
            response.status_code = route.status
            return response

        app.add_url_rule(_to_flask_rule(route.path), route.name, answer, methods=[route.method])

    for route in TABLE:
        if route.handler is not None:
            serve(route)
    return app


def _add_checks(
    app: Flask, is_allowed_origin: IsAllowedOrigin, hosts: Collection[str], needs_csrf_header: Callable[[], bool]
) -> None:
    """Check ``Host`` and ``Origin`` of each request, and set the security headers of each response."""

    @app.before_request
    def check_headers() -> Response | None:
        has_csrf_header = not needs_csrf_header() or request.headers.get("X-Swarm") == "1" or request.is_json
        host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
        is_allowed = not is_own_origin(origin, host) and is_allowed_origin(origin or "")
        g.headers = make_headers(host, origin, lambda _: is_allowed)
        problem = find_refusal(request.method, host, origin, has_csrf_header, hosts, lambda _: is_allowed)
        if problem is not None:
            raise problem
        # OPTIONS is the preflight request (CORS) for a page of another web node.
        return app.response_class(status=204) if request.method == "OPTIONS" else None

    @app.after_request
    def add_headers(response: Response) -> Response:
        response.headers.update(g.get("headers", HEADERS))
        response.headers.setdefault("Cache-Control", "no-store")
        return response


def _add_error_handlers(app: Flask) -> None:
    """Answer every error as JSON with field, problem and remedy."""

    @app.errorhandler(Refusal)
    def answer_refusal(error: Refusal) -> tuple[Response, int]:
        return jsonify(error.fields), error.status

    @app.errorhandler(HTTPException)
    def answer_http_error(error: HTTPException) -> tuple[Response, int]:
        code = error.code or 500
        remedy = "send a smaller body" if code == 413 else "see docs/reference/http-api.md for the routes and methods"
        response = jsonify(Refusal(request.path, error.name.lower(), remedy).fields)
        allowed = getattr(error, "valid_methods", None)
        if allowed:
            response.headers["Allow"] = ", ".join(sorted(allowed))
        return response, code

    @app.errorhandler(Exception)
    def answer_exception(error: Exception) -> tuple[Response, int]:
        app.logger.error("%s %s failed", request.method, request.path, exc_info=error)
        return jsonify(Refusal(request.path, "internal error", "try again; the node's log has the cause").fields), 500


def _serve_page(app: Flask, read: Callable[[], State]) -> None:
    @app.get("/")
    def page() -> Response:
        response = app.make_response(render_template("index.html", node=read()["node"], api=API))
        response.headers["Cache-Control"] = "no-cache"
        response.add_etag()
        response.make_conditional(request)
        return response


def _to_flask_rule(path: str) -> str:
    return re.sub(r"\{(\w+)\}", r"<\1>", path)


def _read_token() -> str:
    return choose_token(request.headers.get("Authorization", ""), request.args.get("ticket", ""))


def _read_idempotency_key() -> str:
    value = request.headers.get("Idempotency-Key", "")
    if len(value) > MAX_ID or not value.isprintable():
        raise Refusal("Idempotency-Key", "invalid value", f"send at most {MAX_ID} printable characters")
    return value


def _read_body() -> object:
    try:
        return request.get_json(force=True) if request.get_data() else {}
    except RecursionError:
        return None
