"""The interface of all drivers.  A driver describes its robot before it connects to it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from twisted.internet.defer import Deferred

from drivers.reading import Action, Description, Observation, Value

MAX_FPS = 30.0


@dataclass(frozen=True)
class Permit:
    """The right to move a robot until a deadline: a fencing token, and the deadline in seconds on the driver's clock.

    A driver stores the highest token it has seen, refuses lower ones with ``StaleCommand``, and stops the robot when
    the deadline of the last command has passed.
    """

    token: int
    deadline: float


@runtime_checkable
class Filming(Protocol):
    """A driver with an adjustable camera frame rate."""

    @property
    def camera_fps(self) -> float:
        """The frame rate in pictures per second."""

    def set_camera_fps(self, fps: float) -> None:
        """Set the frame rate in pictures per second, 0 to ``MAX_FPS``; 0 switches the camera off."""


class Driver(Protocol):
    """One robot with an asynchronous interface; all methods are called on the reactor's thread.

    A driver with an adjustable camera frame rate implements ``Filming`` as well.
    ``state`` is one of ``idle connecting ready stale stopped closed``.
    """

    @property
    def description(self) -> Description:
        """The description of the robot; valid before ``connect``."""

    @property
    def state(self) -> str:
        """The state of the link."""

    @property
    def token(self) -> int:
        """The highest token that the robot reports to have obeyed; a new lease needs a higher one."""

    def connect(self) -> Deferred[Description]:
        """Open the link; fires when the first observation has arrived. A lost link is reopened, with back-off."""

    def disconnect(self) -> Deferred[None]:
        """Stop the motion, then close.  May be called twice."""

    def enable(self) -> Deferred[bool]:
        """Switch the motors on."""

    def disable(self) -> Deferred[bool]:
        """Switch the motors off."""

    def act(self, action: Action, permit: Permit) -> Action:
        """Perform ``action`` until ``permit.deadline``; return the action clipped to the limits.  Never blocks.

        Raises ``NotEnabled``, ``Unsupported`` (unknown key, NaN), ``StaleCommand``.
        """

    def stop(self) -> Action:
        """Set the motion to zero now; safe in any state and never refused."""

    def observe(self) -> Observation | None:
        """Return the newest observation, None before the first; never blocks."""

    def subscribe(self, callback: Callable[[Observation], None]) -> Callable[[], None]:
        """Call ``callback`` with each observation; return a function that ends the subscription."""

    def invoke(self, name: str, **arguments: float | str) -> Deferred[Mapping[str, Value]]:
        """Run one of ``description.skills``; fires with its results when it has finished.

        Fails with ``Unsupported`` for an unknown name or a wrong argument, or with ``LinkLost`` or ``NoReply``.
        """

    def diagnostics(self) -> dict[str, float]:
        """Return counters (frames, bad frames, bytes, reconnects), and the newest observation's ``age`` in seconds.

        ``accepted`` counts the accepted commands, ``lower token`` and ``late`` the refused commands by reason.
        """
