"""An emulated AIBO on real sockets; its ports open and close like the real dog's."""

from __future__ import annotations

import random
from functools import partial
from typing import Any

from twisted.internet.defer import Deferred, gatherResults, maybeDeferred
from twisted.internet.error import CannotListenError
from twisted.internet.protocol import DatagramProtocol

from drivers.aibo.option import parse_options
from drivers.link import TcpLinkFactory
from sim.robots.emulator.aibo_dog import AiboEmulator
from sim.robots.emulator.simulated_robot import SimulatedRobot
from sim.robots.emulator.transport import EmulatorServer, Table

RETRY_S = 0.1
"""Seconds until the next attempt to open a port that another program uses temporarily."""


class AiboServer:
    """Serves ``dog`` on ``interface`` of ``reactor``, under the dog's port numbers."""

    def __init__(self, reactor: Any, dog: AiboEmulator, interface: str = "127.0.0.1") -> None:
        self.faults = dog.faults
        self._reactor = reactor
        self._dog = dog
        self._interface = interface
        self._open: dict[int, Any] = {}
        self._closing: dict[int, Deferred[Any]] = {}
        self._retry: Any = None
        self._udp: Any = None
        dog.on_ports.add(self._update_ports)

    def start(self) -> None:
        """Start the dog and open its initial ports; raise ``CannotListenError`` if a port is in use."""
        self._udp = self._reactor.listenUDP(self._dog.ports["camera"], _Camera(self._dog), self._interface, 65536)
        for number in self._dog.ports.values():
            if self._dog.is_listening(number):
                self._listen(number)
        self._dog.start()

    def stop(self) -> Deferred[None]:
        """Stop the dog; fires when every port is free."""
        ports, self._udp = [*self._open.values(), self._udp], None
        self._dog.stop()
        self._open.clear()
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None
        closing = [maybeDeferred(port.stopListening) for port in ports]
        return gatherResults([*closing, *self._closing.values()]).addCallback(lambda _: None)

    def _listen(self, number: int) -> None:
        factory = TcpLinkFactory(partial(self._dog.accept, number))
        self._open[number] = self._reactor.listenTCP(number, factory, interface=self._interface)

    def _update_ports(self) -> None:
        """Open and close ports to match the dog's state: a port with a client accepts no second client.

        The dog calls this method while a link opens or closes, so the method does not raise: a port that is still
        closing, or that another program uses, is opened later.
        """
        if self._udp is None:
            return
        for number in self._dog.ports.values():
            listens = self._dog.is_listening(number)
            if not listens and number in self._open:
                closed = self._closing[number] = maybeDeferred(self._open.pop(number).stopListening)
                closed.addCallback(self._on_closed, number)
            elif listens and number not in self._open and number not in self._closing:
                try:
                    self._listen(number)
                except CannotListenError:
                    if self._retry is None:
                        self._retry = self._reactor.callLater(RETRY_S, self._on_retry)

    def _on_closed(self, _result: object, number: int) -> None:
        del self._closing[number]
        self._update_ports()

    def _on_retry(self) -> None:
        self._retry = None
        self._update_ports()


class _Camera(DatagramProtocol):
    noisy = False

    def __init__(self, dog: AiboEmulator) -> None:
        self._dog = dog

    def datagramReceived(self, datagram: bytes, addr: Any) -> None:
        self._dog.on_datagram(datagram, partial(self._answer, addr))

    def _answer(self, addr: Any, data: bytes) -> None:
        if self.transport is not None:
            self.transport.write(data, addr)


def serve(reactor: Any, robot: SimulatedRobot, rng: random.Random, options: Table, dialect: str) -> EmulatorServer:
    """Return the server of an AIBO; ``dialect`` is its version of Tekkotsu, "T4" or "T2"."""
    args = parse_options(options)
    dog = AiboEmulator(reactor, robot, rng, dialect, dict(args.ports) | {"gains": 0})
    return AiboServer(reactor, dog, args.host)
