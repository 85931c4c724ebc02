"""Driver of robots with ROS 1 or 2, through rosbridge."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred, fail
from twisted.internet.interfaces import IReactorTime
from twisted.python.failure import Failure

from drivers.base import ENGAGED, BaseDriver
from drivers.deadman.supervisor import create_switch
from drivers.deadman.switch import DeadManSwitch, HaltCommand
from drivers.driver import Permit
from drivers.errors import BadFrame, LinkLost, NoReply, RobotError
from drivers.link import Connector, TcpConnector
from drivers.option import Manifest
from drivers.reading import Action, Description, Frame, Value
from drivers.rosbridge import codec
from drivers.rosbridge.codec import ServiceResponse, Status, TopicMessage, decode_message, encode_operation
from drivers.rosbridge.link import Bridge
from drivers.rosbridge.option import RATES_HZ, ROS_TYPES, SECTORS, Options, make_description, parse_options
from drivers.timer import Timer

MANIFEST = Manifest()

REPEAT_S = 0.1
"""Interval in seconds at which a velocity is repeated: most bases stop if they receive none."""
TYPE_TIMEOUT_S = 1.0
"""Seconds to wait for the type of the velocity topic."""
SERVICE_TIMEOUT_S = 5.0
MESSAGE_TTL_S = 2.0
"""Seconds for which the last message of a topic is valid; after that, its keys are omitted."""
TYPE_SERVICE = "/rosapi/topic_type"


class RosbridgeDriver(BaseDriver):
    """One robot.

    ROS defines no motor switch: ``enable`` and ``disable`` set a lock in this driver (``estop.engaged``) and call the
    service ``motor_service`` if that option is set. The driver repeats the velocity as long as the motion is in force,
    and then sends a zero velocity. When the link is lost, only the base itself can stop the robot: see docs/robots.
    """

    STALE_S = 0.5

    def __init__(
        self,
        options: Options | Mapping[str, object],
        connector: Connector,
        clock: IReactorTime,
        name: str = "the ROS robot",
        dead_man: DeadManSwitch | None = None,
    ) -> None:
        self._options = options if isinstance(options, Options) else parse_options(options)
        super().__init__(make_description(self._options), name, clock, dead_man)
        self._bridge = Bridge(self, connector, clock, self._options.host, self._options.port, self._options.path)
        self._sources = {topic: source for source, topic in self._options.topics.items()}
        self._sectors = {name: (math.radians(middle), math.radians(width)) for name, (middle, width) in SECTORS.items()}
        self._source_values: dict[str, tuple[float, dict[str, Value]]] = {}
        self._frame: Frame | None = None
        self._t_robot = 0.0
        self._has_motors = False
        self._is_stamped: bool | None = None
        self._was_stamped = False
        self._velocity = (0.0, 0.0, 0.0)
        self._repeat_timer, self._type_timer = Timer(clock), Timer(clock)
        self._calls: dict[str, tuple[Deferred[Mapping[str, Any]], Any]] = {}
        self._call_count = 0
        self._logged_warnings: set[str] = set()

    @property
    def camera_fps(self) -> float:
        """The requested frame rate in pictures per second."""
        return self._options.camera_fps if self._options.image_topic else 0.0

    def set_camera_fps(self, fps: float) -> None:
        """Set the frame rate in pictures per second; 0 stops."""
        self._options = replace(self._options, camera_fps=fps)
        if self._options.image_topic:
            self._subscribe("image", self._options.image_topic)

    def invoke(self, name: str, **arguments: float | str) -> Deferred[Mapping[str, Value]]:
        """Call the service of this skill; fires with the scalar values of its answer."""
        if name not in self._options.services:
            return super().invoke(name, **arguments)
        if not self._is_up:
            return fail(LinkLost(f"{self._name} is {self.state}; connect first, or wait for the link"))

        def scalars(values: Mapping[str, Any]) -> Mapping[str, Value]:
            return {key: value for key, value in values.items() if isinstance(value, (bool, int, float, str))}

        return self._call_service(self._options.services[name], **arguments).addCallback(scalars)

    def diagnostics(self) -> dict[str, float]:
        """The counters of every driver, each topic's ``age.SOURCE`` of the last message, and the link's ``faults``."""
        now = self._clock.seconds()
        ages = {f"age.{source}": now - at for source, (at, _) in self._source_values.items()}
        return {**super().diagnostics(), "bytes": self._bridge.bytes, "faults": self._bridge.faults, **ages}

    # -- to the robot -----------------------------------------------------------------------------------------------

    def _open(self) -> None:
        self._bridge.open()

    def _close(self) -> Deferred[None]:
        self._stop_repeating()
        self._fail_calls(LinkLost(f"{self._name}: disconnected"))
        return self._bridge.disconnect()

    def _power(self, on: bool) -> None:
        def switched(values: Mapping[str, Any]) -> None:
            if values.get("success") is True:
                self._has_motors = on
            else:
                self._warn_once(f"{self._options.motor_service} refused: {codec.shorten(values.get('message'), 200)}")

        if self._options.motor_service:
            self._call_service(self._options.motor_service, data=on).addCallbacks(switched, self._on_call_failed)
        else:
            self._has_motors = on

    def _drive(self, motion: Action, permit: Permit) -> Action:
        self._velocity = (motion["base.vx"], motion.get("base.vy", 0.0), motion["base.wz"])
        self._send_velocity()
        if not self._repeat_timer.is_set:
            self._repeat_timer.set(REPEAT_S, self._on_repeat)
        return motion

    def _halt(self) -> None:
        self._stop_repeating()
        self._send_velocity()

    def _on_repeat(self) -> None:
        if not self._is_motion_permitted:
            self.stop()
            return
        self._repeat_timer.set(REPEAT_S, self._on_repeat)
        if not self._bridge.is_busy:
            self._send_velocity()

    def _stop_repeating(self) -> None:
        self._velocity = (0.0, 0.0, 0.0)
        self._repeat_timer.cancel()

    def _make_halt_command(self) -> HaltCommand | None:
        link = self._bridge.link
        return (
            None if link is None else HaltCommand(self._bridge.encode_frame(self._encode_velocity(0.0, 0.0, 0.0)), link)
        )

    def _send_velocity(self) -> None:
        self._bridge.send(self._encode_velocity(*self._velocity))

    def _encode_velocity(self, vx: float, vy: float, wz: float) -> bytes:
        message = (codec.make_twist_stamped if self._is_stamped else codec.make_twist)(vx, vy, wz)
        return encode_operation("publish", topic=self._options.velocity_topic, msg=message)

    def _subscribe(self, source: str, topic: str) -> None:
        rate = self._options.camera_fps if source == "image" else RATES_HZ[source]
        if rate <= 0:
            self._bridge.send(encode_operation("unsubscribe", id=source, topic=topic))
            return
        self._bridge.send(
            encode_operation(
                "subscribe",
                id=source,
                topic=topic,
                type=self._options.convert_type_name(ROS_TYPES[source]),
                throttle_rate=round(1000 / rate),
                queue_length=1,
            )
        )

    def _call_service(self, service: str, **arguments: object) -> Deferred[Mapping[str, Any]]:
        self._call_count += 1
        number = f"call:{self._call_count}"
        answered: Deferred[Mapping[str, Any]] = Deferred()

        def late() -> None:
            del self._calls[number]
            answered.errback(NoReply(f"{service} did not answer within {SERVICE_TIMEOUT_S:g} s"))

        self._calls[number] = (answered, self._clock.callLater(SERVICE_TIMEOUT_S, late))
        self._bridge.send(encode_operation("call_service", id=number, service=service, args=arguments))
        return answered

    # -- from the robot ---------------------------------------------------------------------------------------------

    def bridge_up(self) -> None:
        """Subscribe, and determine the type of the velocity topic; called by the bridge."""
        for source, topic in self._options.topics.items():
            if source != "image" or self._options.camera_fps > 0:
                self._subscribe(source, topic)
        self._request_type()
        if self._options.velocity_type != "auto":
            self._start_with_type(self._options.velocity_type == "twist_stamped")

    def bridge_down(self) -> None:
        """Reset the motion, as the base should also do by itself; called by the bridge."""
        self._stop_repeating()
        self._type_timer.cancel()
        self._is_stamped = None
        self._t_robot = 0.0
        self._fail_calls(LinkLost(f"the link to {self._name} was lost"))
        self._down()

    def bridge_received(self, payload: bytes) -> None:
        """Process one message; called by the bridge."""
        self._counts["frames"] += 1
        try:
            self._on_message(decode_message(payload))
        except BadFrame as error:
            self._counts["bad_frames"] += 1
            self.log.debug("{robot}: {error}", robot=self._name, error=error)

    def _on_message(self, message: codec.Message) -> None:
        match message:
            case TopicMessage(topic, content):
                if topic in self._sources:
                    self._on_published(self._sources[topic], content)
            case ServiceResponse(number, values, is_done):
                self._on_answer(number, values, is_done)
            case Status(level, text):
                self._counts["refused"] += level == "error"
                if level in ("error", "warning"):
                    self._warn_once(f"rosbridge says: {text}")

    def _on_published(self, source: str, content: Mapping[str, Any]) -> None:
        values: dict[str, Value] = {}
        match source:
            case "odometry":
                values = codec.convert_odometry(content)
            case "scan":
                values = codec.convert_scan(content, self._sectors, math.radians(self._options.scan_turn))
            case "imu":
                values = codec.convert_imu(content)
            case "battery":
                values = codec.convert_battery(content, self._options.battery_full)
        stamp = codec.read_stamp(content)
        # Topics may arrive slightly out of order; a large step back means that the robot's clock was set.
        if stamp is not None and (stamp > self._t_robot or self._t_robot - stamp > 1.0):
            self._t_robot = stamp
        if source == "image":
            data, width, height = codec.decode_picture(content)
            self._counts["pictures"] += 1
            self._frame = Frame(self._counts["pictures"], width, height, data, self._t_robot)
        now = self._clock.seconds()
        self._source_values[source] = (now, values)
        if self._is_stamped is None:
            return  # not ready: the robot cannot be driven before the type is known
        seen: dict[str, Value] = {ENGAGED: not self._has_motors}
        for at, some in self._source_values.values():
            if now - at <= MESSAGE_TTL_S:
                seen.update(some)
        self._observed(seen, self._t_robot, frame=self._frame)

    def _on_answer(self, number: str, values: Mapping[str, Any], is_done: bool) -> None:
        if number not in self._calls:
            return  # too late
        answered, timer = self._calls.pop(number)
        timer.cancel()
        if is_done:
            answered.callback(values)
        else:
            answered.errback(RobotError(codec.shorten(values.get("error", values), 300)))

    # -- type of the velocity topic ---------------------------------------------------------------------------------

    def _request_type(self) -> None:
        call = self._call_service(TYPE_SERVICE, topic=self._options.velocity_topic)
        call.addCallbacks(self._on_type, lambda _: None)
        if self._options.velocity_type == "auto":
            self._type_timer.set(TYPE_TIMEOUT_S, self._on_no_type)

    def _on_type(self, values: Mapping[str, Any]) -> None:
        topic, found = self._options.velocity_topic, codec.shorten(values.get("type", ""), 100)
        known = {"Twist": False, "TwistStamped": True}.get(found.rpartition("/")[2])
        if self._is_stamped is not None:
            if known is not None and known is not self._is_stamped:
                self._on_other_type(known, found)
            return
        self._type_timer.cancel()
        if known is not None:
            self._start_with_type(known)
            return
        # The topic has no subscriber yet, or a different type; the base may still be starting.
        state = f"is {found}" if found else "has no subscriber"
        self._warn_once(f"{topic} {state}; is velocity_topic correct? Retrying")
        self._type_timer.set(TYPE_TIMEOUT_S, self._request_type)

    def _on_no_type(self) -> None:
        default = "TwistStamped" if self._was_stamped else "Twist"
        self._warn_once(
            f"rosapi does not report the type of the velocity topic; using {default}; to change it, set velocity_type"
        )
        self._start_with_type(self._was_stamped)

    def _on_other_type(self, is_stamped: bool, found: str) -> None:
        if self._options.velocity_type == "auto":
            self._advertise(is_stamped)  # the answer arrived late
            return
        wanted, topic = "twist_stamped" if is_stamped else "twist", self._options.velocity_topic
        self._warn_once(f'{topic} is {found}, so the robot would not move; write velocity_type = "{wanted}" or "auto"')

    def _start_with_type(self, is_stamped: bool) -> None:
        self._advertise(is_stamped)
        self._send_velocity()  # zero: an earlier velocity may still be in force
        self._up()

    def _advertise(self, is_stamped: bool) -> None:
        self._is_stamped = self._was_stamped = is_stamped
        name = self._options.convert_type_name("geometry_msgs/TwistStamped" if is_stamped else "geometry_msgs/Twist")
        self._bridge.send(encode_operation("advertise", topic=self._options.velocity_topic, type=name))
        if self._is_up:
            self._update_halt_command()

    def _fail_calls(self, error: Exception) -> None:
        self._type_timer.cancel()
        calls, self._calls = self._calls, {}
        for answered, timer in calls.values():
            timer.cancel()
            answered.errback(error)

    def _on_call_failed(self, failure: Failure) -> None:
        if not failure.check(LinkLost):
            self._warn_once(f"{self._options.motor_service}: {failure.getErrorMessage()[:200]}")

    def _warn_once(self, text: str) -> None:
        if text not in self._logged_warnings and len(self._logged_warnings) < 100:
            self._logged_warnings.add(text)
            self.log.warn("{robot}: {text}", robot=self._name, text=text)


def make_driver(
    options: Mapping[str, object], name: str, clock: IReactorTime, connector: Connector | None
) -> RosbridgeDriver:
    """Return a driver of the robot behind the rosbridge in ``options``."""
    if connector is not None:
        return RosbridgeDriver(parse_options(options), connector, clock, name)
    return RosbridgeDriver(parse_options(options), TcpConnector(says=True), clock, name, dead_man=create_switch(name))


def describe(options: Mapping[str, object], name: str) -> Description:
    """Return the description of the robot that ``options`` select."""
    return make_description(parse_options(options))
