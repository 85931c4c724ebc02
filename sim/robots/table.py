"""Robots: dogs of the yard that are reached as robots of other kinds are, each over its own wire.

A robot is given as the table that its driver gets (``kind``, ``options``, ``parts``): the yard serves what that driver
will call, at the same addresses.  ``dialect`` says of an "aibo" which Tekkotsu it has, "T4" or "T2".
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from twisted.internet.defer import Deferred, gatherResults, maybeDeferred
from twisted.internet.error import CannotListenError

from drivers.errors import UsageError
from drivers.link import Accept, TcpLinkFactory
from drivers.registry import describe
from middleware.faults.stream import StreamFaults
from sim.robots.emulator.body import Body
from sim.robots.emulator.pty import PtyPort
from sim.robots.world import NotPossible
from sim.robots.yard import Yard

DIALECTS = ("T4", "T2")
KEYS = ("kind", "options", "parts", "dialect")
Table = Mapping[str, Any]


class Wire(Protocol):
    """One thing that a driver calls: a robot, or a part of one."""

    faults: StreamFaults

    def start(self) -> None:
        """Serve it; raises ``CannotListenError`` or ``OSError`` where its address is taken."""

    def stop(self) -> Deferred[None]:
        """Serve it no more; fires when the address is free."""


class Robots:
    """What the robots of ``table`` (a dog's name to what its driver gets) are reached by.

    Raises ``UsageError`` where the yard has no such dog, or no emulator of such a robot.
    """

    def __init__(self, reactor: Any, rng: random.Random, yard: Yard, table: Mapping[str, Table]) -> None:
        self._wires: dict[str, list[Wire]] = {}
        for name, robot in table.items():
            (kind, options), *parts = _checked(name, robot)
            try:
                body = yard.lend(name, describe(kind, options, name, parts).limits)
                own = random.Random(rng.getrandbits(64))
                self._wires[name] = [_made(reactor, body, own, kind, options, str(robot.get("dialect", "T4")))]
                self._wires[name] += [_made(reactor, body, own, *part) for part in parts]
            except UsageError as error:
                raise UsageError(f"[{name}] {error}") from None
        yard.learn("unplug", self.unplug, (str,))
        yard.learn("plug", self.plug, (str,))

    def start(self) -> None:
        """Serve all of them; raises ``UsageError`` that names the robot whose address cannot be had."""
        for name, wires in self._wires.items():
            for wire in wires:
                try:
                    wire.start()
                except FileExistsError as error:
                    raise UsageError(
                        f"[{name}] {error.filename2} is there already; end what made it, or choose another port"
                    ) from None
                except (CannotListenError, OSError) as error:
                    raise UsageError(f"[{name}] it cannot be served: {error}; choose another address") from None

    def stop(self) -> Deferred[Any]:
        """Serve them no more; fires when every address is free."""
        return gatherResults([wire.stop() for wire in self._all])

    def unplug(self, name: str) -> None:
        """Break what leads to this robot: nothing is heard and nothing said, though no connection is closed."""
        self._set_silent(name, True)

    def plug(self, name: str) -> None:
        """Mend it."""
        self._set_silent(name, False)

    @property
    def _all(self) -> list[Wire]:
        return [wire for wires in self._wires.values() for wire in wires]

    def _set_silent(self, name: str, is_silent: bool) -> None:
        if name not in self._wires:
            raise NotPossible(f"{name!r} has no wire of its own; here are {', '.join(self._wires)}")
        for wire in self._wires[name]:
            wire.faults.half_open = is_silent


class _TcpWire:
    """An emulator behind one TCP port; ``begin`` and ``end`` switch it on and off."""

    def __init__(
        self, reactor: Any, emulator: Any, accept: Accept, host: str, port: int, has_switch: bool = True
    ) -> None:
        self.faults = emulator.faults
        self._reactor = reactor
        self._emulator = emulator
        self._accept = accept
        self._address = (host, port)
        self._has_switch = has_switch
        self._port: Any = None

    def start(self) -> None:
        host, port = self._address
        self._port = self._reactor.listenTCP(port, TcpLinkFactory(self._accept), interface=host)
        if self._has_switch:
            self._emulator.start()

    def stop(self) -> Deferred[None]:
        self._emulator.stop()
        return maybeDeferred(self._port.stopListening) if self._port is not None else maybeDeferred(lambda: None)


class _CableWire:
    """An emulator at the end of a cable: a pseudo-terminal whose path is the link ``path``."""

    def __init__(self, reactor: Any, emulator: Any, path: str, has_switch: bool = False) -> None:
        self.faults = emulator.faults
        self._reactor = reactor
        self._emulator = emulator
        self._path = path
        self._has_switch = has_switch
        self._port: PtyPort | None = None

    def start(self) -> None:
        self._port = PtyPort(self._reactor, self._emulator.accept, self._path)
        if self._has_switch:
            self._emulator.start()

    def stop(self) -> Deferred[None]:
        self._emulator.stop()
        if self._port is not None:
            self._port.close()
        return maybeDeferred(lambda: None)


def _checked(name: str, robot: Any) -> list[tuple[str, Table]]:
    """Kind and options of the robot and of each of its parts; raises ``UsageError`` where ``robot`` has others."""
    if not isinstance(robot, Mapping) or not isinstance(robot.get("kind"), str):
        raise UsageError(f'[{name}] must name a kind, as in kind = "aibo"')
    for key in robot:
        if key not in KEYS:
            raise UsageError(f"[{name}] has an unknown key {key!r}; known are {', '.join(KEYS)}")
    parts = robot.get("parts", [])
    if not isinstance(parts, list) or not all(isinstance(one, Mapping) and "kind" in one for one in parts):
        raise UsageError(f'[{name}] parts must be tables with a kind, as in [[{name}.parts]] kind = "compass"')
    for one in (robot, *parts):
        if not isinstance(one.get("options", {}), Mapping):
            raise UsageError(f'[{name}] options must be a table, as in options = {{host = "127.0.0.1"}}')
    return [(str(one["kind"]), one.get("options", {})) for one in (robot, *parts)]


def _made(reactor: Any, body: Body, rng: random.Random, kind: str, options: Table, dialect: str = "T4") -> Wire:
    make = _KINDS.get(kind)
    if make is None:
        raise UsageError(f"the yard has no robot of kind {kind!r}; it has {', '.join(sorted(_KINDS))}")
    if dialect not in DIALECTS:
        raise UsageError(f"dialect is {dialect!r}, but must be one of {', '.join(DIALECTS)}")
    return make(reactor, body, rng, options, dialect)


# Each loads what it needs: a yard of dogs alone does not carry the others.


def _aibo(reactor: Any, body: Body, rng: random.Random, options: Table, dialect: str) -> Wire:
    from drivers.aibo.option import checked
    from sim.robots.emulator.aibo import AiboEmulator
    from sim.robots.emulator.aibo_server import AiboServer

    chosen = checked(options)
    dog = AiboEmulator(reactor, body, rng, dialect, dict(chosen.ports) | {"gains": 0})
    return AiboServer(reactor, dog, chosen.host)


def _create2(reactor: Any, body: Body, rng: random.Random, options: Table, _: str) -> Wire:
    from drivers.create2.option import checked
    from sim.robots.emulator.create2 import Create2

    return _CableWire(reactor, Create2(body, reactor, rng), checked(options).port)


def _bittle(reactor: Any, body: Body, rng: random.Random, options: Table, _: str) -> Wire:
    from drivers.bittle.option import checked
    from sim.robots.emulator.bittle import Bittle

    chosen = checked(options)
    board = "biboard" if chosen.board == "auto" else chosen.board
    dog = Bittle(body, reactor, rng, board=board, gaits=dict(chosen.gaits))
    if chosen.port:
        return _CableWire(reactor, dog, chosen.port)
    return _TcpWire(reactor, dog, dog.accept_http, chosen.host, chosen.http_port, False)


def _rosbridge(reactor: Any, body: Body, rng: random.Random, options: Table, _: str) -> Wire:
    from drivers.rosbridge.option import checked
    from sim.robots.emulator.rosbridge import RosbridgeRobot

    chosen = checked(options)
    robot = RosbridgeRobot(reactor, body, rng)
    return _TcpWire(reactor, robot, robot.accept, chosen.host, chosen.port)


def _camera(reactor: Any, body: Body, rng: random.Random, options: Table, _: str) -> Wire:
    from drivers.camera.option import checked, place_of
    from sim.robots.emulator.mjpeg import MjpegCamera

    chosen = checked(options)
    if not chosen.url:
        raise UsageError('a camera of the yard needs the option url, as in url = "http://127.0.0.1:8081/"')
    place = place_of(chosen.url)
    camera = MjpegCamera(reactor, body, float(options.get("fps", 15.0)))
    return _TcpWire(reactor, camera, camera.accept, place.host, place.port)


def _compass(reactor: Any, body: Body, rng: random.Random, options: Table, _: str) -> Wire:
    from drivers.compass.option import checked
    from sim.robots.emulator.nmea import NmeaCompass

    chosen = checked(options)
    compass = NmeaCompass(reactor, body)
    if chosen.device:
        return _CableWire(reactor, compass, chosen.device, True)
    return _TcpWire(reactor, compass, compass.accept, chosen.host, chosen.port)


_KINDS: dict[str, Callable[[Any, Body, random.Random, Table, str], Wire]] = {
    "aibo": _aibo,
    "bittle": _bittle,
    "camera": _camera,
    "compass": _compass,
    "create2": _create2,
    "rosbridge": _rosbridge,
}
