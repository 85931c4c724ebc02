"""The contract that every robot's driver keeps (after the "describe before you connect" rule)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from twisted.internet.defer import Deferred

from drivers.reading import Action, Description, Observation, Value

MAX_FPS = 30.0


@dataclass(frozen=True)
class Permit:
    """The right to move a robot for a while: a fencing token and a deadline on the driver's clock, in seconds.

    A driver keeps the highest token it has seen, refuses lower ones with ``StaleCommand``, and stops the robot by
    itself when the deadline of the last command has passed.
    """

    token: int
    deadline: float


@runtime_checkable
class Filming(Protocol):
    """A driver whose camera takes as many pictures a second as it is asked for."""

    @property
    def camera_fps(self) -> float:
        """So many it takes."""

    def set_camera_fps(self, fps: float) -> None:
        """Have it take ``fps``, 0 to ``MAX_FPS``; 0: none."""


class Driver(Protocol):
    """One robot, asked asynchronously; everything happens on the reactor's thread.

    One whose camera can be asked for more or fewer pictures is ``Filming`` as well.
    ``state`` is one of ``idle connecting ready stale stopped closed``.
    """

    @property
    def description(self) -> Description:
        """What the robot is; valid before ``connect``."""

    @property
    def state(self) -> str:
        """Where the link stands."""

    @property
    def token(self) -> int:
        """The highest token that the robot has obeyed, as far as it told: a new claim has to lie above it."""

    def connect(self) -> Deferred[Description]:
        """Open the link; fires when the first observation has arrived.  Lost links are opened again with back-off."""

    def disconnect(self) -> Deferred[None]:
        """Stop the motion, then close.  May be called twice."""

    def enable(self) -> Deferred[bool]:
        """Motors on."""

    def disable(self) -> Deferred[bool]:
        """Motors off."""

    def act(self, action: Action, permit: Permit) -> Action:
        """Do ``action`` until ``permit.deadline``; returns what is really done, clipped to the limits.  Never blocks.

        Raises ``NotEnabled``, ``Unsupported`` (unknown key, NaN), ``StaleCommand``.
        """

    def stop(self) -> Action:
        """Zero motion now; safe in any state and never refused."""

    def observe(self) -> Observation | None:
        """The newest observation; never blocks."""

    def subscribe(self, seen: Callable[[Observation], None]) -> Callable[[], None]:
        """Call ``seen`` at each observation; call what is returned to end that."""

    def invoke(self, name: str, **arguments: float | str) -> Deferred[Mapping[str, Value]]:
        """Have the robot do one of ``description.skills``; fires with what it tells of that when it is done.

        Fails with ``Unsupported`` for another name or a wrong argument, with ``LinkLost`` or ``NoReply``.
        """

    def diagnostics(self) -> dict[str, float]:
        """Counters: frames, bad frames, bytes, reconnects, age of the newest observation in seconds.

        Also the commands ``accepted`` here, and those refused as ``lower token`` or ``late``.
        """
