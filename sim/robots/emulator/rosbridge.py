"""The server side of rosbridge, with a base, a scanner, a battery and a camera."""

from __future__ import annotations

import base64
import json
import math
import random
from collections.abc import Iterator, Mapping
from random import Random
from typing import Any

from twisted.internet.interfaces import IReactorTime

from drivers.link import Link, Receiver
from drivers.reading import Value
from drivers.rosbridge.option import parse_options
from drivers.rosbridge.websocket import WebSocket
from drivers.timer import Timer
from middleware.faults.stream import StreamFaults
from sim.robots.emulator.output import FaultyOutput
from sim.robots.emulator.simulated_robot import SimulatedRobot
from sim.robots.emulator.transport import EmulatorServer, Table, TcpEmulatorServer

COMMAND_TIMEOUT_S = 0.5
"""Seconds without a velocity after which the base stops, like the bases of most robots."""
TICK_S = 0.02
TYPE_SERVICE = "/rosapi/topic_type"
BEAMS = 24
RANGE_MIN, RANGE_MAX = 0.05, 3.5
RANGER_BEARINGS = {"left": math.pi / 2, "right": -math.pi / 2, "back": math.pi}
"""Directions of a simulated robot's rangers by name; others point ahead."""
FLOOR_RANGER = "chest"
"""A ranger that points at the floor and is not part of the scan."""
TOPICS: Mapping[str, tuple[str, float]] = {
    "/odom": ("nav_msgs/Odometry", 25.0),
    "/scan": ("sensor_msgs/LaserScan", 5.0),
    "/imu": ("sensor_msgs/Imu", 25.0),
    "/battery_state": ("sensor_msgs/BatteryState", 1.0),
    "/camera/image_raw/compressed": ("sensor_msgs/CompressedImage", 12.5),
}
"""The published topics, with type and rate in Hz."""


class RosbridgeRobot:
    """One robot; ``accept`` is called by a listening port or a ``MemoryConnector``.

    ``velocity_type`` is the type of ``/cmd_vel``; messages of another type are silently ignored, as in ROS.
    ``has_rosapi`` enables the query of that type, which is answered after ``rosapi_s`` seconds; ``ignored_count``
    counts ignored messages.
    """

    def __init__(
        self,
        clock: IReactorTime,
        robot: SimulatedRobot,
        rng: Random,
        velocity_type: str = "geometry_msgs/msg/Twist",
    ) -> None:
        self.faults = StreamFaults()
        self.velocity_type = velocity_type
        self.has_rosapi = True
        self.rosapi_s = 0.0
        self.has_motor_power = True
        self.ignored_count = 0
        self.received_messages: list[dict[str, Any]] = []
        self._clock = clock
        self._robot = robot
        self._rng = rng
        self._clients: list[_Client] = []
        self._ticks = 0
        self._booted_at = clock.seconds()
        self._pending, self._stop_timer = Timer(clock), Timer(clock)

    def start(self) -> None:
        """Start to publish."""
        self._pending.set(TICK_S, self._on_tick)

    def stop(self) -> None:
        """Close all connections and stop."""
        self._close_clients()
        self._pending.cancel()

    def reboot(self) -> None:
        """Close all connections, stop the motion, and restart the clock at 0."""
        self._close_clients()
        self._booted_at = self._clock.seconds()
        self._ticks = 0

    def accept(self, link: Link) -> Receiver:
        """Accept a client, in addition to others."""
        client = _Client(self, FaultyOutput(self._clock, self._rng, self.faults, link))
        self._clients.append(client)
        return client

    # -- for its clients --------------------------------------------------------------------------------------------

    def call_service(self, client: _Client, name: str, arguments: Any, number: object) -> None:
        """Answer a service call after the service's delay."""

        def answer() -> None:
            is_done, values = self.run_service(name, arguments)
            response = {"op": "service_response", "service": name, "values": values, "result": is_done}
            client.send(response if number is None else {**response, "id": number})

        if name == TYPE_SERVICE and self.rosapi_s > 0:
            self._clock.callLater(self.rosapi_s, answer)
        else:
            answer()

    def remove_client(self, client: _Client) -> None:
        """Remove a client; the base is not notified."""
        if client in self._clients:
            self._clients.remove(client)

    def on_command(self, topic: str, kind: str, message: Mapping[str, Any]) -> None:
        """Process a message of type ``kind`` from a client."""
        if topic != "/cmd_vel" or kind.replace("/msg/", "/") != self.velocity_type.replace("/msg/", "/"):
            self.ignored_count += 1
            return
        twist = message.get("twist", {}) if kind.endswith("TwistStamped") else message
        try:
            linear, angular = twist["linear"], twist["angular"]
            vx, vy, wz = float(linear["x"]), float(linear.get("y", 0.0)), float(angular["z"])
        except (KeyError, TypeError, ValueError, AttributeError):
            self.ignored_count += 1
            return
        self._stop_timer.cancel()
        if not self.has_motor_power or not all(map(math.isfinite, (vx, vy, wz))):
            self._robot.halt()
            return
        self._robot.drive(vx, vy, wz)
        if vx or vy or wz:
            self._stop_timer.set(COMMAND_TIMEOUT_S, self._on_no_command)

    def run_service(self, name: str, arguments: Any) -> tuple[bool, Any]:
        """Run a service; return whether it succeeded, and the values of its answer."""
        if name == TYPE_SERVICE and self.has_rosapi:
            topic = str(arguments.get("topic")) if isinstance(arguments, dict) else ""
            if topic == "/cmd_vel":
                return True, {"type": self.velocity_type}
            return True, {"type": TOPICS[topic][0].replace("/", "/msg/") if topic in TOPICS else ""}
        if name == "/motor_power":
            self.has_motor_power = bool(isinstance(arguments, dict) and arguments.get("data"))
            if not self.has_motor_power:
                self._robot.halt()
            return True, {"success": True, "message": ""}
        if name == "/dock":
            return True, {"success": True, "message": "docked"}
        return False, f"Service {name} does not exist"

    def _close_clients(self) -> None:
        self._stop_timer.cancel()
        self._robot.halt()
        for client in list(self._clients):
            client.close()

    def _on_no_command(self) -> None:
        self._robot.halt()

    def _on_tick(self) -> None:
        self._pending.set(TICK_S, self._on_tick)
        self._ticks += 1
        for topic, (_, rate) in TOPICS.items():
            every = round(1 / rate / TICK_S)
            if self._ticks % every == 0 or (self._ticks == 1 and rate <= 1):
                subscribers = [client for client in self._clients if client.is_due(topic, self._clock.seconds())]
                if subscribers and (message := self._make_message(topic)) is not None:
                    for client in subscribers:
                        client.send({"op": "publish", "topic": topic, "msg": message})

    def _make_message(self, topic: str) -> dict[str, Any] | None:
        sensed = self._robot.sense()
        nanos = round((self._clock.seconds() - self._booted_at) * 1e9)
        header = {"stamp": {"sec": nanos // 10**9, "nanosec": nanos % 10**9}, "frame_id": topic[1:5]}
        match topic:
            case "/odom":
                return {"header": header, "child_frame_id": "base_footprint", **_make_odometry(sensed)}
            case "/scan":
                return {"header": header, **_make_scan(sensed)}
            case "/imu":
                acceleration = {
                    axis: _read_number(sensed.get(f"imu.a{axis}"), 9.8 if axis == "z" else 0.0) for axis in "xyz"
                }
                turn = {"x": 0.0, "y": 0.0, "z": _read_number(sensed.get("base.wz"))}
                attitude = _make_quaternion(_read_number(sensed.get("odom.yaw")))
                return {"header": header, "orientation": attitude, "orientation_covariance": [0.0] * 9} | {
                    "angular_velocity": turn,
                    "linear_acceleration": acceleration,
                }
            case "/battery_state":
                level = _read_number(sensed.get("power.level"), 1.0)
                volts = _read_number(sensed.get("power.volts"), 11.0 + 1.6 * level)
                # The current is not measured; real rosbridge sends NaN as null.
                return {"header": header, "voltage": volts, "current": None, "percentage": level} | {
                    "power_supply_status": 1 if sensed.get("power.charging") else 2,
                    "present": True,
                }
        jpeg = self._robot.picture()
        if jpeg is None:
            return None
        return {"header": header, "format": "bgr8; jpeg compressed bgr8", "data": base64.b64encode(jpeg).decode()}


class _Client:
    def __init__(self, robot: RosbridgeRobot, output: FaultyOutput) -> None:
        self.output = output
        self._robot = robot
        self._socket = WebSocket()
        self._topics: dict[str, dict[str, tuple[float, float]]] = {}
        self._types: dict[str, str] = {}

    def is_due(self, topic: str, now: float) -> bool:
        due = False
        for sid, (period, next_at) in self._topics.get(topic, {}).items():
            if now >= next_at - 1e-6:
                self._topics[topic][sid] = (period, now + period)
                due = True
        return due

    def send(self, message: Mapping[str, Any]) -> None:
        self.output.send(self._socket.encode_text(json.dumps(message).encode()))

    def data_received(self, data: bytes) -> None:
        if self._robot.faults.half_open:
            return
        messages, reply = self._socket.receive_data(data)
        if reply:
            self.output.send(reply)
        for message in messages:
            for answer in self._handle_payload(message):
                self.send(answer)
        if self._socket.fault:
            self.close()

    def close(self) -> None:
        if self.output.link is not None:
            self.output.link.close()

    def link_down(self) -> None:
        self.output.link = None
        self._robot.remove_client(self)

    def _handle_payload(self, payload: bytes) -> Iterator[dict[str, Any]]:
        try:
            operation = json.loads(payload)
            op = operation["op"]
        except (ValueError, KeyError, TypeError, RecursionError):
            yield {"op": "status", "level": "error", "msg": f"Unable to deserialize message: {payload[:60]!r}"}
            return
        self._robot.received_messages.append(operation)
        del self._robot.received_messages[:-1000]
        topic, sid = str(operation.get("topic", "")), str(operation.get("id", ""))
        match op:
            case "advertise":
                self._types[topic] = str(operation.get("type", ""))
            case "unadvertise":
                self._types.pop(topic, None)
            case "publish":
                message = operation.get("msg")
                self._robot.on_command(topic, self._types.get(topic, ""), message if isinstance(message, dict) else {})
            case "subscribe":
                period = _read_number(operation.get("throttle_rate")) / 1000
                self._topics.setdefault(topic, {})[sid] = (period, 0.0)
            case "unsubscribe":
                if sid:
                    self._topics.get(topic, {}).pop(sid, None)
                else:
                    self._topics.pop(topic, None)
            case "call_service":
                self._robot.call_service(
                    self, str(operation.get("service", "")), operation.get("args"), operation.get("id")
                )
            case "set_level" | "status" | "auth":
                pass
            case _:
                yield {"op": "status", "level": "error", "msg": f"Unknown operation: {str(op)[:40]}.  Ignoring it."}


def _make_odometry(sensed: Mapping[str, Value]) -> dict[str, Any]:
    place = {"x": _read_number(sensed.get("odom.x")), "y": _read_number(sensed.get("odom.y")), "z": 0.0}
    linear = {"x": _read_number(sensed.get("base.vx")), "y": _read_number(sensed.get("base.vy")), "z": 0.0}
    turn = {"x": 0.0, "y": 0.0, "z": _read_number(sensed.get("base.wz"))}
    pose = {"position": place, "orientation": _make_quaternion(_read_number(sensed.get("odom.yaw")))}
    unknown = [0.0] * 36
    return {
        "pose": {"pose": pose, "covariance": unknown},
        "twist": {"twist": {"linear": linear, "angular": turn}, "covariance": unknown},
    }


def _make_scan(sensed: Mapping[str, Value]) -> dict[str, Any]:
    beams = [math.inf] * BEAMS
    step = math.tau / BEAMS
    for key, value in sensed.items():
        name = key.removeprefix("range.")
        if name in (key, FLOOR_RANGER) or math.isnan(far := _read_number(value, math.nan)):
            continue
        place = round(RANGER_BEARINGS.get(name, 0.0) / step) % BEAMS
        beams[place] = min(beams[place], far)
    return {
        "angle_min": 0.0,
        "angle_max": step * (BEAMS - 1),
        "angle_increment": step,
        "time_increment": 0.0,
        "scan_time": 0.2,
        "range_min": RANGE_MIN,
        "range_max": RANGE_MAX,
        "ranges": [far if RANGE_MIN <= far <= RANGE_MAX else None for far in beams],
        "intensities": [],
    }


def _make_quaternion(yaw: float) -> dict[str, float]:
    return {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}


def _read_number(value: object, default: float = 0.0) -> float:
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else default


def serve(reactor: Any, simulated: SimulatedRobot, rng: random.Random, options: Table, dialect: str) -> EmulatorServer:
    """Return the server of a rosbridge."""
    args = parse_options(options)
    robot = RosbridgeRobot(reactor, simulated, rng)
    return TcpEmulatorServer(reactor, robot, robot.accept, args.host, args.port)
