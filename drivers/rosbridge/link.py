"""Link: one standing WebSocket to rosbridge, over links that a ``Connector`` opens; it knows no message."""

from __future__ import annotations

from typing import Protocol

from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from drivers.base import heard_at
from drivers.link import Connector, Line, Link
from drivers.rosbridge.websocket import WebSocket
from drivers.timer import Timer

PING_S = 1.0
SILENCE_S = 3.0
"""A rosbridge that answers no ping for so long is gone, though its link stays up."""
FIRST_HOLD_S, LAST_HOLD_S = 0.5, 5.0
"""How long what speaks no rosbridge is left alone before it is called again."""


class Owner(Protocol):
    """Who is told."""

    def bridge_up(self) -> None:
        """Learn that rosbridge has answered."""

    def bridge_down(self) -> None:
        """Learn that it is gone; it is called again."""

    def bridge_said(self, payload: bytes) -> None:
        """Take one message."""


class Bridge:
    """A wish to be connected to the rosbridge at ``host`` and ``port``."""

    log = Logger()

    def __init__(
        self, owner: Owner, connector: Connector, clock: IReactorTime, host: str, port: int, path: str
    ) -> None:
        self.bytes = 0
        self.faults = 0
        self._owner = owner
        self._connector = connector
        self._clock = clock
        self._host, self._port, self._path = host, port, path
        self._line: Line | None = None
        self._link: Link | None = None
        self._socket = self._fresh()
        self._is_up = False
        self._heard_at = self._ping_at = 0.0
        self._hold_s = FIRST_HOLD_S
        self._is_held = False
        self._hold_until = 0.0
        self._timer = Timer(clock)
        self._told = ""

    @property
    def is_busy(self) -> bool:
        """Whether what was sent before has not left yet."""
        return self._link is not None and self._link.is_busy

    @property
    def link(self) -> Link | None:
        """The link by which there is a rosbridge now."""
        return self._link if self._is_up else None

    def framed(self, payload: bytes) -> bytes:
        """One message as it would be sent."""
        return self._socket.text(payload)

    def open(self) -> None:
        """Call, and call again whenever it is lost."""
        self._line = self._connector.call(self._host, self._port, self)

    def hang_up(self) -> Deferred[None]:
        """Say goodbye, and call no more."""
        if self._is_up and self._link is not None:
            self._link.send(self._socket.closing())
        self._is_up, self._is_held = False, True
        self._timer.cancel()
        return succeed(None) if self._line is None else self._line.hang_up()

    def send(self, payload: bytes) -> None:
        """Send one message; does nothing while there is no rosbridge."""
        if self._is_up and self._link is not None:
            self._link.send(self._socket.text(payload))

    # -- called by the line -----------------------------------------------------------------------------------------

    def link_up(self, link: Link) -> None:
        """Greet; not before the time where what spoke no rosbridge hung up by itself."""
        self._link = link
        self._is_held = True
        wait = self._hold_until - self._clock.seconds()
        if wait > 0:
            self._timer.set(wait, self._greet, link)
        else:
            self._greet(link)

    def link_down(self) -> None:
        """Forget the link."""
        self._link = None
        self._timer.cancel()
        self._sink()

    def received(self, data: bytes) -> None:
        """Take bytes."""
        self.bytes += len(data)
        socket, link, frames = self._socket, self._link, self._socket.frames
        if self._is_held:
            return  # a fault was told already, or we hung up; the link is closed soon
        messages, reply = socket.received(data)
        if socket.frames > frames or (socket.is_open and not self._is_up):
            # Bytes alone are no sign of life: they may belong to a frame whose length was spoilt.
            self._heard_at = self._clock.seconds()
        if reply and link is not None and not link.is_busy:
            link.send(reply)  # else it would pile up here: the other end sends pings, and takes no answers
        if socket.is_open and not self._is_up and not socket.fault:
            self._rise()
        for message in messages:
            if not self._is_up:
                return  # the owner hung up in between
            self._hold_s, self._told = FIRST_HOLD_S, ""
            self._owner.bridge_said(message)
        if socket.fault and not self._is_held:
            self._on_fault(socket.fault)

    def _fresh(self) -> WebSocket:
        return WebSocket(f"{self._host}:{self._port}", self._path)

    def _greet(self, link: Link) -> None:
        self._is_held = False
        self._socket = self._fresh()
        self._heard_at = self._clock.seconds()
        link.send(self._socket.opening())
        self._ping_later()

    def _ping_later(self) -> None:
        self._ping_at = self._clock.seconds() + PING_S
        self._timer.set(PING_S, self._on_time)

    def _on_time(self) -> None:
        self._heard_at = heard_at(self._heard_at, self._ping_at, self._clock.seconds())
        if self._clock.seconds() - self._heard_at > SILENCE_S:
            self._on_fault(f"nothing whole was heard for {SILENCE_S:g} s")
            return
        if self._is_up and self._link is not None:
            self._link.send(self._socket.ping())
        self._ping_later()

    def _on_fault(self, reason: str) -> None:
        """Leave the link as it is for a while, then close it, so that whoever speaks no rosbridge is not pestered."""
        self.faults += 1
        if reason != self._told:
            self.log.warn("rosbridge at {host}:{port}: {reason}", host=self._host, port=self._port, reason=reason)
        self._told = reason
        self._is_held = True
        self._timer.cancel()
        self._sink()
        if self._link is not None:
            self._timer.set(self._hold_s, self._link.close)
            self._hold_until = self._clock.seconds() + self._hold_s
            self._hold_s = min(2 * self._hold_s, LAST_HOLD_S)

    def _rise(self) -> None:
        self._is_up = True
        self._owner.bridge_up()

    def _sink(self) -> None:
        was_up, self._is_up = self._is_up, False
        if was_up:
            self._owner.bridge_down()
