"""Routes of the tasks: list, catalogue, assignment, and orders of the operator."""

from __future__ import annotations

from collections.abc import Callable
from hashlib import blake2s
from typing import Any

from twisted.internet.defer import maybeDeferred

from webnode.errors import Refusal
from webnode.route import API, Field, Route, RouteRequest
from webnode.sanitize import Json

TASK = Field("task_id", "text", "the task", "path", maximum=64)


def list_tasks(request: RouteRequest) -> Json:
    """Return all tasks."""
    listed: Json = request.state["tasks"]
    return listed


def list_predefined(request: RouteRequest) -> Json:
    """Return the predefined tasks."""
    return [dict(task) for task in request.services.control.list_predefined()]


def run_demo(request: RouteRequest) -> Any:
    """Run the demonstration."""
    return maybeDeferred(request.services.control.run_demo, _derive_task_id(request, "demo")).addCallback(_wrap_id)


def assign_task(request: RouteRequest) -> Any:
    """Assign a predefined task."""
    arguments = request.values["name"], request.values["tolerates"], request.values["group"]
    return maybeDeferred(request.services.control.assign, *arguments, _derive_task_id(request, "task")).addCallback(
        _wrap_id
    )


def _derive_task_id(request: RouteRequest, what: str) -> str:
    """Derive the id of the new task from the idempotency key; empty without a key.

    The id is the same at every web node.  A page whose node failed before its answer repeats the request at another
    node, which recognizes the repetition by the id of the task.
    """
    if not request.id:
        return ""
    request_key = "\n".join((what, request.user.token_id, request.id))
    return blake2s(request_key.encode(), digest_size=6).hexdigest()


def _wrap_id(answer: Any) -> Json:
    body: Json = answer if isinstance(answer, dict) else {"id": answer}
    return body


def preview_task(request: RouteRequest) -> Any:
    """Return which devices can take a predefined task."""
    return request.services.control.preview(request.values["name"], request.values["group"])


def _make_order_route(
    verb: str, description: str, choose_order: Callable[[RouteRequest], Callable[[str], Any]]
) -> Route:
    """Return the route of the order ``verb`` for an existing task."""

    def answer(request: RouteRequest) -> Json:
        task_id = request.values["task_id"]
        if task_id not in [task["id"] for task in request.state["tasks"]]:
            raise Refusal("task", "unknown task", f"choose one of {API}/tasks", 404)
        choose_order(request)(task_id)
        return {"id": task_id}

    path = f"{API}/tasks/{{task_id}}/{verb}"
    return Route("POST", path, description, "operator", answer, (TASK,), response="id", status=202)


NAME = Field("name", "text", "name in the catalogue", maximum=64)
GROUP = Field("group", "text", "tasks of one group are assigned jointly, one to each device", maximum=64, default="")
ROUTES = (
    Route("GET", f"{API}/tasks", "The tasks, the newest first", "viewer", list_tasks, response="a list of tasks"),
    Route(
        "GET",
        f"{API}/catalogue",
        "The predefined tasks",
        "viewer",
        list_predefined,
        response="a list of name, title, requirements",
    ),
    Route(
        "POST",
        f"{API}/demo",
        "Run Demo: cancel open tasks, remove the target, assign the demonstration's task, place the target 5 s later",
        "operator",
        run_demo,
        response="id",
        status=202,
    ),
    Route(
        "POST",
        f"{API}/tasks",
        "Assign a predefined task",
        "operator",
        assign_task,
        (
            NAME,
            Field(
                "tolerates",
                "whole",
                "members of its council that may fail at the same time",
                minimum=1,
                maximum=3,
                default=1,
            ),
            GROUP,
        ),
        response="id, able, refused (reasons by name)",
        status=202,
    ),
    Route(
        "POST",
        f"{API}/tasks/preview",
        "Which devices can take a predefined task, and why others cannot; assigns nothing",
        "viewer",
        preview_task,
        (NAME, GROUP),
        response="able (uuid, name, busy: its current task), refused (reasons by name), likely (a name, or null), "
        "together (id, title: tasks of the group that are assigned jointly with it)",
    ),
    _make_order_route(
        "cancel", "End a task; its lease is no longer granted", lambda request: request.services.control.cancel
    ),
    _make_order_route(
        "pause",
        "Pause a task; its devices stop and are free for other tasks",
        lambda request: request.services.control.pause,
    ),
    _make_order_route("resume", "Resume a paused task", lambda request: request.services.control.resume),
)
