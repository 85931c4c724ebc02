"""Wires of emulators: a TCP port, or a pseudo-terminal in the place of a serial cable."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any, Protocol

from twisted.internet.defer import Deferred, maybeDeferred, succeed

from drivers.link import Accept, TcpLinkFactory
from middleware.faults.stream import StreamFaults
from sim.robots.emulator.body import Body
from sim.robots.emulator.pty import PtyPort

Table = Mapping[str, Any]


class Wire(Protocol):
    """One thing that a driver calls: a robot, or a part of one."""

    faults: StreamFaults

    def start(self) -> None:
        """Serve it; raises ``CannotListenError`` or ``OSError`` where its address is taken."""

    def stop(self) -> Deferred[None]:
        """Serve it no more; fires when the address is free."""


class Serve(Protocol):
    """The function ``serve`` of an emulator's module."""

    def __call__(self, reactor: Any, body: Body, rng: random.Random, options: Table, dialect: str) -> Wire:
        """Return the wire of a robot that moves ``body``, at the address that its driver's ``options`` name.

        Raises ``UsageError`` where the options name none.
        """


class TcpWire:
    """An emulator behind one TCP port; it is switched on and off with it."""

    def __init__(self, reactor: Any, emulator: Any, accept: Accept, host: str, port: int) -> None:
        self.faults = emulator.faults
        self._reactor = reactor
        self._emulator = emulator
        self._accept = accept
        self._address = (host, port)
        self._port: Any = None

    def start(self) -> None:
        """Listen, and switch the emulator on."""
        host, port = self._address
        self._port = self._reactor.listenTCP(port, TcpLinkFactory(self._accept), interface=host)
        _switch_on(self._emulator)

    def stop(self) -> Deferred[None]:
        """Switch the emulator off; fires when the port is free."""
        self._emulator.stop()
        return succeed(None) if self._port is None else maybeDeferred(self._port.stopListening)


class CableWire:
    """An emulator at the end of a cable: a pseudo-terminal whose path is the link ``path``."""

    def __init__(self, reactor: Any, emulator: Any, path: str) -> None:
        self.faults = emulator.faults
        self._reactor = reactor
        self._emulator = emulator
        self._path = path
        self._port: PtyPort | None = None

    def start(self) -> None:
        """Open the pseudo-terminal, and switch the emulator on."""
        self._port = PtyPort(self._reactor, self._emulator.accept, self._path)
        _switch_on(self._emulator)

    def stop(self) -> Deferred[None]:
        """Switch the emulator off and remove the pseudo-terminal."""
        self._emulator.stop()
        if self._port is not None:
            self._port.close()
        return succeed(None)


def _switch_on(emulator: Any) -> None:
    """Start what tells something by itself; other emulators live from the beginning."""
    getattr(emulator, "start", lambda: None)()
