"""The operator's client of the simulator: the true state of the world, and commands that change it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from twisted.internet.defer import Deferred, fail, succeed
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from drivers.errors import LinkLost, NoReply, UsageError
from drivers.link import Connector, Line, Link
from drivers.reading import Value
from drivers.sim.codec import VERSION, Alive, Done, FrameReader, Order, Overlook, Truth, encoded
from drivers.sim.option import DEFAULT_PORT
from drivers.subscribers import Subscribers
from drivers.timer import Timer

REPLY_S = 2.0
ALIVE_S = 0.5

Snapshot = Mapping[str, Any]
"""The true state: ``t``, ``walls`` (width, height), ``dogs`` (each name, x, y, heading, moving, stripes), ``target``
(x, y, radius) or None, ``collisions``.
"""


class YardOperator:
    """A client that receives the state of the world ``rate`` times per second and can change it.

    The Deferred of an order fires with True when the simulator has carried it out; it fails with ``UsageError`` if the
    simulator refuses it, with ``LinkLost`` without a link, with ``NoReply`` after ``REPLY_S``.
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
        self._line: Line | None = None
        self._link: Link | None = None
        self._reader = FrameReader()
        self._snapshot: Snapshot | None = None
        self._connecting: Deferred[Snapshot] | None = None
        self._alive = Timer(clock)
        self._seen = Subscribers[Snapshot]("the simulator", self.log)
        self._orders: dict[int, tuple[Deferred[bool], Any]] = {}
        self._number = 0

    @property
    def snapshot(self) -> Snapshot | None:
        """The newest snapshot, None before the first and while the link is down."""
        return self._snapshot

    def connect(self) -> Deferred[Snapshot]:
        """Open the link and keep it open; fires with the first snapshot, even if the simulator starts much later."""
        if self._line is not None:
            return fail(UsageError("this operator is already connected or connecting; use it as it is"))
        self._connecting = Deferred(lambda _: None)
        connecting = self._connecting
        self._line = self._connector.call(self._host, self._port, self)
        return connecting

    def disconnect(self) -> Deferred[None]:
        """Close the link; may be called twice."""
        line, self._line = self._line, None
        connecting, self._connecting = self._connecting, None
        if connecting is not None:
            connecting.errback(LinkLost("disconnected before the first snapshot"))
        return succeed(None) if line is None else line.hang_up()

    def subscribe(self, seen: Callable[[Snapshot], None]) -> Callable[[], None]:
        """Call ``seen`` with each snapshot; return a function that ends the subscription."""
        return self._seen.add(seen)

    def place_target(self, x: float, y: float) -> Deferred[bool]:
        """Put the red target at this place, in metres from the lower left corner."""
        return self._order("place_target", float(x), float(y))

    def place_target_at_random(self) -> Deferred[bool]:
        """Put the red target at a free place, at clearly different distances from the dogs."""
        return self._order("place_target_at_random")

    def place_target_later(self, seconds: float) -> Deferred[bool]:
        """Put the red target at a free place after ``seconds`` of simulated time, unless it is moved before."""
        return self._order("place_target_later", float(seconds))

    def clear_target(self) -> Deferred[bool]:
        """Remove the red target."""
        return self._order("clear_target")

    def move_dog(self, name: str, x: float, y: float, heading: float) -> Deferred[bool]:
        """Move a dog to this place, heading in radians."""
        return self._order("move_dog", name, float(x), float(y), float(heading))

    def scatter(self, seed: int) -> Deferred[bool]:
        """Move all dogs to random free places; the same seed gives the same places."""
        return self._order("scatter", seed)

    def unplug(self, name: str) -> Deferred[bool]:
        """Break the links to the emulated robot ``name`` (``sim.robots.table``)."""
        return self._order("unplug", name)

    def plug(self, name: str) -> Deferred[bool]:
        """Restore the links to the emulated robot ``name``."""
        return self._order("plug", name)

    def link_up(self, link: Link) -> None:
        """Request snapshots; called by the link."""
        self._link = link
        self._reader = FrameReader()
        link.send(encoded(Overlook(VERSION, self._rate)))
        self._keep_alive()

    def link_down(self) -> None:
        """Drop the snapshot and fail open orders; called by the link."""
        self._link = None
        self._snapshot = None
        self._alive.cancel()
        for number in list(self._orders):
            self._finish_order(number, LinkLost("the link to the simulator was lost"))

    def received(self, data: bytes) -> None:
        """Take bytes from the simulator; called by the link."""
        for message in self._reader.read(data):
            if isinstance(message, Truth):
                self._on_truth(message.snapshot)
            elif isinstance(message, Done):
                self._finish_order(message.number, UsageError(message.problem) if message.problem else None)

    def _on_truth(self, snapshot: Snapshot) -> None:
        self._snapshot = snapshot
        connecting, self._connecting = self._connecting, None
        if connecting is not None:
            connecting.callback(snapshot)
        self._seen.tell(snapshot)

    def _keep_alive(self) -> None:
        if self._link is not None:
            self._link.send(encoded(Alive()))
            self._alive.set(ALIVE_S, self._keep_alive)

    def _order(self, verb: str, *arguments: Value) -> Deferred[bool]:
        if self._link is None:
            return fail(LinkLost(f"no link to the simulator at {self._host}:{self._port}; is it running?"))
        self._number += 1
        number = self._number
        done: Deferred[bool] = Deferred()
        late = NoReply(f"the simulator did not answer {verb} within {REPLY_S:g} s")
        self._orders[number] = (done, self._clock.callLater(REPLY_S, self._finish_order, number, late))
        self._link.send(encoded(Order(number, verb, arguments)))
        return done

    def _finish_order(self, number: int, error: Exception | None) -> None:
        done, timer = self._orders.pop(number, (None, None))
        if done is None or timer is None:
            return
        if timer.active():
            timer.cancel()
        if error is None:
            done.callback(True)
        else:
            done.errback(error)
