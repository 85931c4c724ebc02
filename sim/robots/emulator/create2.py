"""The robot's side of the Open Interface, for a simulated robot."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping
from typing import Any

from twisted.internet.interfaces import IReactorTime

from drivers.create2 import codec
from drivers.create2.odometry import MM_PER_COUNT, WHEEL_BASE_MM
from drivers.create2.option import parse_options
from drivers.link import Link
from drivers.reading import Value
from drivers.timer import Timer
from middleware.faults.stream import StreamFaults
from sim.robots.emulator.output import FaultyOutput
from sim.robots.emulator.simulated_robot import SimulatedRobot
from sim.robots.emulator.transport import EmulatorServer, PtyEmulatorServer, Table

CAPACITY_MAH = 2696
BOOT_S = 1.0
BOOT_TEXT = b"bl-start\r\nSTR730\r\nbootloader id: #x47175347 6C7C0BFF\r\nr3_robot/tags/release-3.5.4\r\n"
LIGHT_REACH_M = 0.35
"""Range of the light bumpers in metres."""
DOCKING_SPEED_MPS = 0.1
OFF, PASSIVE, SAFE, FULL = range(4)


class Create2:
    """One robot; ``accept`` connects its serial port. Without a cable the robot keeps its motion, like a real robot.

    ``faults`` corrupts its output; ``reboot`` interrupts its power; ``left`` and ``right`` are its wheel encoders, in
    counts.
    """

    def __init__(self, robot: SimulatedRobot, clock: IReactorTime, rng: random.Random) -> None:
        self.faults = StreamFaults()
        self.mode = OFF
        self.left = self.right = 0.0
        self.played_songs: list[int] = []
        self._robot = robot
        self._output = FaultyOutput(clock, rng, self.faults)
        self._reader = codec.CommandReader()
        self._ids: tuple[int, ...] = ()
        self._is_streaming = False
        self._is_docking = False
        self._songs: set[int] = set()
        self._wheels = (0, 0)
        self._last_pose = self._read_pose()
        self._boot_timer, self._tick_timer = Timer(clock), Timer(clock)
        self._tick_timer.set(codec.FRAME_S, self._on_tick)

    def accept(self, link: Link) -> Create2:
        """Connect a cable."""
        self._output.link = link
        return self

    def data_received(self, data: bytes) -> None:
        """Process data from the cable."""
        if not self._boot_timer.is_set:
            for command in self._reader.read(data):
                self._on_command(command)

    def link_down(self) -> None:
        """Disconnect the cable."""
        self._output.link = None

    def reboot(self) -> None:
        """Interrupt the power: the robot stops, sends its boot text, is in mode off, and no longer streams."""
        self._halt()
        self.mode, self._ids, self._is_streaming = OFF, (), False
        self.left = self.right = 0.0
        self._reader = codec.CommandReader()
        self._boot_timer.set(BOOT_S, self._output.send, BOOT_TEXT)

    def stop(self) -> None:
        """Stop, and cancel all timers."""
        self._halt()
        self._tick_timer.cancel()
        self._boot_timer.cancel()

    def _on_command(self, command: codec.Command) -> None:
        if command.opcode == codec.RESET:
            self.reboot()
        elif command.opcode == codec.START:
            self._halt()
            self.mode = PASSIVE
        elif self.mode != OFF:
            self._on_interface(command)

    def _on_interface(self, command: codec.Command) -> None:
        match command.opcode:
            case 130 | codec.SAFE:
                self._halt()
                self.mode = SAFE
                self._check_safety(self._robot.sense())
            case codec.FULL:
                self._halt()
                self.mode = FULL
            case codec.STOP:
                self._halt()
                self.mode, self._is_streaming = OFF, False
            case codec.DOCK:
                self._halt()
                self.mode, self._is_docking = PASSIVE, True
                self._robot.drive(DOCKING_SPEED_MPS, 0.0, 0.0)
            case 133 | 134 | codec.CLEAN | 136:
                self._halt()
                self.mode = PASSIVE
            case codec.STREAM:
                self._ids = tuple(one for one in command.data[1:] if one in codec.PACKETS)
                self._is_streaming = bool(self._ids)
            case codec.PAUSE:
                self._is_streaming = bool(command.data[0]) and bool(self._ids)
            case codec.SENSORS:
                self._answer(command.data)
            case codec.QUERY:
                self._answer(command.data[1:])
            case codec.SONG:
                self._songs.add(command.data[0])
            case _ if self.mode in (SAFE, FULL):
                self._on_actuators(command)

    def _on_actuators(self, command: codec.Command) -> None:
        if command.opcode == codec.DIRECT:
            self._drive_wheels(*command.words)
        elif command.opcode == codec.DRIVE:
            velocity, radius = command.words
            if radius in (codec.STRAIGHT_RADIUS, 0x7FFF):
                self._drive_wheels(velocity, velocity)
            elif radius in (1, -1):
                self._drive_wheels(velocity * radius, -velocity * radius)
            elif radius:
                bend = WHEEL_BASE_MM / 2.0 / radius
                self._drive_wheels(round(velocity * (1.0 + bend)), round(velocity * (1.0 - bend)))
        elif command.opcode == codec.PLAY and command.data[0] in self._songs:
            self.played_songs.append(command.data[0])

    def _drive_wheels(self, right: int, left: int) -> None:
        top = codec.MAX_WHEEL_SPEED_MMPS
        right, left = (min(max(wheel, -top), top) for wheel in (right, left))
        self._wheels = (right, left)
        self._robot.drive((right + left) / 2000.0, 0.0, (right - left) / WHEEL_BASE_MM)
        self._check_safety(self._robot.sense())

    def _halt(self) -> None:
        self._wheels = (0, 0)
        self._is_docking = False
        self._robot.halt()

    def _answer(self, ids: bytes) -> None:
        known = [one for one in ids if one in codec.PACKETS or one in codec.GROUPS]
        packets = self._make_packets(self._robot.sense())
        self._output.send(b"".join(codec.encode_packet(one, packets) for one in known))

    def _on_tick(self) -> None:
        self._tick_timer.set(codec.FRAME_S, self._on_tick)
        self._update_encoders()
        sensed = self._robot.sense()
        self._check_safety(sensed)
        if self._is_docking and sensed.get("power.charging", False):
            self._halt()
        if self._is_streaming and not self._boot_timer.is_set:
            self._output.send(codec.encode_stream_frame(self._ids, self._make_packets(sensed)))

    def _check_safety(self, sensed: Mapping[str, Value]) -> None:
        """Leave safe mode for the reasons of the real robot: a cliff ahead, a lifted wheel, a charger."""
        if self.mode != SAFE:
            return
        ahead = sum(self._wheels) > 0
        ledge = any(sensed.get(f"cliff.{name}", False) for name in ("left", "front_left", "front_right", "right"))
        drop = any(sensed.get(f"wheeldrop.{name}", False) for name in ("left", "right"))
        if drop or (ledge and ahead) or sensed.get("power.charging", False):
            self._halt()
            self.mode = PASSIVE

    def _read_pose(self) -> tuple[float, float, float]:
        sensed = self._robot.sense()
        x, y, yaw = (float(sensed.get(key, 0.0)) for key in ("odom.x", "odom.y", "odom.yaw"))
        return x, y, yaw

    def _update_encoders(self) -> None:
        """Add the movement since the last tick to the encoders."""
        (old_x, old_y, old_yaw), self._last_pose = self._last_pose, self._read_pose()
        x, y, yaw = self._last_pose
        turn = math.remainder(yaw - old_yaw, math.tau)
        middle = old_yaw + turn / 2.0
        ahead = 1000.0 * ((x - old_x) * math.cos(middle) + (y - old_y) * math.sin(middle))
        self.left += (ahead - turn * WHEEL_BASE_MM / 2.0) / MM_PER_COUNT
        self.right += (ahead + turn * WHEEL_BASE_MM / 2.0) / MM_PER_COUNT

    def _make_packets(self, sensed: Mapping[str, Value]) -> dict[str, int]:
        def flag(key: str) -> int:
            return int(bool(sensed.get(key, False)))

        charging = flag("power.charging")
        packets = {
            "bumps": flag("bump.right")
            | flag("bump.left") << 1
            | flag("wheeldrop.right") << 2
            | flag("wheeldrop.left") << 3,
            "charging_state": 2 * charging,
            "charger": 2 * charging,
            "voltage": 15200,
            "current": 600 if charging else -300,
            "temperature": 25,
            "charge": round(CAPACITY_MAH * float(sensed.get("power.level", 1.0))),
            "capacity": CAPACITY_MAH,
            "mode": self.mode,
            "left_encoder": math.floor(self.left) & 0xFFFF,
            "right_encoder": math.floor(self.right) & 0xFFFF,
            "right_velocity": self._wheels[0],
            "left_velocity": self._wheels[1],
        }
        for name in ("left", "front_left", "front_right", "right"):
            packets[f"cliff_{name}"] = flag(f"cliff.{name}")
            packets[f"cliff_{name}_signal"] = 0 if flag(f"cliff.{name}") else 2500
        distance = float(sensed.get("range.near", math.nan))
        if distance < LIGHT_REACH_M:
            strength = round(4095 * (1.0 - max(distance, 0.0) / LIGHT_REACH_M))
            packets |= {"light_center_left": strength, "light_center_right": strength, "light_bumper": 0b001100}
        return packets


def serve(reactor: Any, robot: SimulatedRobot, rng: random.Random, options: Table, dialect: str) -> EmulatorServer:
    """Return the server of a Create 2, a pseudo-terminal."""
    return PtyEmulatorServer(reactor, Create2(robot, reactor, rng), parse_options(options).port)
