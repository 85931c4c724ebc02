"""A persistent WebSocket connection to rosbridge, over links from a ``Connector``; it does not interpret messages."""

from __future__ import annotations

from typing import Protocol

from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from drivers.base import correct_last_data_time
from drivers.link import Connector, Link, Reconnector
from drivers.rosbridge.websocket import WebSocket
from drivers.timer import Timer

PING_S = 1.0
ANSWER_TIMEOUT_S = 3.0
"""Seconds without an answer to a ping after which rosbridge counts as gone, although its link is open."""
MIN_RETRY_S, MAX_RETRY_S = 0.5, 5.0
"""First and longest delay before a new attempt at a server that is not rosbridge."""


class BridgeOwner(Protocol):
    """Receives the messages and the state of a ``Bridge``."""

    def bridge_up(self) -> None:
        """Handle the first answer of rosbridge."""

    def bridge_down(self) -> None:
        """Handle the loss of rosbridge; the bridge reconnects."""

    def bridge_received(self, payload: bytes) -> None:
        """Process one message."""


class Bridge:
    """A connection to the rosbridge at ``host`` and ``port`` that is reopened whenever it is lost."""

    log = Logger()

    def __init__(
        self, owner: BridgeOwner, connector: Connector, clock: IReactorTime, host: str, port: int, path: str
    ) -> None:
        self.bytes = 0
        self.faults = 0
        self._owner = owner
        self._connector = connector
        self._clock = clock
        self._host, self._port, self._path = host, port, path
        self._reconnector: Reconnector | None = None
        self._link: Link | None = None
        self._socket = self._make_socket()
        self._is_up = False
        self._last_frame_at = self._next_ping_at = 0.0
        self._retry_s = MIN_RETRY_S
        self._ignores_data = False
        self._retry_at = 0.0
        self._timer = Timer(clock)
        self._logged_reason = ""

    @property
    def is_busy(self) -> bool:
        """Whether earlier data is still unsent."""
        return self._link is not None and self._link.is_busy

    @property
    def link(self) -> Link | None:
        """The link while rosbridge answers, else None."""
        return self._link if self._is_up else None

    def encode_frame(self, payload: bytes) -> bytes:
        """Return one message as a WebSocket frame."""
        return self._socket.encode_text(payload)

    def open(self) -> None:
        """Connect, and reconnect after each loss."""
        self._reconnector = self._connector.connect(self._host, self._port, self)

    def disconnect(self) -> Deferred[None]:
        """Close the WebSocket and stop reconnecting."""
        if self._is_up and self._link is not None:
            self._link.send(self._socket.encode_close())
        self._is_up, self._ignores_data = False, True
        self._timer.cancel()
        return succeed(None) if self._reconnector is None else self._reconnector.disconnect()

    def send(self, payload: bytes) -> None:
        """Send one message; does nothing if no rosbridge is connected."""
        if self._is_up and self._link is not None:
            self._link.send(self._socket.encode_text(payload))

    # -- called by the link -----------------------------------------------------------------------------------------

    def link_up(self, link: Link) -> None:
        """Start the handshake, after a delay if the server of the last attempt was not a rosbridge."""
        self._link = link
        self._ignores_data = True
        wait = self._retry_at - self._clock.seconds()
        if wait > 0:
            self._timer.set(wait, self._start_handshake, link)
        else:
            self._start_handshake(link)

    def link_down(self) -> None:
        """Handle the loss of the link."""
        self._link = None
        self._timer.cancel()
        self._on_down()

    def data_received(self, data: bytes) -> None:
        """Process received bytes."""
        self.bytes += len(data)
        socket, link, frames = self._socket, self._link, self._socket.frames
        if self._ignores_data:
            return  # after a fault or ``disconnect``; the link closes soon
        messages, reply = socket.receive_data(data)
        if socket.frames > frames or (socket.is_open and not self._is_up):
            # Only a complete frame shows that the server responds: bytes may belong to a frame with a corrupt length.
            self._last_frame_at = self._clock.seconds()
        if reply and link is not None and not link.is_busy:
            link.send(reply)  # dropped if busy; otherwise replies to a peer that does not read would accumulate
        if socket.is_open and not self._is_up and not socket.fault:
            self._on_up()
        for message in messages:
            if not self._is_up:
                return  # the caller closed the bridge
            self._retry_s, self._logged_reason = MIN_RETRY_S, ""
            self._owner.bridge_received(message)
        if socket.fault and not self._ignores_data:
            self._on_fault(socket.fault)

    def _make_socket(self) -> WebSocket:
        return WebSocket(f"{self._host}:{self._port}", self._path)

    def _start_handshake(self, link: Link) -> None:
        self._ignores_data = False
        self._socket = self._make_socket()
        self._last_frame_at = self._clock.seconds()
        link.send(self._socket.opening())
        self._schedule_ping()

    def _schedule_ping(self) -> None:
        self._next_ping_at = self._clock.seconds() + PING_S
        self._timer.set(PING_S, self._on_time)

    def _on_time(self) -> None:
        self._last_frame_at = correct_last_data_time(self._last_frame_at, self._next_ping_at, self._clock.seconds())
        if self._clock.seconds() - self._last_frame_at > ANSWER_TIMEOUT_S:
            self._on_fault(f"no complete frame for {ANSWER_TIMEOUT_S:g} s")
            return
        if self._is_up and self._link is not None:
            self._link.send(self._socket.encode_ping())
        self._schedule_ping()

    def _on_fault(self, reason: str) -> None:
        """Close the link after a delay, which limits the rate of attempts at a server that is not rosbridge."""
        self.faults += 1
        if reason != self._logged_reason:
            self.log.warn("rosbridge at {host}:{port}: {reason}", host=self._host, port=self._port, reason=reason)
        self._logged_reason = reason
        self._ignores_data = True
        self._timer.cancel()
        self._on_down()
        if self._link is not None:
            self._timer.set(self._retry_s, self._link.close)
            self._retry_at = self._clock.seconds() + self._retry_s
            self._retry_s = min(2 * self._retry_s, MAX_RETRY_S)

    def _on_up(self) -> None:
        self._is_up = True
        self._owner.bridge_up()

    def _on_down(self) -> None:
        was_up, self._is_up = self._is_up, False
        if was_up:
            self._owner.bridge_down()
