"""Reception: who drives which robot of a yard: the connections, who holds a robot, and the gate before each.

Each robot obeys one driver at a time, through a gate of its own: a command runs out after its time to live, whatever
became of the driver, and the robot stops when the connection closes.  The gate outlives its drivers: what is older than
what the robot has obeyed is refused, also over a new connection, and the robot tells the next driver how far it is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Protocol

from twisted.logger import Logger

from drivers.driver import Permit
from drivers.errors import StaleCommand, UsageError
from drivers.gate import Gate
from drivers.link import Link
from drivers.reading import Value
from drivers.sim.codec import VERSION, Drive, Halt, Hello, Message, Motors, Picture, Refused, Sensors
from sim.robots.lens import HEIGHT, WIDTH
from sim.robots.session import Beat, Session

SILENT_S = 3.0
"""A client that says nothing for so long is given up, and its robot is free for another."""
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


class Reception:
    """The reception of a yard with the robots ``names``, which ``legs`` move.

    ``now`` is the yard's time between the steps too, in seconds since its start; no more than ``most`` connections are
    taken; a message that no driver sends goes to ``other``.
    """

    log = Logger()

    def __init__(
        self,
        names: Iterable[str],
        legs: Legs,
        now: Callable[[], float],
        most: int,
        other: Callable[[Session, Message], None] = lambda session, message: None,
    ) -> None:
        self.gates = {name: Gate() for name in names}
        self.sessions: list[Session] = []
        self.holders: dict[str, Session] = {}
        self._lent: set[str] = set()
        self._legs = legs
        self._now = now
        self._most = most
        self._other = other

    def attach(self, link: Link) -> Session:
        """Take a new connection; what arrives on it goes to the session that is returned."""
        session = Session(link, self._on_message, self._on_down, self._now())
        if len(self.sessions) >= self._most:
            session.send(Refused(f"the yard has {self._most} connections already", False))
            link.close()
            return session
        self.sessions.append(session)
        return session

    def lend(self, name: str) -> None:
        """Have no driver hold this robot here; raises ``UsageError`` where there is no such robot."""
        if name not in self.gates:
            raise UsageError(f"no robot is named {name!r} in this yard; it has {_listed(self.gates)}")
        self._lent.add(name)

    def tell(
        self,
        name: str,
        t: float,
        values: Mapping[str, Value],
        samples: Mapping[str, tuple[float, ...]],
        picture: Callable[[], bytes] | None,
    ) -> None:
        """Tell who holds the robot ``name`` what it feels at ``t`` of the yard's time, and show what it sees if due."""
        session = self.holders.get(name)
        if session is None:
            return
        if session.link.is_busy:
            session.dropped += 1
            return
        if picture is not None and session.pictures.is_due(t):
            session.seq += 1
            session.send(Picture(session.seq, t, WIDTH, HEIGHT, picture()))
        felt = {**values, "estop.engaged": not session.has_motors}
        session.send(Sensors(t, felt, samples, self.gates[name].token or 0))

    def expire(self, t: float) -> None:
        """Halt the robots whose command has run out at ``t``."""
        for name, gate in self.gates.items():
            if gate.is_over(t):
                self._halt(name)

    def halt(self) -> None:
        """Halt every robot, and hold what was ordered so far for over."""
        for name in self.gates:
            self._halt(name)

    def drop_silent(self) -> None:
        """Close the connections on which nothing is heard any more."""
        now = self._now()
        for session in list(self.sessions):
            if now - session.heard_at > SILENT_S:
                self.log.warn("{robot}: nothing heard for {seconds} s", robot=session.robot or "?", seconds=SILENT_S)
                session.link.close()

    def close(self) -> None:
        """Close every connection."""
        for session in list(self.sessions):
            session.link.close()

    def _on_message(self, session: Session, message: Message) -> None:
        session.heard_at = self._now()
        match message:
            case Hello():
                self._on_hello(session, message)
            case Motors() | Halt() | Drive():
                if session.robot is not None:
                    self._on_command(session.robot, session, message)
            case _:
                self._other(session, message)

    def _on_hello(self, session: Session, hello: Hello) -> None:
        problem, is_lasting = "", True
        if hello.version != VERSION:
            problem = f"the yard speaks version {VERSION} and not {hello.version}; update one of them"
        elif hello.robot not in self.gates:
            problem = f"no robot is named {hello.robot!r} in this yard; it has {_listed(self.gates)}"
        elif hello.robot in self._lent:
            problem = f"{hello.robot} is reached as a robot of another kind here; correct the driver's kind"
        elif self.holders.get(hello.robot, session) is not session:
            problem, is_lasting = f"{hello.robot} is taken by another driver", False
        elif session.robot not in (None, hello.robot):
            problem = f"this connection holds {session.robot} already"
        if problem:
            session.send(Refused(problem, is_lasting))
            session.link.close()
            return
        session.robot = hello.robot
        session.pictures = Beat(min(max(hello.camera_fps, 0.0), MAX_FPS))
        self.holders[hello.robot] = session

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
                    self.gates[name].admit(Permit(message.token, deadline), now)
                except StaleCommand as error:
                    self.log.debug("{robot}: {error}", robot=name, error=error)
                    return
                self._legs.drive(name, message.vx, message.vy, message.wz)

    def _halt(self, name: str) -> None:
        self.gates[name].close()
        self._legs.halt(name)

    def _on_down(self, session: Session) -> None:
        if session in self.sessions:
            self.sessions.remove(session)
        if session.robot is not None and self.holders.get(session.robot) is session:
            del self.holders[session.robot]
            self._halt(session.robot)


def _listed(names: Iterable[str]) -> str:
    """The names, or the first and the last of many."""
    every = list(names)
    return ", ".join(every) if len(every) <= NAMED else f"{every[0]} to {every[-1]}"
