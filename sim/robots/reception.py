"""Reception: a yard that a clock paces, and that drivers reach over connections; it knows not who lives there.

Each robot obeys one driver at a time, through a gate of its own: a command runs out after its time to live, whatever
became of the driver, and the robot stops when the connection closes.  The gate outlives its drivers: what is older than
what the robot has obeyed is refused, also over a new connection, and the robot tells the next driver how far it is.
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
    encoded,
)
from sim.robots.lens import HEIGHT, WIDTH
from sim.robots.world import TICK

SILENT_S = 3.0
"""A client that says nothing for so long is given up, and its robot is free for another."""
MAX_LATE_S = 1.0
"""Seconds by which a yard may be late and still make up for them."""
MAX_TTL_S = 10.0
MAX_FPS = 30.0
NAMED = 12
"""A message names all robots of a yard only where there are no more."""


class Legs(Protocol):
    """What moves the robots of a yard, by their names."""

    def drive(self, name: str, vx: float, vy: float, wz: float) -> None:
        """Let a robot walk with this velocity in its own frame until told otherwise."""

    def halt(self, name: str) -> None:
        """Let a robot stand still, as fast as it can brake."""


class PacedYard:
    """A yard of the robots ``names``, which ``legs`` move, with at most ``most`` connections.

    ``start`` lets its time run on ``clock``, ``attach`` takes a connection; a subclass lets time pass in ``_play``.
    """

    log = Logger()

    def __init__(self, clock: IReactorTime, names: Iterable[str], legs: Legs, most: int) -> None:
        self._clock = clock
        self._legs = legs
        self._most = most
        self._gates = {name: Gate() for name in names}
        self._sessions: list[Session] = []
        self._drivers: dict[str, Session] = {}
        self._lent: set[str] = set()
        self._origin = clock.seconds()
        self._ticks = 0
        self._pending: IDelayedCall | None = None

    @property
    def holders(self) -> list[str]:
        """The robots that a driver holds now."""
        return [name for name in self._gates if name in self._drivers]

    def start(self) -> None:
        """Let time run from now on."""
        self._origin = self._clock.seconds() - self._ticks * TICK
        self._schedule()

    def stop(self) -> None:
        """Let time stand still, and close every connection."""
        if self._pending is not None:
            self._pending.cancel()
            self._pending = None
        for session in list(self._sessions):
            session.link.close()

    def attach(self, link: Link) -> Session:
        """Take a new connection; what arrives on it goes to the session that is returned."""
        session = Session(link, self._on_message, self._on_down, self._now())
        if len(self._sessions) >= self._most:
            session.send(Refused(f"the yard has {self._most} connections already", False))
            link.close()
            return session
        self._sessions.append(session)
        return session

    def connector(self, delay: float = 0.0005) -> MemoryConnector:
        """What drivers in this process connect through: ``SimDriver(options, yard.connector(), clock)``."""
        return MemoryConnector(self._clock, self.attach, delay)

    # -- for subclasses ---------------------------------------------------------------------------------------------

    def _play(self, late: float) -> int:
        """Let the tick that is due pass, and of those that are ``late``, in seconds, as many as wanted; how many."""
        raise NotImplementedError

    def _on_other(self, session: Session, message: Message) -> None:
        """Take a message that no driver sends."""

    def _withhold(self, name: str) -> None:
        """Have no driver hold this robot here; raises ``UsageError`` where there is no such robot."""
        if name not in self._gates:
            raise UsageError(f"no robot is named {name!r} in this yard; it has {self._listed()}")
        self._lent.add(name)

    def _tell(
        self,
        name: str,
        t: float,
        values: Mapping[str, Value],
        samples: Mapping[str, tuple[float, ...]],
        picture: Callable[[], bytes] | None,
    ) -> None:
        """Tell who holds the robot ``name`` what it feels at ``t`` of the yard's time, and show what it sees if due."""
        session = self._drivers.get(name)
        if session is None or session.link.is_busy:
            return
        if picture is not None and session.pictures.is_due(t):
            session.seq += 1
            session.send(Picture(session.seq, t, WIDTH, HEIGHT, picture()))
        felt = {**values, "estop.engaged": not session.has_motors}
        session.send(Sensors(t, felt, samples, self._gates[name].token or 0))

    def _expire(self, t: float) -> None:
        """Halt the robots whose command has run out at ``t``."""
        for name, gate in self._gates.items():
            if gate.is_over(t):
                self._halt(name)

    def _drop_silent(self) -> None:
        """Close the connections on which nothing is heard any more."""
        now = self._now()
        for session in list(self._sessions):
            if now - session.heard_at > SILENT_S:
                self.log.warn("{robot}: nothing heard for {seconds} s", robot=session.robot or "?", seconds=SILENT_S)
                session.link.close()

    # -- time -------------------------------------------------------------------------------------------------------

    def _now(self) -> float:
        """The yard's time between the ticks too, in seconds since its start."""
        return self._clock.seconds() - self._origin

    def _schedule(self) -> None:
        self._pending = self._clock.callLater(max(0.0, (self._ticks + 1) * TICK - self._now()), self._turn)

    def _turn(self) -> None:
        late = self._now() - (self._ticks + 1) * TICK
        if late > MAX_LATE_S:
            # After a suspended machine nobody wants the lost minutes back at once, nor what was ordered before them.
            self._origin += late
            late = 0.0
            for name in self._gates:
                self._halt(name)
        self._ticks += self._play(late)
        self._schedule()

    # -- drivers ----------------------------------------------------------------------------------------------------

    def _on_message(self, session: Session, message: Message) -> None:
        session.heard_at = self._now()
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
            problem = f"the yard speaks version {VERSION} and not {hello.version}; update one of them"
        elif hello.robot not in self._gates:
            problem = f"no robot is named {hello.robot!r} in this yard; it has {self._listed()}"
        elif hello.robot in self._lent:
            problem = f"{hello.robot} is reached as a robot of another kind here; correct the driver's kind"
        elif self._drivers.get(hello.robot, session) is not session:
            problem, is_lasting = f"{hello.robot} is taken by another driver", False
        elif session.robot not in (None, hello.robot):
            problem = f"this connection holds {session.robot} already"
        if problem:
            session.send(Refused(problem, is_lasting))
            session.link.close()
            return
        session.robot = hello.robot
        session.pictures = Beat(min(max(hello.camera_fps, 0.0), MAX_FPS))
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
                # A command that was held up has used up its time on the way; a stamp ahead of ours gains nothing.
                deadline = min(message.sent, now) + min(message.ttl, MAX_TTL_S)
                try:
                    self._gates[name].admit(Permit(message.token, deadline), now)
                except StaleCommand as error:
                    self.log.debug("{robot}: {error}", robot=name, error=error)
                    return
                self._legs.drive(name, message.vx, message.vy, message.wz)

    def _halt(self, name: str) -> None:
        self._gates[name].close()
        self._legs.halt(name)

    def _on_down(self, session: Session) -> None:
        if session in self._sessions:
            self._sessions.remove(session)
        if session.robot is not None and self._drivers.get(session.robot) is session:
            del self._drivers[session.robot]
            self._halt(session.robot)

    def _listed(self) -> str:
        """The names of the robots, or the first and the last of many."""
        names = list(self._gates)
        return ", ".join(names) if len(names) <= NAMED else f"{names[0]} to {names[-1]}"


class Session:
    """A driver that holds ``robot``, or an operator, or somebody who has not said yet; a ``Receiver`` of the link."""

    def __init__(
        self, link: Link, on_message: Callable[[Session, Message], None], on_down: Callable[[Session], None], now: float
    ) -> None:
        self.link = link
        self.robot: str | None = None
        self.has_motors = False
        self.is_operator = False
        self.heard_at = now
        self.pictures = Beat(0.0)
        self.truths = Beat(0.0)
        self.seq = 0
        self._reader = FrameReader()
        self._is_down = False
        self._on_message = on_message
        self._on_down = on_down

    def send(self, message: Message) -> None:
        """Send one message, whole and at once."""
        self.link.send(encoded(message))

    def received(self, data: bytes) -> None:
        """Take bytes from the client."""
        for message in self._reader.read(data):
            if self._is_down:
                return
            self._on_message(self, message)

    def link_down(self) -> None:
        """Learn that the client is gone."""
        if not self._is_down:
            self._is_down = True
            self._on_down(self)


class Beat:
    """A rhythm of ``rate`` a second on the yard's time; 0 never beats."""

    def __init__(self, rate: float) -> None:
        self._period = 1.0 / rate if rate > 0 else 0.0
        self._next_at = 0.0

    def is_due(self, t: float) -> bool:
        """Whether a beat falls due at ``t``; asked once each tick, it keeps the rate on average."""
        # The tolerance keeps a beat that falls exactly on a tick from slipping to the next one by rounding.
        if not self._period or t < self._next_at - 1e-6:
            return False
        self._next_at += self._period
        if self._next_at < t:
            # The first beat, or one after a pause: what was missed is not made up for.
            self._next_at = t + self._period
        return True
