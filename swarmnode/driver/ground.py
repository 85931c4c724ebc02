"""Ground: what a command on a robot stands on: the clock, the links, the terminal; here those of this machine."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from twisted.internet.defer import Deferred, maybeDeferred
from twisted.python.failure import Failure

from swarmnode.driver.drive import Terminal


class Ground(Protocol):
    """Where a command meets the world."""

    @property
    def clock(self) -> Any:
        """The reactor, or a clock in its place."""

    def connector(self, is_moving: bool) -> tuple[Any, Callable[[], list[str]]]:
        """What opens the links of a driver (None: whatever it opens by itself), and what is wrong with them."""

    def terminal(self) -> Terminal:
        """The terminal; raises ``UsageError`` where there is none."""

    def run(self, work: Callable[[], Deferred[Any]], end: Callable[[], Any]) -> Any:
        """Run until ``work`` has fired, and return its value; ``end`` is called where somebody interrupts it."""


class RealGround:
    """This machine, on Twisted's reactor."""

    @property
    def clock(self) -> Any:
        """The reactor."""
        from twisted.internet import reactor  # importing it installs it

        return reactor

    def connector(self, is_moving: bool) -> tuple[Any, Callable[[], list[str]]]:
        """Links that tell why they are not open; who moves a robot gets those that its driver trusts its stop to."""
        if is_moving:
            return None, list
        from drivers.link import TcpConnector
        from drivers.serial import SerialConnector
        from swarmnode.driver.witness import WitnessedConnector

        witnessed = WitnessedConnector(TcpConnector(), SerialConnector())
        return witnessed, witnessed.problems

    def terminal(self) -> Terminal:
        """The terminal that this process runs in."""
        from swarmnode.driver.terminal import real_terminal

        return real_terminal(self.clock)

    def run(self, work: Callable[[], Deferred[Any]], end: Callable[[], Any]) -> Any:
        """Run the reactor until ``work`` has fired; Ctrl-C ends it in order, so that the robot stands."""
        reactor, told, interrupted = self.clock, list[Any](), list[bool]()

        def finish(value: Any) -> None:
            told.append(value)
            if not interrupted:
                reactor.stop()

        def begin() -> None:
            maybeDeferred(work).addBoth(finish)

        def on_shutdown() -> Any:
            # The reactor waits for what this returns: the robot stands and is let go before the process ends.
            if told:
                return None
            interrupted.append(True)
            return end()

        reactor.addSystemEventTrigger("before", "shutdown", on_shutdown)
        reactor.callWhenRunning(begin)
        reactor.run()
        value = told[0] if told else 1
        if isinstance(value, Failure):
            value.raiseException()
        return value
