"""The desk: what an operator can ask the team for.

Every method is called on the reactor's thread and returns at once, or returns a Deferred that fires soon.  A wish that
cannot be granted raises ``Refusal``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

from twisted.internet.defer import Deferred

from middleware.entangled.errors import Refused
from webnode.errors import Refusal


class Desk(Protocol):
    """An operator's wishes; the outcome is seen in the state, not in the answer."""

    def call(
        self,
        uuid: str,
        method: str,
        *arguments: object,
        refused: Callable[[Refused], Refusal | None] = lambda refused: None,
    ) -> Deferred[Any]:
        """Call ``method`` of a device; fires with its answer, fails with ``Refusal``.

        409: it is not here, leaves while it is asked, or refuses; 504: it does not answer.  ``refused`` may translate
        its refusal.
        """

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
