"""Transports of emulators: a TCP port, or a pseudo-terminal in place of a serial cable."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any, Protocol

from twisted.internet.defer import Deferred, maybeDeferred, succeed

from drivers.link import Accept, TcpLinkFactory
from middleware.faults.stream import StreamFaults
from sim.robots.emulator.pty import PtyPort
from sim.robots.emulator.simulated_robot import SimulatedRobot

Table = Mapping[str, Any]


class EmulatorServer(Protocol):
    """The server of one robot or part, to which a driver connects."""

    faults: StreamFaults

    def start(self) -> None:
        """Start to serve; raise ``CannotListenError`` or ``OSError`` if the address is in use."""

    def stop(self) -> Deferred[None]:
        """Stop; fires when the address is free."""


class ServeFunction(Protocol):
    """The function ``serve`` of an emulator's module."""

    def __call__(
        self, reactor: Any, robot: SimulatedRobot, rng: random.Random, options: Table, dialect: str
    ) -> EmulatorServer:
        """Return the server of a robot that moves ``robot``, at the address in its driver's ``options``.

        Raises ``UsageError`` if the options contain no address.
        """


class TcpEmulatorServer:
    """An emulator behind one TCP port; emulator and port start and stop together."""

    def __init__(self, reactor: Any, emulator: Any, accept: Accept, host: str, port: int) -> None:
        self.faults = emulator.faults
        self._reactor = reactor
        self._emulator = emulator
        self._accept = accept
        self._address = (host, port)
        self._port: Any = None

    def start(self) -> None:
        """Listen, and start the emulator."""
        host, port = self._address
        self._port = self._reactor.listenTCP(port, TcpLinkFactory(self._accept), interface=host)
        _start_emulator(self._emulator)

    def stop(self) -> Deferred[None]:
        """Stop the emulator; fires when the port is free."""
        self._emulator.stop()
        return succeed(None) if self._port is None else maybeDeferred(self._port.stopListening)


class PtyEmulatorServer:
    """An emulator on a cable: a pseudo-terminal at the symbolic link ``path``."""

    def __init__(self, reactor: Any, emulator: Any, path: str) -> None:
        self.faults = emulator.faults
        self._reactor = reactor
        self._emulator = emulator
        self._path = path
        self._port: PtyPort | None = None

    def start(self) -> None:
        """Open the pseudo-terminal, and start the emulator."""
        self._port = PtyPort(self._reactor, self._emulator.accept, self._path)
        _start_emulator(self._emulator)

    def stop(self) -> Deferred[None]:
        """Stop the emulator and remove the pseudo-terminal."""
        self._emulator.stop()
        if self._port is not None:
            self._port.close()
        return succeed(None)


def _start_emulator(emulator: Any) -> None:
    """Start an emulator that has a method ``start``; an emulator without it runs from its creation."""
    getattr(emulator, "start", lambda: None)()
