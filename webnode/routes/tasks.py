"""Routes of the tasks: what there is to do, what is done, and what an operator wants of it."""

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
    """All of them."""
    listed: Json = ask.state["tasks"]
    return listed


def catalogue(ask: Ask) -> Json:
    """Those that can be assigned."""
    return [dict(task) for task in ask.board.desk.catalogue()]


def demo(ask: Ask) -> Any:
    """Run the demonstration."""
    return maybeDeferred(ask.board.desk.run_demo, _id(ask, "demo")).addCallback(_named)


def assign(ask: Ask) -> Any:
    """Assign one; the answer may be its id alone."""
    given = ask.given["name"], ask.given["tolerates"], ask.given["group"]
    return maybeDeferred(ask.board.desk.assign, *given, _id(ask, "task")).addCallback(_named)


def _id(ask: Ask, what: str) -> str:
    """The id of the task that this wish makes; any where its visitor gave it no name.

    It is the same at every web node: a page whose node died before it answered asks the next one, and only the task's
    own name tells that one whether the wish is new.
    """
    if not ask.id:
        return ""
    wish = "\n".join((what, ask.who.token_id, ask.id))
    return blake2s(wish.encode(), digest_size=6).hexdigest()


def _named(answer: Any) -> Json:
    told: Json = answer if isinstance(answer, dict) else {"id": answer}
    return told


def preview(ask: Ask) -> Any:
    """Who could take one."""
    return ask.board.desk.preview(ask.given["name"], ask.given["group"])


def _order(word: str, about: str, wish: Callable[[Ask], Callable[[str], Any]]) -> Route:
    """The route that orders ``word`` of a task that is there."""

    def answer(ask: Ask) -> Json:
        task_id = ask.given["task_id"]
        if task_id not in [task["id"] for task in ask.state["tasks"]]:
            raise Refusal("task", "there is no such task", f"choose one of {API}/tasks", 404)
        wish(ask)(task_id)
        return {"id": task_id}

    path = f"{API}/tasks/{{task_id}}/{word}"
    return Route("POST", path, about, "operator", answer, (TASK,), gives="id", status=202)


NAME = Field("name", "text", "its name in the catalogue", most=64)
GROUP = Field("group", "text", "tasks of one group are divided together", most=64, default="")
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
        "Run Demo: cancels open tasks, takes the target away, assigns the demonstration's task, places it 5 s later",
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
                "members of its council that may be lost at once",
                least=1,
                most=3,
                default=1,
            ),
            GROUP,
        ),
        gives="id, able, refused (why, by name)",
        status=202,
    ),
    Route(
        "POST",
        f"{API}/tasks/preview",
        "Who could take a predefined task and who not, and why; nothing is assigned",
        "viewer",
        preview,
        (NAME, GROUP),
        gives="able (uuid, name, busy: its task now), refused (why, by name), likely (a name, or null), "
        "together (id, title: what the group divides it with)",
    ),
    _order("cancel", "End a task; nobody is granted it any more", lambda ask: ask.board.desk.cancel),
    _order("pause", "Let a task rest; its devices stop and are free for others", lambda ask: ask.board.desk.pause),
    _order("resume", "Let a task go on from where it was", lambda ask: ask.board.desk.resume),
)
