"""The dog's side of Tekkotsu's protocol, for a simulated robot.

The emulator serves main control and the emergency stop from the start, and each other port after its server is
selected. It accepts one client per port, starts with the motors off, and stops 3 s after the last walk command.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Any

from twisted.internet.interfaces import IReactorTime

from drivers.aibo import picture, sensors
from drivers.aibo.codec import T2, T4, CommandReader, LineReader, encode_gains, encode_state
from drivers.aibo.option import MAX_BACKWARD_MPS, MAX_FORWARD_MPS, MAX_STRAFE_MPS, MAX_TURN_RADPS, PORTS
from drivers.link import Link, MemoryConnector, Receiver
from drivers.timer import Timer
from middleware.entangled.listeners import Listeners
from middleware.faults.stream import StreamFaults
from sim.robots.emulator.aibo_menu import AiboMenu
from sim.robots.emulator.output import FaultyOutput
from sim.robots.emulator.simulated_robot import SimulatedRobot

FRAME_S = 0.032
CAMERA_S = 1.0 / 30.0
DEAD_MAN_S = 3.0
NATIVE_SIZE = (208, 160)
"""Native size of the camera picture; the default size is half of this width and height."""
DARK_JPEG = b"\xff\xd8\xff\xc0\x00\x0b\x08\x00\x50\x00\x68\x01\x01\x11\x00" + bytes(64) + b"\xff\xd9"
"""The picture of a simulated robot without a camera: the header of a JPEG of 104 x 80 pixels."""
EMULATED_PORTS = {**PORTS, "gains": 10032}


class AiboEmulator:
    """One emulated dog; ``accept`` receives its TCP links, ``on_datagram`` its UDP datagrams.

    ``on_ports`` is called when the listening ports may have changed, for a server on real sockets.
    """

    def __init__(
        self,
        clock: IReactorTime,
        robot: SimulatedRobot,
        rng: random.Random,
        dialect: str = T4,
        ports: dict[str, int] | None = None,
    ) -> None:
        self.faults = StreamFaults()
        self.ports = {**EMULATED_PORTS, **(ports or {})}
        self.on_ports = Listeners[[]]()
        self.is_engaged = True
        self.clients: dict[str, _Client] = {}
        self.menu = AiboMenu(self.ports, dialect == T2, self._on_server, self._on_setting)
        self.head = {"p": 0.0, "t": 0.0, "r": 0.0}
        self.received_commands: list[tuple[str, float]] = []
        """The newest walk commands, for tests."""
        self.start_ms = 0
        self._clock = clock
        self._robot = robot
        self._rng = rng
        self._dialect = dialect
        self._walk = {"f": 0.0, "s": 0.0, "r": 0.0}
        self._booted_at = clock.seconds()
        self._frame = self._picture = 0
        self._peer: Callable[[bytes], None] | None = None
        self._timers = {"state": Timer(clock), "camera": Timer(clock)}
        self._walk_timeout = Timer(clock)

    def start(self) -> None:
        """Switch the dog on."""
        self._repeat(FRAME_S, self._send_state, "state")
        self._repeat(CAMERA_S, self._send_picture, "camera")

    def stop(self) -> None:
        """Switch the dog off, which breaks all links."""
        for timer in self._timers.values():
            timer.cancel()
        self._stop_walk()
        self._peer = None
        for client in list(self.clients.values()):
            client.link.close()

    def reboot(self) -> None:
        """Restart: the motors are off, the servers are deselected, and the time starts at 0."""
        self.stop()
        self.menu.reset()
        self.is_engaged = True
        self._booted_at = self._clock.seconds()
        self._frame = self._picture = self.start_ms = 0
        self.on_ports()
        self.start()

    def press_back_button(self) -> None:
        """Press the back button twice, which toggles the emergency stop."""
        self._set_engaged(not self.is_engaged)

    def is_listening(self, port: int) -> bool:
        """Return whether a connection to this port would be accepted now."""
        return self._find_service(port) is not None

    def connector(self, delay: float = 0.0005) -> MemoryPorts:
        """Return a connector to this dog in memory."""
        return MemoryPorts(self._clock, self, delay)

    def accept(self, port: int, link: Link) -> Receiver:
        """Accept a link to ``port``; close it immediately if the port does not listen."""
        service = self._find_service(port)
        client = _Client(self, service or "", FaultyOutput(self._clock, self._rng, self.faults, link), link)
        if service is None:
            link.close()
            return client
        self.clients[service] = client
        if service == "main":
            self.menu.add_client()
        self.on_ports()
        return client

    def on_datagram(self, data: bytes, answer: Callable[[bytes], None]) -> None:
        """Process a datagram to the camera's port; ``answer`` sends one back."""
        if data == picture.REQUEST and self._is_udp and "camera" in self.menu.running and not self.faults.half_open:
            self._peer = answer

    # -- from the clients -------------------------------------------------------------------------------------------

    def on_bytes(self, client: _Client, data: bytes) -> None:
        """Process data of a client."""
        if self.faults.half_open:
            return
        match client.service:
            case "main":
                self._send(client, self.menu.make_answer(data))
            case "estop":
                for line in client.lines.read(data):
                    self._on_estop(client, line)
            case "walk":
                for letter, value in client.commands.read(data):
                    self._on_walk(letter, value)
            case "head":
                for letter, value in client.commands.read(data):
                    if letter in self.head:
                        self.head[letter] = max(-1.0, min(value, 1.0))

    def on_client_lost(self, client: _Client) -> None:
        """Handle the loss of a client: its port listens again, and the walk continues until the time-out."""
        if self.clients.get(client.service) is client:
            del self.clients[client.service]
            self.on_ports()

    def _on_estop(self, client: _Client, line: str) -> None:
        if line in ("start", "stop"):
            self._set_engaged(line == "stop")
        elif line == "refresh":
            self._send(client, b"on\n" if self.is_engaged else b"off\n")

    def _set_engaged(self, is_engaged: bool) -> None:
        if is_engaged == self.is_engaged:
            return
        self.is_engaged = is_engaged
        if is_engaged:
            self._stop_walk()
        client = self.clients.get("estop")
        if client is not None:
            self._send(client, b"on\n" if is_engaged else b"off\n")

    def _on_walk(self, letter: str, value: float) -> None:
        self.received_commands = [*self.received_commands[-99:], (letter, value)]
        if self.is_engaged or letter not in "fsr0":
            return
        if letter != "0":
            # Treat NaN and infinity as 0.
            self._walk[letter] = value if math.isfinite(value) else 0.0
        f, s, r = self._walk.values()
        self._robot.drive(f * (MAX_FORWARD_MPS if f > 0 else MAX_BACKWARD_MPS), s * MAX_STRAFE_MPS, r * MAX_TURN_RADPS)
        self._walk_timeout.cancel()
        if any(self._walk.values()):
            self._walk_timeout.set(DEAD_MAN_S, self._stop_walk)

    def _stop_walk(self) -> None:
        self._walk_timeout.cancel()
        self._walk = dict.fromkeys(self._walk, 0.0)
        self._robot.halt()

    # -- to the clients ---------------------------------------------------------------------------------------------

    def _send_state(self) -> None:
        self._frame += 4
        client, gains = self.clients.get("state"), self.clients.get("gains")
        if client is not None and not client.link.is_busy:
            self._send(
                client,
                encode_state(
                    sensors.make_state(self._robot.sense(), self._make_joints(), self._dialect, self._ms, self._frame)
                ),
            )
        if gains is not None and not gains.link.is_busy:
            self._send(gains, encode_gains(self._ms, ((10.0, 4.0, 2.0),) * 18))

    def _send_picture(self) -> None:
        client = self.clients.get("camera")
        if client is None and self._peer is None:
            return
        self._picture += 1
        data = self._encode_picture()
        if self._is_udp:
            if self._peer is not None:
                for piece in StreamFaults(self.faults.drop, self.faults.garbage, half_open=self.faults.half_open).apply(
                    data, self._rng
                ):
                    self._peer(piece)
        elif client is not None and not client.link.is_busy:
            self._send(client, data)

    def _encode_picture(self) -> bytes:
        is_halved = self.menu.settings.get("vision.rawcam.y_skip", "2") != "1"
        width, height = (side // 2 if is_halved else side for side in NATIVE_SIZE)
        head = picture.encode_header(picture.COLOUR, 1, width, height, self._ms, self._picture)
        jpeg = self._robot.picture(is_halved) or DARK_JPEG
        return head + picture.encode_block(picture.Block(width, height, "JPEGColor", jpeg))

    def _make_joints(self) -> list[float]:
        joints = [0.0] * len(sensors.JOINTS)
        for at, letter, (low, high) in ((12, "t", sensors.TILT), (13, "p", sensors.PAN), (14, "r", sensors.NOD)):
            value = self.head[letter]
            joints[at] = value * high if value > 0 else -value * low
        return joints

    def _send(self, client: _Client, data: bytes) -> None:
        if data:
            client.output.send(data)

    @property
    def _ms(self) -> int:
        return (self.start_ms + round((self._clock.seconds() - self._booted_at) * 1000.0)) % 2**32

    @property
    def _is_udp(self) -> bool:
        return self.menu.settings.get("vision.rawcam.transport", "UDP").upper() == "UDP"

    def _find_service(self, port: int) -> str | None:
        for service, number in self.ports.items():
            runs = service == "main" or ("state" if service == "gains" else service) in self.menu.running
            if number == port and runs and service not in self.clients and not (service == "camera" and self._is_udp):
                return service
        return None

    def _on_server(self, service: str, runs: bool) -> None:
        client = self.clients.get(service)
        if not runs and service == "camera":
            if self._peer is not None:
                self._peer(picture.CLOSING)
            elif client is not None:
                self._send(client, picture.CLOSING)
            self._peer = None
        if not runs and client is not None:
            client.link.close()
        if not runs and service == "walk":
            self._stop_walk()
        self.on_ports()

    def _on_setting(self, key: str, value: str) -> None:
        if key == "vision.rawcam.interval":
            wait_s = float(value) / 1000.0 if value.isdecimal() else 0.0
            # The dog sends the first frame of its camera after the wait.
            self._repeat(CAMERA_S * (int(wait_s / CAMERA_S) + 1), self._send_picture, "camera")
        elif key == "vision.rawcam.transport":
            self.on_ports()

    def _repeat(self, seconds: float, act: Callable[[], None], name: str) -> None:
        # Due times are computed from the start time, so delays do not accumulate.
        due = self._clock.seconds() + seconds

        def turn() -> None:
            nonlocal due
            now = self._clock.seconds()
            due = max(due + seconds, now)
            self._timers[name].set(due - now, turn)
            act()

        self._timers[name].set(seconds, turn)


class _Client:
    def __init__(self, dog: AiboEmulator, service: str, output: FaultyOutput, link: Link) -> None:
        self.service = service
        self.output = output
        self.link = link
        self.lines = LineReader()
        self.commands = CommandReader()
        self._dog = dog

    def data_received(self, data: bytes) -> None:
        self._dog.on_bytes(self, data)

    def link_down(self) -> None:
        self._dog.on_client_lost(self)


class MemoryPorts:
    """Opens links in memory to any port, or to none if ``is_open`` is False; ``cut`` breaks open links."""

    def __init__(self, clock: IReactorTime, dog: AiboEmulator, delay: float) -> None:
        self.is_open = True
        self._clock = clock
        self._dog = dog
        self._delay = delay
        self._ports: dict[int, _MemoryPort] = {}

    def connect(self, host: str, port: int, caller: Any) -> Any:
        """Keep ``caller`` connected, with back-off, until ``disconnect``."""
        if port not in self._ports:
            self._ports[port] = _MemoryPort(self._clock, self, port, self._delay)
        return self._ports[port].connect(host, port, caller)

    def cut(self, port: int | None = None) -> None:
        """Break the links to ``port``, or all links."""
        for number, one in self._ports.items():
            if port in (None, number):
                one.cut()

    def can_connect(self, port: int) -> bool:
        """Return whether a connection would be accepted."""
        return self.is_open and self._dog.is_listening(port)

    def accept(self, port: int, link: Link) -> Receiver:
        """Pass a link to the dog."""
        return self._dog.accept(port, link)


class _MemoryPort(MemoryConnector):
    def __init__(self, clock: IReactorTime, ports: MemoryPorts, port: int, delay: float) -> None:
        super().__init__(clock, lambda link: ports.accept(port, link), delay)
        self._is_accepting = lambda: ports.can_connect(port)

    def open_pair(self, caller: Receiver) -> Any:
        return super().open_pair(caller) if self._is_accepting() else None
