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


def list_tasks(ask: RouteRequest) -> Json:
    """Return all tasks."""
    listed: Json = ask.state["tasks"]
    return listed


def list_predefined(ask: RouteRequest) -> Json:
    """Return the predefined tasks."""
    return [dict(task) for task in ask.services.control.list_predefined()]


def run_demo(ask: RouteRequest) -> Any:
    """Run the demonstration."""
    return maybeDeferred(ask.services.control.run_demo, _derive_task_id(ask, "demo")).addCallback(_wrap_id)


def assign_task(ask: RouteRequest) -> Any:
    """Assign a predefined task."""
    given = ask.values["name"], ask.values["tolerates"], ask.values["group"]
    return maybeDeferred(ask.services.control.assign, *given, _derive_task_id(ask, "task")).addCallback(_wrap_id)


def _derive_task_id(ask: RouteRequest, what: str) -> str:
    """Derive the id of the new task from the idempotency key; empty without a key.

    It is the same at every web node: a page whose node failed before answering repeats the request at another one,
    which recognizes it by the id of the task.
    """
    if not ask.id:
        return ""
    wish = "\n".join((what, ask.user.token_id, ask.id))
    return blake2s(wish.encode(), digest_size=6).hexdigest()


def _wrap_id(answer: Any) -> Json:
    told: Json = answer if isinstance(answer, dict) else {"id": answer}
    return told


def preview_task(ask: RouteRequest) -> Any:
    """Return which devices can take a predefined task."""
    return ask.services.control.preview(ask.values["name"], ask.values["group"])


def _make_order_route(word: str, about: str, wish: Callable[[RouteRequest], Callable[[str], Any]]) -> Route:
    """Return the route of the order ``word`` for an existing task."""

    def answer(ask: RouteRequest) -> Json:
        task_id = ask.values["task_id"]
        if task_id not in [task["id"] for task in ask.state["tasks"]]:
            raise Refusal("task", "unknown task", f"choose one of {API}/tasks", 404)
        wish(ask)(task_id)
        return {"id": task_id}

    path = f"{API}/tasks/{{task_id}}/{word}"
    return Route("POST", path, about, "operator", answer, (TASK,), response="id", status=202)


NAME = Field("name", "text", "name in the catalogue", maximum=64)
GROUP = Field("group", "text", "tasks of one group are divided among the devices together", maximum=64, default="")
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
                "members of its council that may fail at once",
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
        "together (id, title: tasks that the group divides with it)",
    ),
    _make_order_route("cancel", "End a task; its lease is no longer granted", lambda ask: ask.services.control.cancel),
    _make_order_route(
        "pause", "Pause a task; its devices stop and are free for other tasks", lambda ask: ask.services.control.pause
    ),
    _make_order_route("resume", "Resume a paused task", lambda ask: ask.services.control.resume),
)
