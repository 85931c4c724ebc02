"""The operator's client of the simulator: the true state of the world, and commands that change it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from twisted.internet.defer import Deferred, fail, succeed
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from drivers.errors import LinkLost, NoReply, UsageError
from drivers.link import Connector, Link, Reconnector
from drivers.reading import Value
from drivers.sim.codec import (
    VERSION,
    CommandResult,
    FrameReader,
    KeepAlive,
    SubscribeWorld,
    WorldCommand,
    WorldSnapshot,
    encode_message,
)
from drivers.sim.option import DEFAULT_PORT
from drivers.subscribers import Subscribers
from drivers.timer import Timer

REPLY_TIMEOUT_S = 2.0
KEEP_ALIVE_S = 0.5

Snapshot = Mapping[str, Any]
"""The true state: ``t``, ``walls`` (width, height), ``dogs`` (for each dog name, x, y, heading, moving, stripes),
``target`` (x, y, radius) or None, ``collisions``.
"""


class SimulatorClient:
    """A client that receives the state of the world ``rate`` times per second and can change it.

    The Deferred of a command fires with True when the simulator has executed the command. It fails with ``UsageError``
    if the simulator refuses the command, with ``LinkLost`` if no link is open, and with ``NoReply`` after
    ``REPLY_TIMEOUT_S``.
    """

    log = Logger()

    def __init__(
        self,
        connector: Connector,
        clock: IReactorTime,
        host: str = "127.0.0.1",
        port: int = DEFAULT_PORT,
        rate: float = 10.0,
    ) -> None:
        self._connector = connector
        self._clock = clock
        self._host = host
        self._port = port
        self._rate = rate
        self._reconnector: Reconnector | None = None
        self._link: Link | None = None
        self._reader = FrameReader()
        self._snapshot: Snapshot | None = None
        self._connecting: Deferred[Snapshot] | None = None
        self._keep_alive_timer = Timer(clock)
        self._subscribers = Subscribers[Snapshot]("the simulator", self.log)
        self._pending_commands: dict[int, tuple[Deferred[bool], Any]] = {}
        self._command_number = 0

    @property
    def snapshot(self) -> Snapshot | None:
        """The newest snapshot, None before the first and while the link is down."""
        return self._snapshot

    def connect(self) -> Deferred[Snapshot]:
        """Open the link and keep it open; fires with the first snapshot, whenever the simulator starts."""
        if self._reconnector is not None:
            return fail(UsageError("this client is already connected or connecting; do not call connect() again"))
        self._connecting = Deferred(lambda _: None)
        connecting = self._connecting
        self._reconnector = self._connector.connect(self._host, self._port, self)
        return connecting

    def disconnect(self) -> Deferred[None]:
        """Close the link; may be called twice."""
        reconnector, self._reconnector = self._reconnector, None
        connecting, self._connecting = self._connecting, None
        if connecting is not None:
            connecting.errback(LinkLost("disconnected before the first snapshot"))
        return succeed(None) if reconnector is None else reconnector.disconnect()

    def subscribe(self, callback: Callable[[Snapshot], None]) -> Callable[[], None]:
        """Call ``callback`` with each snapshot; return a function that ends the subscription."""
        return self._subscribers.add(callback)

    def place_target(self, x: float, y: float) -> Deferred[bool]:
        """Put the red target at this position, in metres from the lower left corner."""
        return self._send_command("place_target", float(x), float(y))

    def place_target_at_random(self) -> Deferred[bool]:
        """Put the red target at a free position, at clearly different distances from the dogs."""
        return self._send_command("place_target_at_random")

    def place_target_later(self, seconds: float) -> Deferred[bool]:
        """Put the red target at a free position after ``seconds`` of simulated time, unless it is moved earlier."""
        return self._send_command("place_target_later", float(seconds))

    def clear_target(self) -> Deferred[bool]:
        """Remove the red target."""
        return self._send_command("clear_target")

    def move_dog(self, name: str, x: float, y: float, heading: float) -> Deferred[bool]:
        """Move a dog to this position, with the heading in radians."""
        return self._send_command("move_dog", name, float(x), float(y), float(heading))

    def scatter(self, seed: int) -> Deferred[bool]:
        """Move all dogs to random free positions; the same seed gives the same positions."""
        return self._send_command("scatter", seed)

    def break_robot_link(self, name: str) -> Deferred[bool]:
        """Break the links to the emulated robot ``name`` (``sim.robots.emulated_robots``)."""
        return self._send_command("unplug", name)

    def restore_robot_link(self, name: str) -> Deferred[bool]:
        """Restore the links to the emulated robot ``name``."""
        return self._send_command("plug", name)

    def link_up(self, link: Link) -> None:
        """Request snapshots; called by the link."""
        self._link = link
        self._reader = FrameReader()
        link.send(encode_message(SubscribeWorld(VERSION, self._rate)))
        self._keep_alive()

    def link_down(self) -> None:
        """Drop the snapshot and fail pending commands; called by the link."""
        self._link = None
        self._snapshot = None
        self._keep_alive_timer.cancel()
        for number in list(self._pending_commands):
            self._finish_command(number, LinkLost("the link to the simulator was lost"))

    def data_received(self, data: bytes) -> None:
        """Process bytes from the simulator; called by the link."""
        for message in self._reader.read(data):
            if isinstance(message, WorldSnapshot):
                self._on_snapshot(message.snapshot)
            elif isinstance(message, CommandResult):
                self._finish_command(message.number, UsageError(message.problem) if message.problem else None)

    def _on_snapshot(self, snapshot: Snapshot) -> None:
        self._snapshot = snapshot
        connecting, self._connecting = self._connecting, None
        if connecting is not None:
            connecting.callback(snapshot)
        self._subscribers.notify(snapshot)

    def _keep_alive(self) -> None:
        if self._link is not None:
            self._link.send(encode_message(KeepAlive()))
            self._keep_alive_timer.set(KEEP_ALIVE_S, self._keep_alive)

    def _send_command(self, verb: str, *arguments: Value) -> Deferred[bool]:
        if self._link is None:
            return fail(LinkLost(f"the simulator at {self._host}:{self._port} is not connected; is it running?"))
        self._command_number += 1
        number = self._command_number
        done: Deferred[bool] = Deferred()
        late = NoReply(f"the simulator did not answer {verb} within {REPLY_TIMEOUT_S:g} s")
        self._pending_commands[number] = (
            done,
            self._clock.callLater(REPLY_TIMEOUT_S, self._finish_command, number, late),
        )
        self._link.send(encode_message(WorldCommand(number, verb, arguments)))
        return done

    def _finish_command(self, number: int, error: Exception | None) -> None:
        done, timer = self._pending_commands.pop(number, (None, None))
        if done is None or timer is None:
            return
        if timer.active():
            timer.cancel()
        if error is None:
            done.callback(True)
        else:
            done.errback(error)
