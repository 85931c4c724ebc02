"""The Flask side: the page and its JSON, over a state and a desk that are handed in.

Handlers run on worker threads.  They read a finished state and never wait for the network: a wish is handed to the
reactor's thread, answered with 202, and its outcome shows in the state.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from typing import Any

from flask import Flask, Response, jsonify, render_template, request
from werkzeug.exceptions import HTTPException

from webnode.desk import Desk
from webnode.errors import Refusal
from webnode.field import text
from webnode.guard import HEADERS, MAX_BODY, is_local_host, is_own_origin
from webnode.state import GONE, State

MAX_MESSAGE = 140
MAX_AWAY_S = 600.0
AWAY_S = 15.0
OnReactor = Callable[..., Any]


def _here(wish: Callable[..., Any], *arguments: Any) -> Any:
    return wish(*arguments)


def create_app(
    read: Callable[[], State], desk: Desk, on_reactor: OnReactor = _here, hosts: Collection[str] = ()
) -> Flask:
    """The application.

    ``read`` returns the newest state and may be called from any thread; ``on_reactor(f, *arguments)`` calls ``f``
    on the reactor's thread and returns what it returns (``server.caller`` makes one; the default calls at once, for
    tests); ``hosts`` are names of this machine beside its addresses and local names.
    """
    app = Flask("webnode", static_folder=None)
    app.config["MAX_CONTENT_LENGTH"] = MAX_BODY
    app.json.sort_keys = False  # type: ignore[attr-defined]

    _guard(app, hosts)
    _explain(app)
    _serve_page(app, read)
    _serve_tasks(app, read, desk, on_reactor)
    _serve_devices(app, read, desk, on_reactor)
    _serve_target(app, desk, on_reactor)
    return app


def _guard(app: Flask, hosts: Collection[str]) -> None:
    """Let in who comes by a name of this machine and from its own page, and send the headers that keep it so."""

    @app.before_request
    def admit() -> None:
        host = request.headers.get("Host", "")
        if not is_local_host(host, hosts):
            raise Refusal(
                "Host", "this name is not one of the node's", "use its address, or add the name to the settings", 403
            )
        if request.method in ("GET", "HEAD"):
            return
        if not is_own_origin(request.headers.get("Origin"), host):
            raise Refusal("Origin", "another site asked for this", "use the node's own page", 403)
        if request.headers.get("X-Swarm") != "1" and not request.is_json:
            raise Refusal("X-Swarm", "the header is missing", "send 'X-Swarm: 1' or JSON with its content type", 403)

    @app.after_request
    def strict(response: Response) -> Response:
        response.headers.update(HEADERS)
        response.headers.setdefault("Cache-Control", "no-store")
        return response


def _explain(app: Flask) -> None:
    """Answer whatever goes wrong with what, where, and what to do."""

    @app.errorhandler(Refusal)
    def refused(error: Refusal) -> tuple[Response, int]:
        return jsonify(error.fields), error.status

    @app.errorhandler(HTTPException)
    def unlawful(error: HTTPException) -> tuple[Response, int]:
        code = error.code or 500
        remedy = "send less" if code == 413 else "look at docs/web.md for what can be asked"
        return jsonify(Refusal(request.path, error.name.lower(), remedy).fields), code

    @app.errorhandler(Exception)
    def broken(error: Exception) -> tuple[Response, int]:
        app.logger.error("%s %s failed", request.method, request.path, exc_info=error)
        return jsonify(Refusal(request.path, "the web node failed", "try again; its log says why").fields), 500


def _serve_page(app: Flask, read: Callable[[], State]) -> None:
    @app.get("/")
    def page() -> Response:
        response = app.make_response(render_template("index.html", node=read()["node"]))
        response.headers["Cache-Control"] = "no-cache"
        response.add_etag()
        response.make_conditional(request)
        return response

    @app.get("/api/state")
    def state() -> Response:
        return jsonify(read())


def _serve_tasks(app: Flask, read: Callable[[], State], desk: Desk, on_reactor: OnReactor) -> None:
    @app.get("/api/tasks")
    def tasks() -> Response:
        return jsonify(read()["tasks"])

    @app.get("/api/catalogue")
    def catalogue() -> Response:
        return jsonify(list(on_reactor(desk.catalogue)))

    @app.post("/api/demo")
    def demo() -> tuple[Response, int]:
        return jsonify({"id": on_reactor(desk.run_demo)}), 202

    @app.post("/api/tasks")
    def assign() -> tuple[Response, int]:
        name, tolerates = _words("name", 64), _number("tolerates", 1.0)
        if tolerates not in (1.0, 2.0, 3.0):
            raise Refusal("tolerates", f"{tolerates:g} is out of range", "give 1, 2 or 3")
        answer = on_reactor(desk.assign, name, int(tolerates))
        return jsonify(answer if isinstance(answer, dict) else {"id": answer}), 202

    @app.post("/api/tasks/<task_id>/<any(cancel, pause, resume):wish>")
    def order(task_id: str, wish: str) -> tuple[Response, int]:
        if task_id not in [task["id"] for task in read()["tasks"]]:
            raise Refusal("task", "there is no such task", "choose one of /api/tasks", 404)
        on_reactor({"cancel": desk.cancel, "pause": desk.pause, "resume": desk.resume}[wish], task_id)
        return jsonify({"id": task_id}), 202


def _serve_devices(app: Flask, read: Callable[[], State], desk: Desk, on_reactor: OnReactor) -> None:
    @app.get("/api/devices")
    def devices() -> Response:
        return jsonify(read()["devices"])

    @app.post("/api/message")
    def announce() -> tuple[Response, int]:
        on_reactor(desk.message, "", _words("text", MAX_MESSAGE))
        return jsonify({}), 202

    @app.post("/api/devices/<uuid>/message")
    def message(uuid: str) -> tuple[Response, int]:
        _present(read(), uuid)
        on_reactor(desk.message, uuid, _words("text", MAX_MESSAGE))
        return jsonify({"id": uuid}), 202

    @app.post("/api/devices/<uuid>/disconnect")
    def disconnect(uuid: str) -> tuple[Response, int]:
        _present(read(), uuid)
        seconds = _number("seconds", AWAY_S)
        if not 0.0 < seconds <= MAX_AWAY_S:
            raise Refusal("seconds", f"{seconds:g} is out of range", f"give more than 0 and at most {MAX_AWAY_S:g}")
        on_reactor(desk.disconnect, uuid, seconds)
        return jsonify({"id": uuid, "seconds": seconds}), 202


def _serve_target(app: Flask, desk: Desk, on_reactor: OnReactor) -> None:
    @app.post("/api/target")
    def move_target() -> tuple[Response, int]:
        x, y = _number("x"), _number("y")
        _in_yard(on_reactor(desk.yard), x, y)
        on_reactor(desk.move_target, x, y)
        return jsonify({"x": x, "y": y}), 202

    @app.delete("/api/target")
    def clear_target() -> tuple[Response, int]:
        on_reactor(desk.clear_target)
        return jsonify({}), 202


def _body() -> dict[str, Any]:
    try:
        body = request.get_json(force=True) if request.get_data() else {}
    except RecursionError:
        body = None
    if not isinstance(body, dict):
        raise Refusal("body", "it is not a JSON object", 'send something like {"name": "value"}')
    return body


def _words(field: str, limit: int) -> str:
    value = _body().get(field)
    if not isinstance(value, str) or not text(value, limit=limit + 1):
        raise Refusal(field, "it is missing or empty", f"give a text of 1 to {limit} characters")
    if len(value) > limit:
        raise Refusal(field, f"it has {len(value)} characters", f"give at most {limit}")
    return text(value, limit=limit)


def _number(field: str, fallback: float | None = None) -> float:
    value = _body().get(field, fallback)
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e9 or not math.isfinite(value):
        raise Refusal(field, "it is missing or no number", "give a finite number")
    return float(value)


def _present(state: State, uuid: str) -> None:
    found = [device for device in state["devices"] if device["uuid"] == uuid]
    if not found:
        raise Refusal("device", "there is no such device", "choose one of /api/devices", 404)
    if found[0]["status"] == GONE:
        raise Refusal("device", f"{found[0]['name']} has left the network", "wait until it is back", 409)


def _in_yard(yard: Any, x: float, y: float) -> None:
    if yard is None:
        raise Refusal("target", "this node has no yard", "start one, or name it in the settings", 409)
    width, height = yard["walls"]
    if not (0.0 <= x <= width and 0.0 <= y <= height):
        raise Refusal("target", f"({x:g}, {y:g}) is outside the yard", f"give x in 0..{width:g} and y in 0..{height:g}")
