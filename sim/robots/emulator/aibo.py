"""AiboServer: an emulated dog on real sockets; its ports open and close as those of the dog do."""

from __future__ import annotations

import random
from functools import partial
from typing import Any

from twisted.internet.defer import Deferred, gatherResults, maybeDeferred
from twisted.internet.protocol import DatagramProtocol

from drivers.aibo.option import checked
from drivers.link import TcpLinkFactory
from sim.robots.emulator.aibo_dog import AiboEmulator
from sim.robots.emulator.body import Body
from sim.robots.emulator.wire import Table, Wire


class AiboServer:
    """Serves ``dog`` on ``interface`` of ``reactor``, under the port numbers that the dog has."""

    def __init__(self, reactor: Any, dog: AiboEmulator, interface: str = "127.0.0.1") -> None:
        self.faults = dog.faults
        self._reactor = reactor
        self._dog = dog
        self._interface = interface
        self._open: dict[int, Any] = {}
        self._closing: list[Deferred[Any]] = []
        self._udp: Any = None
        dog.on_ports.add(self._sync)

    def start(self) -> None:
        """Switch the dog on and open what it serves from the start; raises ``CannotListenError`` for a taken port."""
        self._udp = self._reactor.listenUDP(self._dog.ports["camera"], _Camera(self._dog), self._interface, 65536)
        self._sync()
        self._dog.start()

    def stop(self) -> Deferred[None]:
        """Switch it off; fires when every port is free."""
        ports, self._udp = [*self._open.values(), self._udp], None
        self._dog.stop()
        closing = [maybeDeferred(port.stopListening) for port in ports]
        self._open.clear()
        return gatherResults([*closing, *self._closing]).addCallback(lambda _: None)

    def _sync(self) -> None:
        """Listen where the dog listens now, and nowhere else: a port with a client takes no second one."""
        if self._udp is None:
            return
        for number in self._dog.ports.values():
            listens = self._dog.listens(number)
            if listens and number not in self._open:
                factory = TcpLinkFactory(partial(self._dog.accept, number))
                self._open[number] = self._reactor.listenTCP(number, factory, interface=self._interface)
            elif not listens and number in self._open:
                closed = maybeDeferred(self._open.pop(number).stopListening)
                self._closing = [*(one for one in self._closing if not one.called), closed]


class _Camera(DatagramProtocol):
    noisy = False

    def __init__(self, dog: AiboEmulator) -> None:
        self._dog = dog

    def datagramReceived(self, datagram: bytes, addr: Any) -> None:
        self._dog.datagram(datagram, partial(self._answer, addr))

    def _answer(self, addr: Any, data: bytes) -> None:
        if self.transport is not None:
            self.transport.write(data, addr)


def serve(reactor: Any, body: Body, rng: random.Random, options: Table, dialect: str) -> Wire:
    """Return the wire of an AIBO; ``dialect`` is its Tekkotsu, "T4" or "T2"."""
    chosen = checked(options)
    dog = AiboEmulator(reactor, body, rng, dialect, dict(chosen.ports) | {"gains": 0})
    return AiboServer(reactor, dog, chosen.host)
