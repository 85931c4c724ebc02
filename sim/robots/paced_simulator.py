"""A simulated world with a clock and with connections of drivers, for any kind of robots.

Each robot obeys one driver at a time, through its own gate. A command expires after its time to live, even if the
driver has ended; the robot also stops when the connection closes. The gate is kept when drivers change: over new
connections it also refuses tokens lower than the highest obeyed token, which the robot reports to each driver.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Protocol

from twisted.internet.interfaces import IDelayedCall, IReactorTime
from twisted.logger import Logger

from drivers.driver import Permit
from drivers.errors import StaleCommand, UsageError
from drivers.gate import Gate
from drivers.link import Link, MemoryConnector
from drivers.reading import Value
from drivers.sim.codec import (
    VERSION,
    Drive,
    FrameReader,
    Halt,
    Hello,
    Message,
    Motors,
    Picture,
    Refused,
    Sensors,
    encode_message,
)
from sim.robots.rendering import HEIGHT, WIDTH
from sim.robots.world import TICK_S

SILENCE_LIMIT_S = 3.0
"""Seconds without data after which a client is disconnected, so that another client can use its robot."""
MAX_LATE_S = 1.0
"""Maximum delay in seconds that the simulator makes up for; a longer delay is skipped."""
MAX_TTL_S = 10.0
MAX_FPS = 30.0
MAX_LISTED_ROBOTS = 12
"""Maximum number of robots that a message lists completely."""


class RobotMotion(Protocol):
    """Moves the robots of a world, by name."""

    def drive(self, name: str, vx: float, vy: float, wz: float) -> None:
        """Set the robot's velocity in its frame, until the next command."""

    def halt(self, name: str) -> None:
        """Stop the robot, braking as hard as it can."""


class PacedSimulator:
    """A simulated world with the robots ``names``, moved by ``legs``, and at most ``most`` connections.

    ``start`` starts the simulated time on ``clock``, ``attach`` adds a connection; subclasses implement ``_simulate``.
    """

    log = Logger()

    def __init__(self, clock: IReactorTime, names: Iterable[str], legs: RobotMotion, most: int) -> None:
        self._clock = clock
        self._motion = legs
        self._max_connections = most
        self._gates = {name: Gate() for name in names}
        self._sessions: list[Session] = []
        self._drivers: dict[str, Session] = {}
        self._reserved: set[str] = set()
        self._origin = clock.seconds()
        self._ticks = 0
        self._pending: IDelayedCall | None = None

    @property
    def driven_robots(self) -> list[str]:
        """The robots that currently have a driver."""
        return [name for name in self._gates if name in self._drivers]

    def start(self) -> None:
        """Start the simulated time."""
        self._origin = self._clock.seconds() - self._ticks * TICK_S
        self._schedule()

    def stop(self) -> None:
        """Stop the simulated time, and close all connections."""
        if self._pending is not None:
            self._pending.cancel()
            self._pending = None
        for session in list(self._sessions):
            session.link.close()

    def attach(self, link: Link) -> Session:
        """Add a connection; return the session that receives its data."""
        session = Session(link, self._on_message, self._on_down, self._now())
        if len(self._sessions) >= self._max_connections:
            session.send(Refused(f"the simulator already has {self._max_connections} connections, its maximum", False))
            link.close()
            return session
        self._sessions.append(session)
        return session

    def connector(self, delay: float = 0.0005) -> MemoryConnector:
        """Return a connector for drivers in this process: ``SimDriver(options, simulator.connector(), clock)``."""
        return MemoryConnector(self._clock, self.attach, delay)

    # -- for subclasses ---------------------------------------------------------------------------------------------

    def _simulate(self, late: float) -> int:
        """Simulate the due tick, and some of the ticks missed in ``late`` seconds; return the number of ticks."""
        raise NotImplementedError

    def _on_other(self, session: Session, message: Message) -> None:
        """Handle a message that is not from a driver."""

    def _reserve_robot(self, name: str) -> None:
        """Reserve a robot for an emulator, so that no driver can use it; raise ``UsageError`` for an unknown robot."""
        if name not in self._gates:
            raise UsageError(f"no robot is named {name!r} in this simulator; it has {self._list_names()}")
        self._reserved.add(name)

    def _report_sensors(
        self,
        name: str,
        t: float,
        values: Mapping[str, Value],
        samples: Mapping[str, tuple[float, ...]],
        picture: Callable[[], bytes] | None,
    ) -> None:
        """Send the sensor values at time ``t`` to the driver of the robot ``name``, and a picture if it is due."""
        session = self._drivers.get(name)
        if session is None or session.link.is_busy:
            return
        if picture is not None and session.picture_timer.is_due(t):
            session.seq += 1
            session.send(Picture(session.seq, t, WIDTH, HEIGHT, picture()))
        sensed = {**values, "estop.engaged": not session.has_motors}
        session.send(Sensors(t, sensed, samples, self._gates[name].token or 0))

    def _stop_expired(self, t: float) -> None:
        for name, gate in self._gates.items():
            if gate.is_motion_over(t):
                self._halt(name)

    def _drop_silent(self) -> None:
        now = self._now()
        for session in list(self._sessions):
            if now - session.received_at > SILENCE_LIMIT_S:
                self.log.warn(
                    "{robot}: no data from its client for {seconds} s; closing the connection",
                    robot=session.robot or "?",
                    seconds=SILENCE_LIMIT_S,
                )
                session.link.close()

    # -- time -------------------------------------------------------------------------------------------------------

    def _now(self) -> float:
        """Return the simulator's time in seconds since its start, between ticks as well."""
        return self._clock.seconds() - self._origin

    def _schedule(self) -> None:
        self._pending = self._clock.callLater(max(0.0, (self._ticks + 1) * TICK_S - self._now()), self._on_tick)

    def _on_tick(self) -> None:
        late = self._now() - (self._ticks + 1) * TICK_S
        if late > MAX_LATE_S:
            # After the machine was suspended, skip the lost time and cancel all commands.
            self._origin += late
            late = 0.0
            for name in self._gates:
                self._halt(name)
        self._ticks += self._simulate(late)
        self._schedule()

    # -- drivers ----------------------------------------------------------------------------------------------------

    def _on_message(self, session: Session, message: Message) -> None:
        session.received_at = self._now()
        match message:
            case Hello():
                self._on_hello(session, message)
            case Motors() | Halt() | Drive():
                if session.robot is not None:
                    self._on_command(session.robot, session, message)
            case _:
                self._on_other(session, message)

    def _on_hello(self, session: Session, hello: Hello) -> None:
        problem, is_lasting = "", True
        if hello.version != VERSION:
            problem = f"the simulator has protocol version {VERSION}, not {hello.version}; update one of them"
        elif hello.robot not in self._gates:
            problem = f"no robot is named {hello.robot!r} in this simulator; it has {self._list_names()}"
        elif hello.robot in self._reserved:
            problem = f"{hello.robot} emulates a robot of another kind; correct the kind of the driver"
        elif self._drivers.get(hello.robot, session) is not session:
            problem, is_lasting = f"{hello.robot} is in use by another driver", False
        elif session.robot not in (None, hello.robot):
            problem = f"this connection already uses {session.robot}"
        if problem:
            session.send(Refused(problem, is_lasting))
            session.link.close()
            return
        session.robot = hello.robot
        session.picture_timer = PeriodicTimer(min(max(hello.camera_fps, 0.0), MAX_FPS))
        self._drivers[hello.robot] = session

    def _on_command(self, name: str, session: Session, message: Motors | Halt | Drive) -> None:
        match message:
            case Motors():
                session.has_motors = message.on
                if not message.on:
                    self._halt(name)
            case Halt():
                self._halt(name)
            case Drive() if session.has_motors:
                now = self._now()
                # A delay on the network shortens a command; a time stamp in the future does not extend the command.
                deadline = min(message.sent, now) + min(message.ttl, MAX_TTL_S)
                try:
                    self._gates[name].admit(Permit(message.token, deadline), now)
                except StaleCommand as error:
                    self.log.debug("{robot}: {error}", robot=name, error=error)
                    return
                self._motion.drive(name, message.vx, message.vy, message.wz)

    def _halt(self, name: str) -> None:
        self._gates[name].end_motion()
        self._motion.halt(name)

    def _on_down(self, session: Session) -> None:
        if session in self._sessions:
            self._sessions.remove(session)
        if session.robot is not None and self._drivers.get(session.robot) is session:
            del self._drivers[session.robot]
            self._halt(session.robot)

    def _list_names(self) -> str:
        """Return the names of the robots; of many robots, only the first and the last name."""
        names = list(self._gates)
        return ", ".join(names) if len(names) <= MAX_LISTED_ROBOTS else f"{names[0]} to {names[-1]}"


class Session:
    """A connection of a driver that uses ``robot``, of an operator, or of a client before its first message."""

    def __init__(
        self, link: Link, on_message: Callable[[Session, Message], None], on_down: Callable[[Session], None], now: float
    ) -> None:
        self.link = link
        self.robot: str | None = None
        self.has_motors = False
        self.is_operator = False
        self.received_at = now
        self.picture_timer = PeriodicTimer(0.0)
        self.state_timer = PeriodicTimer(0.0)
        self.seq = 0
        self._reader = FrameReader()
        self._is_down = False
        self._on_message = on_message
        self._on_down = on_down

    def send(self, message: Message) -> None:
        """Send one complete message."""
        self.link.send(encode_message(message))

    def data_received(self, data: bytes) -> None:
        """Process bytes from the client."""
        for message in self._reader.read(data):
            if self._is_down:
                return
            self._on_message(self, message)

    def link_down(self) -> None:
        """Handle the loss of the link."""
        if not self._is_down:
            self._is_down = True
            self._on_down(self)


class PeriodicTimer:
    """A timer with ``rate`` events per second of simulated time; no events at rate 0."""

    def __init__(self, rate: float) -> None:
        self._period = 1.0 / rate if rate > 0 else 0.0
        self._next_at = 0.0

    def is_due(self, t: float) -> bool:
        """Return whether an event is due at ``t``; if called once per tick, the average rate is exact."""
        # The tolerance prevents rounding from delaying an event that falls exactly on a tick.
        if not self._period or t < self._next_at - 1e-6:
            return False
        self._next_at += self._period
        if self._next_at < t:
            # This is the first event, or an event after a pause: missed events are skipped.
            self._next_at = t + self._period
        return True
