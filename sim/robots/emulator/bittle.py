"""The robot's side of OpenCat, on a cable or behind its web server, for a simulated robot."""

from __future__ import annotations

import math
import random
import re
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import parse_qs, unquote_to_bytes, urlsplit

from twisted.internet.interfaces import IReactorTime

from drivers.bittle.codec import END_BYTES, END_TEXT
from drivers.bittle.gait import GAITS, Velocity
from drivers.bittle.option import BEHAVIOURS, POSTURES, parse_options
from drivers.link import Link
from drivers.reading import Value
from drivers.timer import Timer
from middleware.faults.stream import StreamFaults
from sim.robots.emulator.output import FaultyOutput
from sim.robots.emulator.simulated_robot import SimulatedRobot
from sim.robots.emulator.transport import EmulatorServer, PtyEmulatorServer, Table, TcpEmulatorServer

VERSIONS = {"biboard": "B10_250712", "nyboard": "N_250224"}
UNFINISHED_S = 0.01
"""Seconds after which a command without an end byte is executed."""
BOOT_S = 1.5
POSTURE_S, BEHAVIOUR_S = 0.1, 1.0
NYBOARD_S = 0.04
"""Seconds of output that the web server of a NyBoard returns."""
MAX_REQUEST_BYTES = 4096
MAX_TASKS = 50
"""Number of tasks that the board stores; a query for an older task is an error."""
FAR_DEGREES = 270
"""Limit of joint angles in degrees, to which the firmware clips commands."""
UNSUPPORTED_TOKENS = frozenset("csa!")
"""Tokens that change the robot permanently, which a driver never sends."""


class Bittle:
    """One dog; ``accept`` is its serial port, ``accept_http`` its web server.

    ``faults`` corrupts the dog's output; with ``resets``, opening the port restarts the board, as on most boards.
    ``received_commands`` are the received commands in order.
    """

    def __init__(
        self,
        robot: SimulatedRobot,
        clock: IReactorTime,
        rng: random.Random,
        board: str = "biboard",
        resets: bool = False,
        gaits: Mapping[str, Velocity] = GAITS,
    ) -> None:
        self.faults = StreamFaults()
        self.board = board
        self.received_commands: list[bytes] = []
        self.joints = [0] * 16
        self.tasks: dict[str, list[str]] = {}
        self.task_count = 0
        self.task_output: list[str] = []
        self.is_limp = True
        self.clock = clock
        self._robot = robot
        self._rng = rng
        self._resets = resets
        self._gaits = gaits
        self._output = FaultyOutput(clock, rng, self.faults)
        self._rest = bytearray()
        self._unfinished_timer, self._boot_timer, self._busy_timer = Timer(clock), Timer(clock), Timer(clock)
        self._queue: deque[tuple[bytes, Callable[[str], None]]] = deque()

    def accept(self, link: Link) -> Bittle:
        """Connect a cable."""
        self._output.link = link
        if self._resets:
            self.reboot()
        return self

    def accept_http(self, link: Link) -> BittlePage:
        """Accept a connection to the web server."""
        return BittlePage(self, link, self._rng)

    def data_received(self, data: bytes) -> None:
        """Process data from the cable."""
        if self._boot_timer.is_set:
            return
        self._rest += data
        self._unfinished_timer.cancel()
        while self._rest:
            end = END_BYTES if 65 <= self._rest[0] <= 90 else END_TEXT
            at = self._rest.find(end)
            if at < 0:
                self._unfinished_timer.set(UNFINISHED_S, self._on_unfinished)
                return
            command = bytes(self._rest[:at])
            del self._rest[: at + 1]
            self.execute(command, self._send_line)

    def link_down(self) -> None:
        """Disconnect the cable; a gait continues."""
        self._output.link = None

    def reboot(self) -> None:
        """Restart: lie down immediately, ignore data during ``BOOT_S``, then send the banner."""
        self.stop()
        self._rest.clear()
        self._queue.clear()
        self._boot_timer.set(BOOT_S, self._on_booted)

    def stop(self) -> None:
        """Stop, and cancel all timers."""
        self._robot.halt()
        self.is_limp = True
        for timer in (self._unfinished_timer, self._boot_timer, self._busy_timer):
            timer.cancel()

    def execute(self, command: bytes, say: Callable[[str], None]) -> None:
        """Execute a command after the queued commands; ``say`` gets each line of the answer."""
        if self._boot_timer.is_set:
            return
        self._queue.append((command, say))
        if not self._busy_timer.is_set:
            self._execute_next()

    def _on_unfinished(self) -> None:
        command = bytes(self._rest)
        self._rest.clear()
        self.execute(command, self._send_line)

    def _on_booted(self) -> None:
        for line in ("k", "* Start *", "Bittle", f"Software version: {VERSIONS[self.board]}"):
            self._send_line(line)

    def _send_line(self, line: str) -> None:
        self._output.send(line.encode() + b"\r\n")

    def _execute_next(self) -> None:
        while self._queue and not self._busy_timer.is_set:
            command, say = self._queue.popleft()
            if command:
                self.received_commands.append(command)
                self._execute_now(chr(command[0]), command[1:], say)

    def _finish_later(self, seconds: float, say: Callable[[str], None], *lines: str) -> None:
        def done() -> None:
            for line in lines:
                say(line)
            self._execute_next()

        self._busy_timer.set(seconds, done)

    def _execute_now(self, token: str, argument: bytes, say: Callable[[str], None]) -> None:
        answer: list[str] = []
        if token == "k":
            self._execute_skill(argument.decode("latin-1").strip(), say)
            return
        if token == "d":
            self._robot.halt()
            self.is_limp = True
            self._finish_later(POSTURE_S, say, "g", "d")
            return
        if token in "im":
            numbers = [int(one) for one in re.findall(rb"-?\d+", argument)]
            for joint, angle in zip(numbers[::2], numbers[1::2], strict=False):
                if 0 <= joint < 16:
                    self.joints[joint] = min(max(angle, -FAR_DEGREES), FAR_DEGREES)
        elif token in "IM":
            for joint, angle in zip(argument[::2], argument[1::2], strict=False):
                if joint < 16:
                    self.joints[joint] = angle - 256 if angle > 127 else angle
        elif token == "L" and len(argument) == 16:
            self.joints = [angle - 256 if angle > 127 else angle for angle in argument]
        elif token == "j":
            answer = self._format_joints()
        elif (token == "g" and argument == b"p") or (token == "v" and self.board == "nyboard"):
            answer = [self._format_attitude()]
        elif token == "P" and self.board == "biboard":
            level = float(self._robot.sense().get("power.level", 1.0))
            answer = [f"Voltage: {6.8 + 1.6 * level:.2f} V"]
        elif token == "X" and argument[:1] == b"U":
            distance = float(self._robot.sense().get("range.near", math.nan))
            answer = ["=", f"{min(200, distance * 100):.0f}" if math.isfinite(distance) else "0"]
        elif token == "?":
            answer = ["Bittle", f"Software version: {VERSIONS[self.board]}"]
        for line in (*answer, token):
            say(line)

    def _execute_skill(self, name: str, say: Callable[[str], None]) -> None:
        velocity = self._gaits.get(name)
        if velocity is not None:
            self.is_limp = False
            self._robot.drive(velocity.vx, 0.0, velocity.wz)
            say(name)
            say("k")
        elif name in POSTURES:
            self.is_limp = False
            self._robot.halt()
            self._finish_later(POSTURE_S, say, name, "k")
        elif name in BEHAVIOURS:
            self.is_limp = False
            self._robot.halt()
            self._finish_later(BEHAVIOUR_S, say, name, "k")
        else:
            say(f"?{name}?")
            say("k")

    def _format_joints(self) -> list[str]:
        numbers = "\t".join(str(one) for one in range(16))
        angles = "".join(f"{angle},\t" for angle in self.joints)
        return ["=", numbers, angles] if self.board == "biboard" else [f"={numbers}", angles]

    def _format_attitude(self) -> str:
        sensed = self._robot.sense()

        def degrees(key: str) -> float:
            value: Value = sensed.get(key, 0.0)
            return math.degrees(float(value))

        roll, pitch, yaw = degrees("imu.roll"), degrees("imu.pitch"), degrees("odom.yaw")
        if self.board == "nyboard":
            return f"{pitch:.5f}\t{roll:.5f}\t0.00000\t0.00000\t9.80000"
        return f"ICM:{0.0:6.1f}{0.0:6.1f}{9.8:6.1f}{yaw:6.1f}{pitch:6.1f}{roll:6.1f}"


class BittlePage:
    """One connection to the web server of a dog."""

    def __init__(self, robot: Bittle, link: Link, rng: random.Random) -> None:
        self._robot = robot
        self._link = link
        self._rng = rng
        self._data = b""

    def data_received(self, data: bytes) -> None:
        """Process a request."""
        self._data += data
        if b"\r\n\r\n" not in self._data:
            if len(self._data) > MAX_REQUEST_BYTES:
                self._link.close()
            return
        words, self._data = self._data.split(b" ", 2), b""
        try:
            url = urlsplit(words[1].decode("latin-1"))
        except (IndexError, ValueError):
            self._respond("400 Bad Request", "")
            return
        raw = url.query.partition("=")[2].partition("&")[0]
        if self._robot.board == "nyboard" and url.path == "/action":
            self._run_command(unquote_to_bytes(raw))
        elif self._robot.board == "biboard" and url.path == "/cmd" and raw:
            self._start_task(unquote_to_bytes(raw))
        elif self._robot.board == "biboard" and url.path == "/status":
            self._respond_status(parse_qs(url.query).get("taskId", [""])[0])
        else:
            self._respond(
                "400 Bad Request" if url.path == "/cmd" and self._robot.board == "biboard" else "404 Not Found", ""
            )

    def link_down(self) -> None:
        """Ignore the loss of the connection."""

    def _run_command(self, command: bytes) -> None:
        # Later output stays in the dongle until the next request.
        output = self._robot.task_output
        self._robot.execute(command.removesuffix(END_BYTES), output.append)
        self._robot.clock.callLater(NYBOARD_S, self._respond_output)

    def _respond_output(self) -> None:
        output = self._robot.task_output
        text = "\r\n".join([*output, ""])
        output.clear()
        self._respond("200 OK", text)

    def _start_task(self, command: bytes) -> None:
        tasks = self._robot.tasks
        number = str(1000 + self._robot.task_count)
        self._robot.task_count += 1
        lines: list[str] = []
        tasks[number] = lines
        if len(tasks) > MAX_TASKS:
            del tasks[next(iter(tasks))]
        token = chr(command[0])

        def say(line: str) -> None:
            lines.append(line)
            if line.lower() == token.lower():
                lines.append("")

        self._robot.execute(command.removesuffix(END_BYTES), say)
        self._respond("200 OK", f"TASK_ID:{number}")

    def _respond_status(self, number: str) -> None:
        lines = self._robot.tasks.get(number)
        if lines is None:
            self._respond("200 OK", "error\nERROR: Task not found")
        elif lines and not lines[-1]:
            self._respond("200 OK", "completed\n" + "\r\n".join(lines[:-1]))
        else:
            self._respond("200 OK", "running\n")

    def _respond(self, status: str, text: str) -> None:
        head = (
            f"HTTP/1.1 {status}\r\nContent-Type: text/plain\r\nContent-Length: {len(text)}\r\nConnection: close\r\n\r\n"
        )
        for piece in self._robot.faults.apply((head + text).encode(), self._rng):
            self._link.send(piece)


def serve(reactor: Any, robot: SimulatedRobot, rng: random.Random, options: Table, dialect: str) -> EmulatorServer:
    """Return the server of a Bittle: a pseudo-terminal, or HTTP."""
    args = parse_options(options)
    board = "biboard" if args.board == "auto" else args.board
    dog = Bittle(robot, reactor, rng, board=board, gaits=dict(args.gaits))
    if args.port:
        return PtyEmulatorServer(reactor, dog, args.port)
    return TcpEmulatorServer(reactor, dog, dog.accept_http, args.host, args.http_port)
