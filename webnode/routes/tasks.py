"""Routes of the tasks: list, catalogue, assignment, and orders of the operator."""

from __future__ import annotations

from collections.abc import Callable
from hashlib import blake2s
from typing import Any

from twisted.internet.defer import maybeDeferred

from webnode.errors import Refusal
from webnode.field import Json
from webnode.route import API, Ask, Field, Route

TASK = Field("task_id", "text", "the task", "path", most=64)


def tasks(ask: Ask) -> Json:
    """Return all tasks."""
    listed: Json = ask.state["tasks"]
    return listed


def catalogue(ask: Ask) -> Json:
    """Return the predefined tasks."""
    return [dict(task) for task in ask.board.desk.catalogue()]


def demo(ask: Ask) -> Any:
    """Run the demonstration."""
    return maybeDeferred(ask.board.desk.run_demo, _id(ask, "demo")).addCallback(_named)


def assign(ask: Ask) -> Any:
    """Assign a predefined task."""
    given = ask.given["name"], ask.given["tolerates"], ask.given["group"]
    return maybeDeferred(ask.board.desk.assign, *given, _id(ask, "task")).addCallback(_named)


def _id(ask: Ask, what: str) -> str:
    """Derive the id of the new task from the idempotency key; empty without a key.

    It is the same at every web node: a page whose node failed before answering repeats the request at another one,
    which recognizes it by the id of the task.
    """
    if not ask.id:
        return ""
    wish = "\n".join((what, ask.who.token_id, ask.id))
    return blake2s(wish.encode(), digest_size=6).hexdigest()


def _named(answer: Any) -> Json:
    told: Json = answer if isinstance(answer, dict) else {"id": answer}
    return told


def preview(ask: Ask) -> Any:
    """Return which devices can take a predefined task."""
    return ask.board.desk.preview(ask.given["name"], ask.given["group"])


def _order(word: str, about: str, wish: Callable[[Ask], Callable[[str], Any]]) -> Route:
    """Return the route of the order ``word`` for an existing task."""

    def answer(ask: Ask) -> Json:
        task_id = ask.given["task_id"]
        if task_id not in [task["id"] for task in ask.state["tasks"]]:
            raise Refusal("task", "unknown task", f"choose one of {API}/tasks", 404)
        wish(ask)(task_id)
        return {"id": task_id}

    path = f"{API}/tasks/{{task_id}}/{word}"
    return Route("POST", path, about, "operator", answer, (TASK,), gives="id", status=202)


NAME = Field("name", "text", "name in the catalogue", most=64)
GROUP = Field("group", "text", "tasks of one group are divided among the devices together", most=64, default="")
ROUTES = (
    Route("GET", f"{API}/tasks", "The tasks, the newest first", "viewer", tasks, gives="a list of tasks"),
    Route(
        "GET",
        f"{API}/catalogue",
        "The predefined tasks",
        "viewer",
        catalogue,
        gives="a list of name, title, requirements",
    ),
    Route(
        "POST",
        f"{API}/demo",
        "Run Demo: cancel open tasks, remove the target, assign the demonstration's task, place the target 5 s later",
        "operator",
        demo,
        gives="id",
        status=202,
    ),
    Route(
        "POST",
        f"{API}/tasks",
        "Assign a predefined task",
        "operator",
        assign,
        (
            NAME,
            Field(
                "tolerates",
                "whole",
                "members of its council that may fail at once",
                least=1,
                most=3,
                default=1,
            ),
            GROUP,
        ),
        gives="id, able, refused (reasons by name)",
        status=202,
    ),
    Route(
        "POST",
        f"{API}/tasks/preview",
        "Which devices can take a predefined task, and why others cannot; assigns nothing",
        "viewer",
        preview,
        (NAME, GROUP),
        gives="able (uuid, name, busy: its current task), refused (reasons by name), likely (a name, or null), "
        "together (id, title: tasks that the group divides with it)",
    ),
    _order("cancel", "End a task; its lease is no longer granted", lambda ask: ask.board.desk.cancel),
    _order("pause", "Pause a task; its devices stop and are free for other tasks", lambda ask: ask.board.desk.pause),
    _order("resume", "Resume a paused task", lambda ask: ask.board.desk.resume),
)
