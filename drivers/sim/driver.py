"""SimDriver: a dog of the simulated yard, asked like any other robot."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred, fail, succeed
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from drivers.driver import Permit
from drivers.errors import LinkLost, NoReply, NotEnabled, Unsupported, UsageError
from drivers.gate import Gate
from drivers.reading import Action, Description, Frame, Observation
from drivers.sim.codec import (
    VERSION,
    Alive,
    Drive,
    FrameReader,
    Halt,
    Hello,
    Message,
    Motors,
    Picture,
    Refused,
    Sensors,
    encoded,
)
from drivers.sim.link import Connector, Line, Link
from drivers.sim.option import Options, checked, described

STALE_S = 0.25
"""Without a sensor frame for so long (about eight of them) the link counts as stale."""
SWITCH_S = 1.0
"""A robot that has not switched its motors after so long does not answer."""
ALIVE_S = 0.5


class SimDriver:
    """One dog of the yard, through links that ``connector`` opens; everything happens on the reactor's thread.

    After ``connect`` the motors are off and ``estop.engaged`` is true until ``enable``.  ``state`` says ``ready`` while
    observations flow, ``stale`` while they do not (no frame for ``STALE_S``, or the link is being opened again)
    and ``stopped`` after ``disable``.  A link that comes back finds the motors as they were asked for, and
    the motion at rest.
    """

    log = Logger()

    def __init__(self, options: Options | Mapping[str, object], connector: Connector, clock: IReactorTime) -> None:
        self._options = options if isinstance(options, Options) else checked(options)
        self._description = described(self._options)
        self._connector = connector
        self._clock = clock
        self._gate = Gate()
        self._line: Line | None = None
        self._link: Link | None = None
        self._reader = FrameReader()
        self._connecting: Deferred[Description] | None = None
        self._is_closed = False
        self._has_problem = False
        self._wants_motors = False
        self._is_disabled = False
        self._switching: list[tuple[bool, Deferred[bool], Any]] = []
        self._motion = dict.fromkeys(self._description.limits, 0.0)
        self._end: Any = None
        self._alive: Any = None
        self._frame: Frame | None = None
        self._newest: Observation | None = None
        self._is_heard = False
        self._seen: list[Callable[[Observation], None]] = []
        self._counts = dict.fromkeys(("frames", "bad_frames", "pictures", "bytes", "links", "refused"), 0)

    @property
    def description(self) -> Description:
        """What the robot is; valid before ``connect``."""
        return self._description

    @property
    def state(self) -> str:
        """Where the link stands: ``idle connecting ready stale stopped closed``."""
        if self._is_closed:
            return "closed"
        if self._line is None:
            return "idle"
        if self._newest is None:
            return "connecting"
        if not self._is_heard or self._clock.seconds() - self._newest.t_host > STALE_S:
            return "stale"
        return "stopped" if self._is_disabled else "ready"

    @property
    def token(self) -> int:
        """The highest token that the robot has obeyed, as far as it told, whoever commanded it then."""
        return self._gate.token or 0

    def connect(self) -> Deferred[Description]:
        """Open the link; fires when the first observation has arrived.  Lost links are opened again with back-off.

        Fails with ``Unsupported`` where the yard has no such robot.  While another driver holds the robot, it is
        asked for again until it is free.
        """
        if self._is_closed:
            return fail(UsageError("this driver was disconnected; make a new one"))
        if self._line is not None:
            return fail(UsageError("this driver is connected already, or on its way"))
        self._connecting = Deferred(lambda _: self._give_up())
        connecting = self._connecting
        self._line = self._connector.call(self._options.host, self._options.port, self)
        return connecting

    def disconnect(self) -> Deferred[None]:
        """Stop the motion, then close.  May be called twice."""
        if self._is_closed:
            return succeed(None)
        self.stop()
        self._give_up()
        self._fail_waiting(LinkLost(f"{self._options.robot}: disconnected before the first observation"))
        return succeed(None) if self._line is None else self._line.hang_up()

    def enable(self) -> Deferred[bool]:
        """Motors on; fires with True when the robot says so, fails with ``LinkLost`` or ``NoReply``."""
        return self._switch(True)

    def disable(self) -> Deferred[bool]:
        """Motors off; fires with True when the robot says so, fails with ``LinkLost`` or ``NoReply``."""
        self.stop()
        return self._switch(False)

    def act(self, action: Action, permit: Permit) -> Action:
        """Do ``action`` until ``permit.deadline``; returns what is really done, clipped to the limits.  Never blocks.

        Raises ``NotEnabled``, ``Unsupported`` (unknown key, NaN), ``StaleCommand``.
        """
        limits = self._description.limits
        for key, value in action.items():
            if key not in limits:
                raise Unsupported(f"this robot has no action {key!r}; it knows {', '.join(limits)}")
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
                raise Unsupported(f"{key} must be a finite number, not {value!r}")
        newest = self._newest
        if self.state != "ready" or newest is None or self._link is None:
            raise NotEnabled(f"{self._options.robot} is {self.state}, not ready; wait for the link, or call enable()")
        if newest.values.get("estop.engaged") is not False:
            raise NotEnabled(f"{self._options.robot}'s motors are off; call enable() first")
        now = self._clock.seconds()
        self._gate.admit(permit, now)
        for key, value in action.items():
            low, high = limits[key]
            self._motion[key] = min(max(float(value), low), high)
        sent = newest.t_robot + (now - newest.t_host)
        vx, vy, wz = self._motion["base.vx"], self._motion["base.vy"], self._motion["base.wz"]
        self._send(Drive(vx, vy, wz, permit.token, permit.deadline - now, sent))
        self._cancel_end()
        self._end = self._clock.callLater(permit.deadline - now, self._on_end)
        return dict(self._motion)

    def stop(self) -> Action:
        """Zero motion now; safe in any state and never refused."""
        self._rest()
        self._send(Halt())
        return dict(self._motion)

    @property
    def camera_fps(self) -> float:
        """Pictures a second that the camera is asked for."""
        return self._options.wanted_fps

    def set_camera_fps(self, fps: float) -> None:
        """Ask the camera for so many pictures a second from now on; 0: none."""
        self._options = replace(self._options, camera_fps=fps)
        self._send(Hello(VERSION, self._options.robot, self._options.wanted_fps))

    def observe(self) -> Observation | None:
        """The newest observation; never blocks."""
        return self._newest

    def subscribe(self, seen: Callable[[Observation], None]) -> Callable[[], None]:
        """Call ``seen`` at each observation; call what is returned to end that."""
        self._seen.append(seen)

        def end() -> None:
            if seen in self._seen:
                self._seen.remove(seen)

        return end

    def diagnostics(self) -> dict[str, float]:
        """Counters: frames, bad frames, pictures, bytes, links, reconnects, refused; ``age`` of the newest in s.

        Also the commands ``accepted`` here, and those refused as ``lower token`` or ``late``.
        """
        counts: dict[str, float] = {**self._counts, "accepted": self._gate.accepted, **self._gate.refused}
        counts["reconnects"] = max(0, self._counts["links"] - 1)
        counts["age"] = math.inf if self._newest is None else self._clock.seconds() - self._newest.t_host
        return counts

    def link_up(self, link: Link) -> None:
        """Ask the yard for the robot; called by the line."""
        self._link = link
        self._reader = FrameReader()
        self._counts["links"] += 1
        self._send(Hello(VERSION, self._options.robot, self._options.wanted_fps))
        if self._wants_motors:
            self._send(Motors(True))
        self._keep_alive()

    def link_down(self) -> None:
        """Bring the motion to rest here, as the yard does there; called by the line."""
        self._link = None
        self._is_heard = False
        self._rest()
        if self._alive is not None:
            self._alive.cancel()
            self._alive = None
        self._fail_switching(LinkLost(f"the link to {self._options.robot} went away; it is being opened again"))

    def received(self, data: bytes) -> None:
        """Take bytes from the yard; called by the line."""
        self._counts["bytes"] += len(data)
        bad = self._reader.bad_frames
        for message in self._reader.read(data):
            if self._is_closed:
                return
            self._counts["frames"] += 1
            self._on_message(message)
        self._counts["bad_frames"] += self._reader.bad_frames - bad

    def _on_message(self, message: Message) -> None:
        match message:
            case Sensors():
                self._on_sensors(message)
            case Picture():
                self._counts["pictures"] += 1
                self._frame = Frame(message.seq, message.width, message.height, message.data, message.t)
            case Refused():
                self._on_refused(message)
            case _:
                self._counts["bad_frames"] += 1

    def _on_sensors(self, message: Sensors) -> None:
        observation = Observation(self._clock.seconds(), float(message.t), message.values, message.samples, self._frame)
        self._newest = observation
        self._gate.learn(message.token)
        self._is_heard = True
        self._has_problem = False
        self._settle_switching(observation.values.get("estop.engaged"))
        connecting, self._connecting = self._connecting, None
        if connecting is not None:
            connecting.callback(self._description)
        for seen in list(self._seen):
            try:
                seen(observation)
            except Exception:
                self.log.failure("a subscriber of {robot} failed", robot=self._options.robot)

    def _on_refused(self, message: Refused) -> None:
        self._counts["refused"] += 1
        if not message.lasting:
            if not self._has_problem:
                self.log.warn("yard: {reason}; asking again", reason=message.reason)
            self._has_problem = True
            return
        self._give_up()
        if self._line is not None:
            self._line.hang_up()
        if self._connecting is None:
            self.log.error("yard: {reason}", reason=message.reason)
        self._fail_waiting(Unsupported(message.reason))

    def _send(self, message: Message) -> None:
        if self._link is not None:
            self._link.send(encoded(message))

    def _keep_alive(self) -> None:
        self._send(Alive())
        self._alive = self._clock.callLater(ALIVE_S, self._keep_alive)

    def _switch(self, on: bool) -> Deferred[bool]:
        if self._link is None or self._newest is None:
            return fail(LinkLost(f"{self._options.robot} is {self.state}; connect first, or wait for the link"))
        self._fail_switching(UsageError("another enable() or disable() came in between"))
        self._wants_motors = on
        self._is_disabled = not on
        self._send(Motors(on))
        switched: Deferred[bool] = Deferred()
        timer = self._clock.callLater(SWITCH_S, self._on_no_switch)
        self._switching.append((on, switched, timer))
        return switched

    def _settle_switching(self, is_engaged: object) -> None:
        waiting, self._switching = self._switching, []
        for on, switched, timer in waiting:
            if is_engaged is (not on):
                timer.cancel()
                switched.callback(True)
            else:
                self._switching.append((on, switched, timer))

    def _on_no_switch(self) -> None:
        self._fail_switching(NoReply(f"{self._options.robot} did not switch its motors within {SWITCH_S:g} s"))

    def _fail_switching(self, error: Exception) -> None:
        waiting, self._switching = self._switching, []
        for _, switched, timer in waiting:
            if timer.active():
                timer.cancel()
            switched.errback(error)

    def _fail_waiting(self, error: Exception) -> None:
        connecting, self._connecting = self._connecting, None
        if connecting is not None:
            connecting.errback(error)

    def _on_end(self) -> None:
        self._end = None
        self.stop()

    def _rest(self) -> None:
        self._cancel_end()
        self._gate.close()
        for key in self._motion:
            self._motion[key] = 0.0

    def _cancel_end(self) -> None:
        if self._end is not None and self._end.active():
            self._end.cancel()
        self._end = None

    def _give_up(self) -> None:
        self._is_closed = True
        self._rest()
        if self._alive is not None and self._alive.active():
            self._alive.cancel()
        self._alive = None
        self._fail_switching(LinkLost(f"{self._options.robot}: disconnected"))
