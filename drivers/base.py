"""Base classes of drivers: the behaviour that is the same for every kind of robot.

The driver of a kind of robot inherits from ``BaseDriver``. It implements five methods that command its robot (``_open
_close _power _drive _halt``) and calls four methods to report on the robot (``_up _observed _down _refused``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol

from twisted.internet.defer import Deferred, fail, gatherResults, succeed
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from drivers.deadman.switch import DeadManSwitch, HaltCommand
from drivers.driver import Permit
from drivers.errors import LinkLost, NoReply, NotEnabled, Unsupported, UsageError
from drivers.gate import Gate
from drivers.link import Connector, Link, Reconnector
from drivers.reading import Action, Description, Frame, Observation, Value
from drivers.subscribers import Subscribers
from drivers.timer import Timer

ENGAGED = "estop.engaged"
"""Key of the robot's motor switch: true while the motors are off.  A robot without such a switch omits the key."""


def correct_last_data_time(moment: float, due: float, now: float) -> float:
    """Return the ``moment`` of a robot's last data, corrected for a check that runs late.

    The check was due at ``due`` and runs at ``now``. The difference does not count as silence of the robot: this
    process was frozen during that time, and received data may still be unread.
    """
    return min(now, moment + max(0.0, now - due))


class BaseDriver:
    """One robot called ``name``; all methods run on the reactor's thread.

    ``state`` is ``ready`` while observations arrive, ``stale`` when no observation has arrived for ``STALE_S`` or the
    link is being reopened, and ``stopped`` after ``disable``. After a reconnect the motors are in the state that was
    requested last, and the motion is zero. The motion ends at the permit's deadline; a token lower than the highest
    seen is refused. A robot that does not check deadlines itself is halted by ``dead_man`` if this process freezes.
    """

    log = Logger()
    STALE_S = 0.25
    """Seconds without an observation after which the link counts as stale."""
    SWITCH_S = 1.0
    """Seconds within which the robot must confirm that it switched its motors."""

    def __init__(
        self, description: Description, name: str, clock: IReactorTime, dead_man: DeadManSwitch | None = None
    ) -> None:
        self._description = description
        self._name = name
        self._clock = clock
        self._dead_man = dead_man
        self._gate = Gate()
        self._is_open = self._is_closed = self._is_up = self._has_data = False
        self._connecting: Deferred[Description] | None = None
        self._wants_motors: bool | None = None
        self._switching: list[tuple[bool, Deferred[bool]]] = []
        self._switch_timer = Timer(clock)
        self._motion = dict.fromkeys(description.limits, 0.0)
        self._deadline_timer = Timer(clock)
        self._newest: Observation | None = None
        self._subscribers = Subscribers[Observation](name, self.log)
        self._counts = dict.fromkeys(("frames", "bad_frames", "pictures", "bytes", "links", "refused"), 0)

    # -- the interface ----------------------------------------------------------------------------------------------

    @property
    def description(self) -> Description:
        """The description of the robot; valid before ``connect``."""
        return self._description

    @property
    def state(self) -> str:
        """The state of the link: ``idle connecting ready stale stopped closed``."""
        if self._is_closed:
            return "closed"
        if not self._is_open:
            return "idle"
        if self._newest is None:
            return "connecting"
        if not self._has_data or self._clock.seconds() - self._newest.t_host > self.STALE_S:
            return "stale"
        return "stopped" if self._wants_motors is False else "ready"

    @property
    def token(self) -> int:
        """The highest token that the robot reports to have obeyed, from any sender of commands."""
        return self._gate.token or 0

    def connect(self) -> Deferred[Description]:
        """Open the link; fires when the first observation has arrived. A lost link is reopened, with back-off."""
        if self._is_closed:
            return fail(UsageError("this driver was disconnected and cannot be used again; create a new driver"))
        if self._is_open:
            return fail(UsageError("this driver is already connected or connecting; do not call connect() again"))
        self._is_open = True
        connecting = self._connecting = Deferred(self._on_cancelled_connecting)
        self._open()
        return connecting

    def disconnect(self) -> Deferred[None]:
        """Stop the motion, then close.  May be called twice."""
        if self._is_closed:
            return succeed(None)
        self.stop()
        ended = self._mark_closed()
        self._fail_connecting(LinkLost(f"{self._name}: disconnected before the first observation"))
        closed = self._close() if self._is_open else succeed(None)
        return closed if ended is None else gatherResults([closed, ended]).addCallback(lambda _: None)

    def enable(self) -> Deferred[bool]:
        """Switch the motors on; fires with True when the robot confirms, fails with ``LinkLost`` or ``NoReply``."""
        return self._switch(True)

    def disable(self) -> Deferred[bool]:
        """Switch the motors off; fires with True when the robot confirms, fails with ``LinkLost`` or ``NoReply``."""
        self.stop()
        return self._switch(False)

    def act(self, action: Action, permit: Permit) -> Action:
        """Perform ``action`` until ``permit.deadline``; return the action clipped to the limits.  Never blocks.

        Raises ``NotEnabled``, ``Unsupported`` (unknown key, NaN), ``StaleCommand``.
        """
        for key, value in action.items():
            if key not in self._motion:
                known = ", ".join(self._motion) or "none"
                raise Unsupported(f"{self._name} has no action {key!r}; its actions are {known}")
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
                raise Unsupported(f"{key} must be a finite number, not {value!r}")
        if self.state != "ready" or self._newest is None or not self._is_up:
            raise NotEnabled(f"{self._name} is {self.state}, not ready; wait for the link, or call enable()")
        if self._newest.values.get(ENGAGED, False) is not False:
            raise NotEnabled(f"{self._name}'s motors are off; call enable() first")
        now = self._clock.seconds()
        if self._gate.is_motion_over(now):
            # This process was frozen beyond the deadline of the last motion.
            self.stop()
        self._gate.admit(permit, now)
        for key, value in action.items():
            low, high = self._description.limits[key]
            self._motion[key] = min(max(float(value), low), high)
        if self._dead_man is not None:
            self._dead_man.arm(permit.deadline - now)
        done = self._drive(self._motion, permit)
        self._deadline_timer.set(permit.deadline - now, self.stop)
        return dict(done)

    def stop(self) -> Action:
        """Set the motion to zero now; safe in any state and never refused."""
        self._clear_motion()
        if self._is_up:
            self._halt()
        return dict(self._motion)

    def observe(self) -> Observation | None:
        """Return the newest observation, None before the first; never blocks."""
        return self._newest

    def subscribe(self, callback: Callable[[Observation], None]) -> Callable[[], None]:
        """Call ``callback`` with each observation; return a function that ends the subscription."""
        return self._subscribers.add(callback)

    def invoke(self, name: str, **arguments: float | str) -> Deferred[Mapping[str, Value]]:
        """Run one of ``description.skills``, or query a value that is not part of the observations."""
        known = ", ".join(self._description.skills) or "none"
        return fail(Unsupported(f"{self._name} has no skill {name!r}; its skills are {known}"))

    def diagnostics(self) -> dict[str, float]:
        """Return counters (frames, bad frames, pictures, bytes, links, reconnects, refused) and ``age``.

        ``age`` is the age of the newest observation in seconds. ``accepted`` counts the commands that this driver
        accepted, ``lower token`` and ``late`` those that it refused. With a dead man's switch, ``halts`` is the number
        of times that the switch halted the robot.
        """
        counts: dict[str, float] = {**self._counts, "accepted": self._gate.accepted, **self._gate.refused}
        if self._dead_man is not None:
            counts["halts"] = self._dead_man.halts
        counts["reconnects"] = max(0, self._counts["links"] - 1)
        counts["age"] = math.inf if self._newest is None else self._clock.seconds() - self._newest.t_host
        return counts

    # -- implemented by each kind of robot --------------------------------------------------------------------------

    def _open(self) -> None:
        """Start to open the link, and reopen it after each loss; call ``_up`` each time the link opens."""
        raise NotImplementedError

    def _close(self) -> Deferred[None]:
        """Close the link; it is not reopened."""
        raise NotImplementedError

    def _power(self, on: bool) -> None:
        """Switch the motors; done when an observation confirms it, or immediately if the robot does not report it."""

    def _drive(self, motion: Action, permit: Permit) -> Action:
        """Set the motion; return the motion that the robot performs, which can be a part of ``motion``."""
        raise NotImplementedError

    def _halt(self) -> None:
        """Command the robot to stand still."""

    def _make_halt_command(self) -> HaltCommand | None:
        """Return the command by which the dead man's switch halts the robot; None if the robot stops by itself."""
        return None

    # -- called by each kind of robot -------------------------------------------------------------------------------

    def _up(self) -> None:
        """Report that the link has opened, for the first time or again."""
        self._is_up = True
        self._counts["links"] += 1
        self._update_halt_command()
        if self._wants_motors:
            self._power(True)

    def _down(self) -> None:
        """Report that the link is lost; the motion counts as zero."""
        self._is_up = self._has_data = False
        self._clear_motion()
        if self._dead_man is not None:
            self._dead_man.on_link_lost()
        self._fail_switching(LinkLost(f"the link to {self._name} was lost; the driver is reconnecting"))

    def _observed(
        self,
        values: Mapping[str, Value],
        t_robot: float,
        samples: Mapping[str, Sequence[float]] | None = None,
        frame: Frame | None = None,
    ) -> None:
        """Publish a new observation of the robot."""
        rows = {key: tuple(row) for key, row in (samples or {}).items()}
        observation = self._newest = Observation(self._clock.seconds(), t_robot, values, rows, frame)
        self._has_data = True
        self._settle_switching(values.get(ENGAGED))
        connecting, self._connecting = self._connecting, None
        if connecting is not None:
            connecting.callback(self._description)
        self._subscribers.notify(observation)

    def _refused(self, error: Exception) -> None:
        """Close the driver because this robot does not exist, so reconnecting would be useless."""
        self._mark_closed()
        self._close()
        if self._connecting is None:
            self.log.error("{robot}: {error}", robot=self._name, error=error)
        self._fail_connecting(error)

    @property
    def _is_motion_permitted(self) -> bool:
        """Whether a motion is in force and its deadline has not passed.

        Code that repeats a motion has to check this. After the node was frozen, all timers are late, and the timer that
        repeats a motion may fire before the timer that ends the motion.
        """
        return self._gate.deadline is not None and not self._gate.is_motion_over(self._clock.seconds())

    def _update_halt_command(self) -> None:
        """Pass the current halt command to the dead man's switch."""
        command = None if self._dead_man is None else self._make_halt_command()
        if self._dead_man is not None and command is not None:
            self._dead_man.set_halt_command(command)

    def _switch(self, on: bool) -> Deferred[bool]:
        if not self._is_up or self._newest is None:
            return fail(LinkLost(f"{self._name} is {self.state}; connect first, or wait for the link"))
        self._fail_switching(UsageError("this call was replaced by a later enable() or disable()"))
        self._wants_motors = on
        self._power(on)
        if ENGAGED not in self._newest.values:
            return succeed(True)
        switched: Deferred[bool] = Deferred()
        self._switching.append((on, switched))
        late = NoReply(f"{self._name} did not switch its motors within {self.SWITCH_S:g} s")
        self._switch_timer.set(self.SWITCH_S, self._fail_switching, late)
        return switched

    def _settle_switching(self, is_engaged: object) -> None:
        done = [switched for on, switched in self._switching if is_engaged is (not on)]
        self._switching = [(on, switched) for on, switched in self._switching if is_engaged is not (not on)]
        if not self._switching:
            self._switch_timer.cancel()
        for switched in done:
            switched.callback(True)

    def _fail_switching(self, error: Exception) -> None:
        self._switch_timer.cancel()
        waiting, self._switching = self._switching, []
        for _, switched in waiting:
            switched.errback(error)

    def _on_cancelled_connecting(self, _connecting: object) -> None:
        self._connecting = None
        self.disconnect()

    def _fail_connecting(self, error: Exception) -> None:
        connecting, self._connecting = self._connecting, None
        if connecting is not None:
            connecting.errback(error)

    def _clear_motion(self) -> None:
        self._deadline_timer.cancel()
        self._gate.end_motion()
        if self._dead_man is not None:
            self._dead_man.disarm()
        for key in self._motion:
            self._motion[key] = 0.0

    def _mark_closed(self) -> Deferred[None] | None:
        self._is_closed = True
        self._clear_motion()
        self._fail_switching(LinkLost(f"{self._name}: disconnected"))
        return None if self._dead_man is None else self._dead_man.close()


class SensingDriver(BaseDriver):
    """A device that only senses and has no motors, such as a phone or a camera.

    ``enable`` succeeds while readings arrive, and ``{}`` is the only action.
    """

    def _drive(self, motion: Action, permit: Permit) -> Action:
        return motion

    def _switch(self, on: bool) -> Deferred[bool]:
        if self.state == "stale":
            return fail(LinkLost(f"{self._name} sends no readings at present; wait for the next one"))
        return super()._switch(on)


class Reader(Protocol):
    """Splits a robot's bytes into messages."""

    bad_frames: int

    def read(self, data: bytes) -> Iterable[Any]:
        """Return the messages that ``data`` completes."""


class LinkedDriver(BaseDriver):
    """A robot at the end of one link, which ``connector`` opens to ``endpoint``: host and port, or device and baud.

    A kind of robot creates ``_reader`` for each new link and handles the messages in ``_on_message``.
    """

    def __init__(
        self,
        description: Description,
        name: str,
        clock: IReactorTime,
        connector: Connector,
        endpoint: tuple[str, int],
        dead_man: DeadManSwitch | None = None,
    ) -> None:
        super().__init__(description, name, clock, dead_man)
        self._connector = connector
        self._endpoint = endpoint
        self._reconnector: Reconnector | None = None
        self._link: Link | None = None
        self._reader: Reader
        self._timer = Timer(clock)
        self._problem = ""

    @property
    def problem(self) -> str:
        """The reason why no data arrives from the robot, and the remedy; empty if data arrives."""
        return str(getattr(self._reconnector, "problem", "")) or self._problem

    def data_received(self, data: bytes) -> None:
        """Process bytes from the robot; called by the link."""
        self._counts["bytes"] += len(data)
        reader = self._reader
        bad = reader.bad_frames
        for message in reader.read(data):
            if self._is_closed:
                return
            self._on_message(message)
        self._counts["bad_frames"] += reader.bad_frames - bad

    def _on_message(self, message: Any) -> None:
        """Handle one message of the robot."""
        raise NotImplementedError

    def _open(self) -> None:
        self._reconnector = self._connector.connect(*self._endpoint, self)  # type: ignore[arg-type]

    def _close(self) -> Deferred[None]:
        self._timer.cancel()
        return succeed(None) if self._reconnector is None else self._reconnector.disconnect()

    def _send(self, data: bytes) -> None:
        if self._link is not None:
            self._link.send(data)

    def _set_problem(self, problem: str) -> None:
        """Store and log the reason why no data arrives from the robot; a repeated reason is not logged again."""
        if problem != self._problem:
            self.log.warn("{robot}: {problem}", robot=self._name, problem=problem)
        self._problem = problem
