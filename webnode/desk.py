"""The desk: what an operator can ask the team for.

The front door implements it over the node; ``MemoryDesk`` is the twin in memory, for a page without a team.  Every
method is called on the reactor's thread and returns at once (or returns a Deferred that fires soon); what cannot be
is a ``Refusal``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from webnode.errors import Refusal


class Desk(Protocol):
    """An operator's wishes; the outcome is seen in the state, not in the answer."""

    def run_demo(self, task_id: str = "") -> Any:
        """Assign the demonstration's task; returns its id."""

    def assign(self, name: str, tolerates: int = 1, group: str = "", task_id: str = "") -> Any:
        """Assign a predefined task; ``tolerates`` members of its council may be lost at once.

        Tasks of one ``group`` are divided together.  ``task_id`` is what its id is to be, else any: one id is one task,
        wherever in the team it is asked for again.

        Returns its id, or ``{"id", "able": [names], "refused": {name: [reasons]}}``.
        """

    def catalogue(self) -> Sequence[Mapping[str, Any]]:
        """The predefined tasks: ``{"name", "title", "requirements"}`` each."""

    def preview(self, name: str, group: str = "") -> Any:
        """Who could take a predefined task, of whom nothing is asked.

        ``{"able": [{"uuid", "name", "busy"}], "refused": {name: [reasons]}, "likely": name | None, "together": [{"id",
        "title"}]}``; ``busy`` is the task that a device has now, ``likely`` who would take it by what is known already,
        ``together`` the open tasks that it would be divided together with, as one of ``group``.
        """

    def cancel(self, task_id: str) -> Any:
        """End a task; its devices stop."""

    def pause(self, task_id: str) -> Any:
        """Let a task rest; its devices stop, and are free for others."""

    def resume(self, task_id: str) -> Any:
        """Let a task that rests go on, from where it was."""

    def message(self, uuid: str, text: str) -> Any:
        """Send ``text`` to one device, or to all where ``uuid`` is empty.

        ``{"delivered": [names], "failed": {name: why}}``; for one device a failure is a ``Refusal``.
        """

    def disconnect(self, uuid: str, seconds: float) -> Any:
        """Let a device leave the network and come back after ``seconds``; done when it says that it will."""

    def move_target(self, x: float, y: float) -> Any:
        """Put the target at (x, y), metres in the yard's frame."""

    def clear_target(self) -> Any:
        """Take the target away."""

    def move_robot(self, name: str, x: float, y: float, heading: float) -> Any:
        """Lift a robot of the yard and set it down at (x, y), looking along ``heading`` (radians)."""

    def yard(self) -> Mapping[str, Any] | None:
        """The newest overhead snapshot, or None where there is no yard.

        ``{"walls": [w, h], "dogs": [{"name", "x", "y", "heading", "stripes"}], "target": {"x", "y", "radius"} |
        None}``; metres and radians, origin in the lower left corner.
        """


class MemoryDesk:
    """A desk that writes down what it is asked, in ``asked``, and keeps the target of its own small yard."""

    def __init__(self, catalogue: Sequence[Mapping[str, Any]] = (), yard: Mapping[str, Any] | None = None) -> None:
        self.asked: list[tuple[Any, ...]] = []
        self.tasks = list(catalogue)
        self.previews: dict[str, dict[str, Any]] = {}
        self.together: dict[str, list[dict[str, Any]]] = {}
        self.ground: dict[str, Any] | None = dict(yard) if yard is not None else None

    def run_demo(self, task_id: str = "") -> str:
        """Return ``demo-N``, or the id that it is to have."""
        noted = self._noted("demo")
        return task_id or noted

    def assign(self, name: str, tolerates: int = 1, group: str = "", task_id: str = "") -> dict[str, Any]:
        """Return ``assign-N``, or the id that it is to have; nobody is able, nobody is refused."""
        if name not in [task["name"] for task in self.tasks]:
            raise Refusal("name", f"there is no task {name!r}", "choose one of /api/v1/catalogue", 404)
        noted = self._noted("assign", name)
        return {"id": task_id or noted, "able": [], "refused": {}}

    def preview(self, name: str, group: str = "") -> dict[str, Any]:
        """Return what is in ``previews``, else that nobody is able and nobody refused."""
        if name not in [task["name"] for task in self.tasks]:
            raise Refusal("name", f"there is no task {name!r}", "choose one of /api/v1/catalogue", 404)
        told = self.previews.get(name, {"able": [], "refused": {}, "likely": None})
        return {**told, "together": self.together.get(group, [])}

    def catalogue(self) -> list[Mapping[str, Any]]:
        """Return what the desk was made with."""
        return self.tasks

    def cancel(self, task_id: str) -> None:
        """Write it down."""
        self._noted("cancel", task_id)

    def pause(self, task_id: str) -> None:
        """Write it down."""
        self._noted("pause", task_id)

    def resume(self, task_id: str) -> None:
        """Write it down."""
        self._noted("resume", task_id)

    def message(self, uuid: str, text: str) -> dict[str, Any]:
        """Write it down; nobody is here to have it."""
        self._noted("message", uuid, text)
        return {"delivered": [], "failed": {}}

    def disconnect(self, uuid: str, seconds: float) -> None:
        """Write it down."""
        self._noted("disconnect", uuid, seconds)

    def move_target(self, x: float, y: float) -> None:
        """Move it."""
        self._noted("target", x, y)
        if self.ground is not None:
            self.ground = {**self.ground, "target": {"x": x, "y": y, "radius": 0.08}}

    def clear_target(self) -> None:
        """Take it away."""
        self._noted("clear")
        if self.ground is not None:
            self.ground = {**self.ground, "target": None}

    def move_robot(self, name: str, x: float, y: float, heading: float) -> None:
        """Move it."""
        self._noted("robot", name, x, y, heading)
        if self.ground is not None:
            place = {"x": x, "y": y, "heading": heading}
            dogs = [{**dog, **place} if dog["name"] == name else dog for dog in self.ground["dogs"]]
            self.ground = {**self.ground, "dogs": dogs}

    def yard(self) -> dict[str, Any] | None:
        """Return the ground."""
        return self.ground

    def _noted(self, *wish: Any) -> str:
        self.asked.append(wish)
        return f"{wish[0]}-{len(self.asked)}"
