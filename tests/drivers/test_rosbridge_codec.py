"""Tests of ``drivers.rosbridge.codec``."""

from __future__ import annotations

import base64
import json
import math
from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from drivers.errors import BadFrame
from drivers.rosbridge import codec
from drivers.rosbridge.codec import ServiceResponse, Status, TopicMessage, decode_message, encode_operation

JPEG = b"\xff\xd8\xff\xc0\x00\x0b\x08\x00\x60\x00\x80\x01\x11\x00\x00\xff\xd9"
STILL = {"linear": {"x": 0, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": 0}}
ODOMETRY: dict[str, Any] = {
    "header": {"stamp": {"sec": 12, "nanosec": 500_000_000}, "frame_id": "odom"},
    "pose": {"pose": {"position": {"x": 1, "y": -2.5, "z": 0}, "orientation": {"x": 0, "y": 0, "z": 1, "w": 0}}},
    "twist": {"twist": {"linear": {"x": 0.1, "y": 0, "z": 0}, "angular": {"x": 0, "y": 0, "z": -0.5}}},
}
SCAN: dict[str, Any] = {
    "angle_min": -math.pi / 2,
    "angle_increment": math.pi / 4,
    "range_min": 0.1,
    "range_max": 3.0,
    "ranges": [1.0, None, 0.5, 0.0, 9.0],
}
SECTORS = {"right": (-math.pi / 2, 0.1), "front": (0.0, math.pi / 2 + 0.1), "left": (math.pi / 2, 0.1)}
ANY = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=12,
)


def spoilt(message: Any, path: tuple[Any, ...], value: Any) -> Any:
    """Return a copy of ``message`` with a different value at ``path``."""
    copy = json.loads(json.dumps(message))
    at = copy
    for step in path[:-1]:
        at = at[step]
    at[path[-1]] = value
    return copy


def paths(message: Any, start: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    steps = message.items() if isinstance(message, dict) else enumerate(message) if isinstance(message, list) else ()
    return [path for key, value in steps for path in ((*start, key), *paths(value, (*start, key)))]


class SayingTests(SynchronousTestCase):
    """Operations sent to rosbridge have the expected bytes."""

    def test_writes_the_operations_of_the_protocol(self) -> None:
        """Advertise, publish, subscribe and call_service are encoded as in ROSBRIDGE_PROTOCOL.md."""
        vectors = (
            (
                encode_operation("advertise", topic="/cmd_vel", type="geometry_msgs/Twist"),
                b'{"op":"advertise","topic":"/cmd_vel","type":"geometry_msgs/Twist"}',
            ),
            (
                encode_operation("publish", topic="/cmd_vel", msg=codec.make_twist(0.1, 0.0, -0.5)),
                b'{"op":"publish","topic":"/cmd_vel","msg":{"linear":{"x":0.1,"y":0.0,"z":0.0},'
                b'"angular":{"x":0.0,"y":0.0,"z":-0.5}}}',
            ),
            (
                encode_operation("publish", topic="/cmd_vel", msg=codec.make_twist_stamped(0.1, 0.0, 0.0)),
                b'{"op":"publish","topic":"/cmd_vel","msg":{"header":{"stamp":{"sec":0,"nanosec":0},'
                b'"frame_id":"base_link"},"twist":{"linear":{"x":0.1,"y":0.0,"z":0.0},'
                b'"angular":{"x":0.0,"y":0.0,"z":0.0}}}}',
            ),
            (
                encode_operation(
                    "subscribe", topic="/odom", type="nav_msgs/Odometry", throttle_rate=50, queue_length=1
                ),
                b'{"op":"subscribe","topic":"/odom","type":"nav_msgs/Odometry","throttle_rate":50,"queue_length":1}',
            ),
            (
                encode_operation("call_service", id="1", service="/rosapi/topic_type", args={"topic": "/cmd_vel"}),
                b'{"op":"call_service","id":"1","service":"/rosapi/topic_type","args":{"topic":"/cmd_vel"}}',
            ),
        )
        for said, wanted in vectors:
            self.assertEqual(said, wanted)

    def test_never_says_what_is_no_number(self) -> None:
        """NaN and infinity, which JSON lacks, raise ValueError."""
        self.assertRaises(ValueError, encode_operation, "publish", msg=codec.make_twist(math.nan, 0.0, 0.0))


class HearingTests(SynchronousTestCase):
    """Operations received from rosbridge."""

    def test_reads_the_operations_of_the_protocol(self) -> None:
        """Publications, status messages, and responses of successful and failed services are decoded."""
        self.assertEqual(decode_message(b'{"op":"publish","topic":"/a","msg":{"b":1}}'), TopicMessage("/a", {"b": 1}))
        said = b'{"op":"service_response","id":"7","service":"/s","values":{"type":"x"},"result":true}'
        self.assertEqual(decode_message(said), ServiceResponse("7", {"type": "x"}, True))
        said = b'{"op":"service_response","id":"7","values":"no such service","result":false}'
        self.assertEqual(decode_message(said), ServiceResponse("7", {"error": "no such service"}, False))
        said = b'{"op":"service_response","id":"7"}'
        self.assertEqual(decode_message(said), ServiceResponse("7", {"error": "no reason given"}, True))
        self.assertEqual(decode_message(b'{"op":"status","level":"error","msg":"oh"}'), Status("error", "oh"))

    def test_refuses_what_is_no_operation(self) -> None:
        """Invalid bytes, JSON and operations raise BadFrame, whatever their depth and size."""
        for said in (
            *(b"", b"\xff\xfe", b"{", b"[]", b"3", b"null", b"{}", b'{"op":"png"}', b'{"op":["publish"]}'),
            *(b'{"op":"publish","topic":1,"msg":{}}', b'{"op":"publish","topic":"/a","msg":[]}'),
            *(b'{"op":"service_response","id":7,"values":{}}', b"[" * 100_000, b'{"op":' + b"9" * 5000 + b"}"),
        ):
            self.assertRaises(BadFrame, decode_message, said)

    @given(st.binary(max_size=60))
    def test_any_bytes(self, data: bytes) -> None:
        """Random bytes give a message or BadFrame, and no other exception."""
        try:
            decode_message(data)
        except BadFrame:
            return

    @given(ANY)
    def test_any_json(self, said: Any) -> None:
        """Random JSON, including NaN and Infinity as old versions send them, gives a message or BadFrame."""
        for whole in (said, {"op": "publish", "topic": "/a", "msg": said}, {"op": "service_response", "id": said}):
            try:
                decode_message(json.dumps(whole).encode())
            except BadFrame:
                continue


class ReadingTests(SynchronousTestCase):
    """ROS messages are converted to SI values."""

    def test_odometry(self) -> None:
        """Odometry gives position, heading and velocity; ``base.moving`` is false below a minimum velocity."""
        values = codec.convert_odometry(ODOMETRY)
        self.assertEqual((values["odom.x"], values["odom.y"], values["base.moving"]), (1.0, -2.5, True))
        self.assertAlmostEqual(abs(float(values["odom.yaw"])), math.pi)
        self.assertEqual((values["base.vx"], values["base.vy"], values["base.wz"]), (0.1, 0.0, -0.5))
        still = spoilt(ODOMETRY, ("twist", "twist"), STILL)
        self.assertIs(codec.convert_odometry(still)["base.moving"], False)

    def test_absurd_odometry(self) -> None:
        """Null, NaN, infinite, too large or missing values and a zero quaternion each raise BadFrame."""
        for path in (
            ("pose", "pose", "position", "x"),
            ("pose", "pose", "orientation", "w"),
            ("twist", "twist", "linear", "x"),
        ):
            values: tuple[Any, ...] = (None, math.nan, math.inf, -math.inf, 1e9, 10**400, True, "1", [], {})
            for value in values:
                self.assertRaises(BadFrame, codec.convert_odometry, spoilt_python(ODOMETRY, path, value))
        zero = {"x": 0, "y": 0, "z": 0, "w": 0}
        self.assertRaises(BadFrame, codec.convert_odometry, spoilt(ODOMETRY, ("pose", "pose", "orientation"), zero))

    def test_scan(self) -> None:
        """Each sector reports its nearest echo.

        Null, 0.0 and values out of range are ignored; an offset rotates the scan.
        """
        values = codec.convert_scan(SCAN, SECTORS)
        self.assertEqual((values["range.right"], values["range.front"]), (1.0, 0.5))
        self.assertTrue(math.isnan(float(values["range.left"])))
        turned = codec.convert_scan(SCAN, SECTORS, math.pi / 2)
        self.assertEqual((turned["range.front"], turned["range.left"]), (1.0, 0.5))
        raw = {**SCAN, "ranges": [math.nan, math.inf, -math.inf, 0.7, 0.2]}
        self.assertEqual([codec.convert_scan(raw, SECTORS)[f"range.{name}"] for name in ("front", "left")], [0.7, 0.2])

    def test_absurd_scan(self) -> None:
        """A scan with missing, too many or invalid ranges, or invalid limits, raises BadFrame."""
        for key, value in (
            *(("ranges", None), ("ranges", []), ("ranges", "0.5"), ("ranges", [0.5, "x"]), ("ranges", [True])),
            *(("ranges", [1.0] * (codec.MAX_READINGS + 1)), ("angle_increment", 0.0), ("angle_min", None)),
            *(("range_min", -1.0), ("range_max", 0.05), ("range_max", None)),
        ):
            self.assertRaises(BadFrame, codec.convert_scan, {**SCAN, key: value}, SECTORS)

    def test_imu(self) -> None:
        """The acceleration is always reported; the attitude is reported unless its covariance marks it as unknown."""
        turn = math.sin(math.pi / 12), math.cos(math.pi / 12)
        said = {
            "linear_acceleration": {"x": 0.1, "y": 0, "z": 9.8},
            "orientation": {"x": turn[0], "y": 0, "z": 0, "w": turn[1]},
        }
        values = codec.convert_imu(said)
        self.assertEqual((values["imu.ax"], values["imu.az"]), (0.1, 9.8))
        self.assertAlmostEqual(float(values["imu.roll"]), math.pi / 6)
        self.assertAlmostEqual(float(values["imu.pitch"]), 0.0)
        self.assertNotIn("imu.yaw", codec.convert_imu({**said, "orientation_covariance": [-1, 0, 0]}))
        self.assertRaises(BadFrame, codec.convert_imu, {"linear_acceleration": {"x": 0, "y": 0, "z": 2000}})

    def test_battery(self) -> None:
        """Known values are reported; null and NaN are omitted.

        A level above 100 % raises BadFrame that suggests the option.
        """
        said = {"voltage": 11.5, "current": None, "percentage": 0.8, "power_supply_status": 1}
        self.assertEqual(codec.convert_battery(said), {"power.volts": 11.5, "power.level": 0.8, "power.charging": True})
        self.assertEqual(codec.convert_battery({"percentage": 80.0}, 100.0)["power.level"], 0.8)
        self.assertEqual(codec.convert_battery({"percentage": 1.005})["power.level"], 1.0)
        self.assertIn("battery_full", str(self.assertRaises(BadFrame, codec.convert_battery, {"percentage": 80.0})))
        wrong: tuple[dict[str, Any], ...] = ({}, {"percentage": math.nan}, {"percentage": -1}, {"voltage": 1e9})
        for each in wrong:
            self.assertRaises(BadFrame, codec.convert_battery, each)

    def test_picture(self) -> None:
        """A complete JPEG and its size are decoded from base64; for other data the BadFrame contains the format."""
        said = {"format": "jpeg", "data": base64.b64encode(JPEG).decode()}
        self.assertEqual(codec.decode_picture(said), (JPEG, 128, 96))
        png = base64.b64encode(b"\x89PNG").decode()
        self.assertIn("png", str(self.assertRaises(BadFrame, codec.decode_picture, {"format": "png", "data": png})))
        cut = base64.b64encode(JPEG[:-1]).decode()
        for data in (None, [255, 216], "&&", "\u20ac", "/9j", cut):
            self.assertRaises(BadFrame, codec.decode_picture, {"format": "jpeg", "data": data})

    def test_stamp(self) -> None:
        """Time stamps of ROS 1 and ROS 2 are read; an invalid stamp gives None."""
        self.assertEqual(codec.read_stamp(ODOMETRY), 12.5)
        self.assertEqual(codec.read_stamp({"header": {"stamp": {"secs": 3, "nsecs": 0}}}), 3.0)
        for at in (None, 3, {"sec": 1.5, "nanosec": 0}, {"sec": -1, "nanosec": 0}, {"sec": 1, "nanosec": 10**9}):
            self.assertIsNone(codec.read_stamp({"header": {"stamp": at}}))
        self.assertIsNone(codec.read_stamp({"header": None}))

    @given(st.data(), ANY)
    def test_any_field(self, data: st.DataObject, value: Any) -> None:
        """A message with any value in any field gives finite numbers, booleans and strings, or BadFrame."""
        readers = (
            (codec.convert_odometry, ODOMETRY),
            (lambda said: codec.convert_scan(said, SECTORS), SCAN),
            (codec.convert_battery, {"voltage": 11.5, "percentage": 0.8, "power_supply_status": 1}),
        )
        read, message = data.draw(st.sampled_from(readers))
        said = spoilt_python(message, data.draw(st.sampled_from(paths(message))), value)
        codec.read_stamp(said)
        try:
            values = read(said)
        except BadFrame:
            return
        for key, each in values.items():
            self.assertFalse(isinstance(each, float) and math.isinf(each), key)
            self.assertTrue(key.startswith("range.") or not (isinstance(each, float) and math.isnan(each)), key)


def spoilt_python(message: Any, path: tuple[Any, ...], value: Any) -> Any:
    """Return a copy as ``spoilt`` does, but with values that JSON lacks."""
    marked = spoilt(message, path, "\0here")

    def put(at: Any) -> Any:
        if at == "\0here":
            return value
        if isinstance(at, dict):
            return {key: put(inner) for key, inner in at.items()}
        return [put(inner) for inner in at] if isinstance(at, list) else at

    return put(marked)
