"""Attack S21: a malicious rosbridge server makes its driver spend memory and time."""

from __future__ import annotations

import tracemalloc
from random import Random
from typing import Any

from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase
from wsproto.events import Event, Pong

from drivers.errors import BadFrame, RobotError
from drivers.link import MemoryConnector
from drivers.rosbridge.codec import MAX_NUMBER_CHARS, MAX_VALUES, ServiceResponse, Status, decode_message
from drivers.rosbridge.driver import RosbridgeDriver
from drivers.rosbridge.websocket import MAX_MESSAGE_BYTES
from formats.websocket import MAX_FRAMES, WebSocketEnd
from sim.robots.emulator.rosbridge import RosbridgeRobot
from sim.robots.emulator.simulated_robot import MemoryRobot
from tests.formats.rfc6455 import CONTINUATION, PING, PONG, TEXT, framed

READ = 65536
"""The number of bytes that a reactor reads at a time."""
ROOM = 24 * 2**20
"""The maximum memory in bytes that decoding an accepted message may take."""


def published(inner: bytes) -> bytes:
    """Return an odometry message that contains ``inner``."""
    return b'{"op":"publish","topic":"/odom","msg":{"pose":' + inner + b"}}"


def filled(one: bytes, size: int = MAX_MESSAGE_BYTES - 100) -> bytes:
    """Return a message filled with copies of one value."""
    return published(b"[" + one + (b"," + one) * ((size - len(one)) // (len(one) + 1)) + b"]")


MANY = {
    "numbers": filled(b"1"),
    "floats": filled(b".1".rjust(3, b"0")),
    "lists": filled(b"[]"),
    "lists of lists": filled(b"[[0]]"),
    "objects": filled(b"{}"),
    "objects of objects": filled(b'{"":{}}'),
    "names": published(b"{" + b",".join(b'"%x":0' % number for number in range(400_000)) + b"}"),
}
LONG = {
    "a number of a megabyte": published(b"1" * 10**6),
    "a fraction of a megabyte": published(b"1." + b"1" * 10**6),
    "an exponent of a megabyte": published(b"1e" + b"1" * 10**6),
    "a negative one": published(b"-" + b"1" * 10**6),
    "many numbers of 4000 digits": filled(b"1" * 4000),
    "as an id": b'{"op":"service_response","id":' + b"1" * 10**6 + b',"values":{}}',
}
DEEP = {
    "lists": published(b"[" * 30_000 + b"]" * 30_000),
    "objects": published(b'{"":' * 30_000 + b"0" + b"}" * 30_000),
    "not closed": b"[" * 10**6,
}


class MessageTests(SynchronousTestCase):
    def peak(self, data: bytes) -> tuple[bool, int]:
        """Return whether a message is accepted, and the peak memory that a rejected message needed."""
        tracemalloc.start()
        try:
            decode_message(data)
        except BadFrame:
            return False, tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        return True, 0

    def test_many_values(self) -> None:
        """Messages of 4 MB with up to two million values are rejected before objects are created for the values."""
        for name, data in MANY.items():
            self.assertLessEqual(len(data), MAX_MESSAGE_BYTES)
            is_taken, peak = self.peak(data)
            self.assertFalse(is_taken, name)
            self.assertLess(peak, 10_000, name)

    def test_long_numbers(self) -> None:
        """Numbers with up to a million digits are rejected before they are converted."""
        for name, data in LONG.items():
            is_taken, peak = self.peak(data)
            self.assertFalse(is_taken, name)
            self.assertLess(peak, 3 * len(data) + 10_000, name)

    def test_deep_nesting(self) -> None:
        """Nesting deeper than the interpreter's limit is rejected."""
        for name, data in DEEP.items():
            self.assertFalse(self.peak(data)[0], name)

    def test_nesting_is_not_printed(self) -> None:
        """If a text or number is expected, an error contains only the type of a deep or large value."""
        for depth in range(50, 1000):
            deep = b"[" * depth + b"]" * depth
            for data in (b'{"op":' + deep + b"}", b'{"op":"service_response","id":"1","values":' + deep + b"}"):
                try:
                    said = decode_message(data)
                except BadFrame as error:
                    self.assertLess(len(str(error)), 100)
                else:
                    assert isinstance(said, ServiceResponse)
                    self.assertEqual(said.values, {"error": "a list"})
        status = decode_message(b'{"op":"status","level":"error","msg":[[[1]]]}')
        self.assertEqual(status, Status("error", "a list"))

    def test_most_that_is_taken(self) -> None:
        """Decoding the most expensive accepted message takes limited memory.

        The largest scans and numbers are accepted.
        """
        worst = published(b"[" + b",".join([b'{"":0}'] * (MAX_VALUES // 2 - 5)) + b"]")
        tracemalloc.start()
        try:
            message = decode_message(worst)
            self.assertLess(tracemalloc.get_traced_memory()[1], ROOM)
        finally:
            tracemalloc.stop()
        del message
        ranges = b",".join([b"1.2345678901234567"] * 20_000)
        scan = b'{"op":"publish","topic":"/scan","msg":{"ranges":[%b],"intensities":[%b]}}' % (ranges, ranges)
        self.assertTrue(self.peak(scan)[0])
        self.assertTrue(self.peak(published(b"1" * MAX_NUMBER_CHARS))[0])
        self.assertTrue(self.peak(published(b"%.6f" % 1.7e308))[0])


class FloodTests(SynchronousTestCase):
    def setUp(self) -> None:
        """Connect a driver to an emulated robot, and count the processed frames."""
        self.clock = Clock()
        self.robot = RosbridgeRobot(self.clock, MemoryRobot(values={"power.level": 0.8}), Random(1))
        self.robot.start()
        self.connector = MemoryConnector(self.clock, self.robot.accept)
        self.driver = RosbridgeDriver({}, self.connector, self.clock, "turtle")
        self.driver.connect()
        self.pass_time(0.5)
        self.assertEqual(self.driver.state, "ready")
        self.taken = 0
        take, send = WebSocketEnd._process_event, WebSocketEnd._send

        def counted(end: WebSocketEnd, event: Event) -> bool:
            is_taken = take(end, event)
            self.taken += is_taken and end._request is not None
            return is_taken

        self.patch(WebSocketEnd, "_process_event", counted)
        self.pongs: list[int] = []

        def noted(end: WebSocketEnd, event: Event) -> bytes:
            if isinstance(event, Pong) and end._request is not None:
                self.pongs.append(len(event.payload))
            return send(end, event)

        self.patch(WebSocketEnd, "_send", noted)
        self.addCleanup(self.end)

    def end(self) -> None:
        self.driver.disconnect()
        self.robot.stop()
        self.pass_time(0.1)

    def pass_time(self, seconds: float) -> None:
        self.clock.pump([0.005] * round(seconds / 0.005))

    @property
    def link(self) -> Any:
        """The driver's end of the newest connection."""
        return self.connector.links[-1]

    def hear(self, data: bytes) -> None:
        """Deliver ``data`` to the driver in chunks of the size that a reactor reads."""
        for start in range(0, len(data), READ):
            if self.link.receiver is not None:
                self.link.receiver.data_received(data[start : start + READ])

    def test_flood_of_empty_frames(self) -> None:
        """Of a megabyte of empty frames, the driver processes only about a thousand frames.

        Then the driver disconnects, and reconnects later.
        """
        for opcode in (PING, PONG, CONTINUATION, TEXT):
            with self.subTest(opcode=opcode):
                self.taken = 0
                data = framed(opcode, b"", None)
                self.hear(data * (2**20 // len(data)))
                self.assertLessEqual(self.taken, MAX_FRAMES)
                self.assertLessEqual(len(self.pongs), MAX_FRAMES)
                self.assertNotEqual(self.driver.state, "ready")
                self.pass_time(8.0)
                self.assertEqual(self.driver.state, "ready")

    def test_flood_comes_again(self) -> None:
        """The driver reconnects to a flooding server only every few seconds, which limits the load."""
        flood = framed(PING, b"", None) * (READ // 2)
        self.taken = 0
        for _ in range(6000):
            if self.driver.state == "ready":
                self.hear(flood)
            self.pass_time(0.005)
        self.assertLess(self.taken, 60 * MAX_FRAMES)

    def test_pongs_do_not_pile_up(self) -> None:
        """Pings of a peer that reads nothing are not answered, so no pongs accumulate."""
        sent: list[bytes] = []
        self.patch(self.link, "send", sent.append)
        self.link.is_busy = True
        self.hear(framed(PING, bytes(125), None) * 300)
        self.assertEqual(sent, [])
        self.link.is_busy = False
        self.hear(framed(PING, bytes(125), None) * 3)
        self.assertEqual(len(sent), 1)

    def test_driver_survives(self) -> None:
        """No hostile message closes the connection or raises; the driver then processes the next valid message."""
        before = self.driver.diagnostics()["bad_frames"]
        hostile = [*MANY.values(), *LONG.values(), *DEEP.values()]
        for data in hostile:
            self.hear(framed(TEXT, data, None))
        self.assertEqual(self.driver.diagnostics()["bad_frames"] - before, len(hostile))
        self.pass_time(0.5)
        self.assertEqual(self.driver.state, "ready")

    def test_answers_to_calls(self) -> None:
        """If a call fails with a deeply nested reason, the error text is short."""
        errors: list[object] = []
        asked = self.driver._call_service("/dance")
        asked.addErrback(lambda failure: errors.append(failure.check(RobotError) and failure.getErrorMessage()))
        number = next(reversed(self.driver._calls))
        deep = b"[" * 500 + b"]" * 500
        answer = b'{"op":"service_response","id":"%b","result":false,"values":{"error":%b}}'
        self.hear(framed(TEXT, answer % (number.encode(), deep), None))
        self.assertEqual(errors, ["a list"])
