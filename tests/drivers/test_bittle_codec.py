"""Tests of ``drivers.bittle.codec``, ``gait``, ``dialogue`` and ``option``."""

from __future__ import annotations

import math

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.internet.task import Clock
from twisted.trial.unittest import SynchronousTestCase

from drivers.bittle import codec
from drivers.bittle.codec import LineReader, ResponseReader
from drivers.bittle.gait import GAITS, REST, STAND, Velocity, select_gait
from drivers.bittle.request_table import MAX_ANSWER_LINES, RequestTable
from drivers.errors import BadFrame, LinkLost, NoReply, RobotError, Unsupported
from drivers.registry import describe

INDICES = "\t".join(str(one) for one in range(16))


class CommandTests(SynchronousTestCase):
    """Commands to the robot."""

    def test_golden_vectors(self) -> None:
        """Each command has the bytes that the firmware reads."""
        self.assertEqual(codec.encode_skill("wkF"), bytes.fromhex("6b 77 6b 46 0a"))
        self.assertEqual(codec.encode_binary_command("I", (8, -20, 9, -20)), bytes.fromhex("49 08 ec 09 ec 7e"))
        self.assertEqual(codec.encode_ultrasonic(16, 17), bytes.fromhex("58 55 10 11 7e"))
        self.assertEqual(
            codec.encode_binary_command("L", [0] * 8 + [30] * 8), bytes.fromhex("4c" + "00" * 8 + "1e" * 8 + "7e")
        )
        self.assertEqual(codec.encode_text_command("i", 8, -20.4, 9, 130), b"i8 -20 9 130\n")

    def test_refuses_what_would_be_another_command(self) -> None:
        """A skill name with a line feed is refused, and also an angle that is encoded as the command's end mark."""
        for name in ("", "wk\nd", "8", "a" * 17):
            self.assertRaises(ValueError, codec.encode_skill, name)
        self.assertRaises(ValueError, codec.encode_binary_command, "I", (0, 126))


class LineTests(SynchronousTestCase):
    """Lines from the robot."""

    def test_reads_lines_however_they_are_cut(self) -> None:
        """Lines that arrive byte by byte are read like lines that arrive in one piece."""
        said = b"wkF\r\nk\r\n\r\n=\r\n0\t1\t\r\n"
        whole, pieces = LineReader(), LineReader()
        lines = list(whole.read(said))
        self.assertEqual(lines, ["wkF", "k", "=", "0\t1"])
        self.assertEqual([one for at in range(len(said)) for one in pieces.read(said[at : at + 1])], lines)

    def test_drops_and_counts_what_is_no_text(self) -> None:
        """Lines with invalid bytes and overlong lines are dropped and counted; the following lines are read."""
        reader = LineReader()
        self.assertEqual(list(reader.read(b"\xffk\r\nd\r\n")), ["d"])
        self.assertEqual(list(reader.read(b"x" * 600)), [])
        self.assertEqual(list(reader.read(b"yz\r\nk\r\n")), ["k"])
        self.assertEqual(list(reader.read(b"x" * 513 + b"\nk\n")), ["k"])
        self.assertEqual(reader.bad_frames, 3)

    @given(st.binary(max_size=300))
    @settings(max_examples=200, deadline=None)
    def test_takes_any_bytes(self, data: bytes) -> None:
        """For any bytes, readers and parsers raise no exception except ``BadFrame``."""
        lines = list(LineReader().read(data + b"\n"))
        for parse in (
            codec.parse_joints,
            codec.parse_attitude,
            codec.parse_nyboard_attitude,
            codec.parse_voltage,
            codec.parse_distance,
        ):
            try:
                parse(lines)
            except BadFrame:
                continue
        codec.parse_board(lines)

    @given(st.lists(st.integers(-125, 125), min_size=16, max_size=16))
    @settings(max_examples=50, deadline=None)
    def test_joints_of_both_boards(self, angles: list[int]) -> None:
        """Joint angles in the formats of both boards are decoded as radians."""
        row = "".join(f"{angle},\t" for angle in angles)
        wanted = {joint: math.radians(angle) for joint, angle in enumerate(angles)}
        self.assertEqual(codec.parse_joints(["=", INDICES, row]), wanted)
        self.assertEqual(codec.parse_joints([f"={INDICES}", row]), wanted)

    def test_refuses_what_are_no_joints(self) -> None:
        """A line with too few angles, wrong indices or angles out of range is refused."""
        for lines in ([], ["=", "0\t1", "5,\t"], ["=", "1\t0", "5,\t6,"], ["=", "0", "271,"]):
            self.assertRaises(BadFrame, codec.parse_joints, lines)

    def test_attitude_of_both_boards(self) -> None:
        """Columns without a space between them are split.

        The columns are yaw, pitch and roll; on a NyBoard the pitch is first.
        """
        told = codec.parse_attitude(["ICM:   0.1  -0.2   9.8-179.9 -10.0  20.0"])
        self.assertAlmostEqual(told["yaw"], math.radians(-179.9))
        self.assertAlmostEqual(told["pitch"], math.radians(-10.0))
        self.assertAlmostEqual(told["roll"], math.radians(20.0))
        self.assertEqual(
            codec.parse_attitude(["ICM: 0 0 9 1 2 3\tMCU: 0 0 9 4 5 6"]), codec.parse_attitude(["MCU: 0 0 9 1 2 3"])
        )
        old = codec.parse_nyboard_attitude(["-10.00000\t20.00000\t0.1\t0.2\t9.8"])
        self.assertAlmostEqual(old["pitch"], math.radians(-10.0))
        self.assertAlmostEqual(old["roll"], math.radians(20.0))
        for lines in (["ICM: 1 2 3"], ["hello"], ["ICM: 0 0 9 1 2 999"]):
            self.assertRaises(BadFrame, codec.parse_attitude, lines)
        self.assertRaises(BadFrame, codec.parse_nyboard_attitude, ["1.0"])

    def test_volts_and_distance(self) -> None:
        """The voltages of two cells and distances in centimetres are converted; a distance of 0 becomes NaN.

        Invalid values are refused.
        """
        self.assertEqual(codec.parse_voltage(["Voltage: 7.95 V"]), 7.95)
        self.assertRaises(BadFrame, codec.parse_voltage, ["Voltage: 79.5 V"])
        self.assertRaises(BadFrame, codec.parse_voltage, ["7.95"])
        self.assertEqual(codec.parse_distance(["=", "42"]), 0.42)
        self.assertTrue(math.isnan(codec.parse_distance(["=", "0"])))
        for lines in (["="], ["=", "1 2"], ["=", "-5"], ["=", "999"]):
            self.assertRaises(BadFrame, codec.parse_distance, lines)

    def test_says_who_it_is(self) -> None:
        """The parser recognises the banner, the version of the board, unknown skills, and the end token in any case."""
        self.assertTrue(codec.is_banner("* Start *"))
        self.assertEqual(codec.parse_board(["Bittle", "Software version: B10_250712"]), "biboard")
        self.assertEqual(codec.parse_board(["Bittle", "Software version: N_250224"]), "nyboard")
        self.assertEqual(codec.parse_board(["Bittle"]), "")
        self.assertEqual(
            (codec.parse_unknown_skill("?fly?"), codec.parse_unknown_skill("?"), codec.parse_unknown_skill("fly")),
            ("fly", None, None),
        )
        self.assertTrue(codec.is_end("G", "g") and not codec.is_end("gp", "g"))


class HttpTests(SynchronousTestCase):
    """HTTP requests and responses over Wi-Fi."""

    def test_paths(self) -> None:
        """Commands become URL paths for either board; bytes are escaped and the line feed is omitted."""
        self.assertEqual(codec.format_command_path("biboard", b"kwkF\n"), "/cmd?cmd=kwkF")
        self.assertEqual(codec.format_command_path("nyboard", b"I\x08\xec~"), "/action?name=I%08%EC~")
        self.assertEqual(codec.format_status_path("12"), "/status?taskId=12")
        self.assertTrue(codec.encode_request("10.0.0.1", "/cmd").startswith(b"GET /cmd HTTP/1.1\r\nHost: 10.0.0.1\r\n"))

    def test_tasks(self) -> None:
        """A task has a number, and is running, completed with a text, or failed with the robot's message."""
        self.assertEqual(codec.parse_task_id(b"TASK_ID:17"), "17")
        self.assertRaises(BadFrame, codec.parse_task_id, b"busy")
        self.assertIsNone(codec.parse_task_result(b"pending"))
        self.assertIsNone(codec.parse_task_result(b"running\nabc"))
        self.assertEqual(codec.parse_task_result(b"completed\nwkF\r\nk"), b"wkF\r\nk")
        self.assertIn("time", str(self.assertRaises(BadFrame, codec.parse_task_result, b"error\nERROR: time out")))

    def test_reads_a_response_one_byte_at_a_time(self) -> None:
        """A body ends after its declared length, or with the connection; an incomplete body is refused."""
        said = b"HTTP/1.1 200 OK\r\nContent-Length: 3\r\n\r\nabc"
        reader = ResponseReader()
        got = [reader.read(said[at : at + 1]) for at in range(len(said))]
        self.assertEqual((set(got[:-1]), got[-1]), ({None}, b"abc"))
        open_end = ResponseReader()
        self.assertIsNone(open_end.read(b"HTTP/1.0 200 OK\r\n\r\nabc"))
        self.assertEqual(open_end.finish(), b"abc")
        for half in (b"", b"HTTP/1.1 200", said[:-1]):
            reader = ResponseReader()
            reader.read(half)
            self.assertRaises(BadFrame, reader.finish)

    @given(st.binary(max_size=200))
    @settings(max_examples=100, deadline=None)
    def test_other_responses_are_refused(self, data: bytes) -> None:
        """An error status, data that is not HTTP, and too long responses are refused.

        Random bytes raise only BadFrame.
        """
        self.assertRaises(BadFrame, ResponseReader().read, b"HTTP/1.1 404 Not Found\r\n\r\n" + data)
        self.assertRaises(BadFrame, ResponseReader().read, b"x" * 9000 + data)
        reader = ResponseReader()
        try:
            reader.read(data)
            reader.finish()
        except BadFrame:
            return


class GaitTests(SynchronousTestCase):
    """The choice of the nearest gait."""

    def test_chooses(self) -> None:
        """Slow, fast, backward, turning and arc motions each select their gait; a velocity near zero selects STAND."""
        for wish, name in (
            ((0.0, 0.0), STAND),
            ((0.01, 0.05), STAND),
            ((0.03, 0.0), "wkF"),
            ((0.14, 0.0), "trF"),
            ((-0.1, 0.0), "bk"),
            ((0.0, 0.2), "vtL"),
            ((0.0, -2.0), "vtR"),
            ((0.06, 0.4), "wkL"),
            ((0.06, -0.4), "wkR"),
        ):
            self.assertEqual(select_gait(*wish, GAITS)[0], name)
        self.assertEqual(select_gait(0.0, 0.0, GAITS)[1], REST)

    def test_never_goes_where_it_shall_not(self) -> None:
        """A gait never moves against the requested direction.

        If no gait fits, the dog stands; gaits without motion are ignored.
        """
        self.assertEqual(select_gait(-1.0, 1.0, {"wkF": Velocity(0.1, 0.0), "hlw": REST}), (STAND, REST))
        for wish in ((0.1, 0.0), (-0.1, 0.0), (0.0, 0.15), (0.0, -1.0), (0.03, -0.4), (-0.05, 0.4)):
            _, real = select_gait(*wish, GAITS)
            self.assertNotEqual(real, REST)
            for wished, done in zip(wish, real, strict=True):
                self.assertGreaterEqual(wished * done, 0.0)
                self.assertFalse(done and not wished)


class RequestTableTests(SynchronousTestCase):
    """The assignment of replies to requests."""

    def setUp(self) -> None:
        self.clock = Clock()
        self.sent: list[bytes] = []
        self.dialogue = RequestTable(self.clock, self.sent.append)

    def hear(self, *lines: str) -> None:
        for line in lines:
            self.dialogue.process_line(line)

    def test_answers_come_in_order(self) -> None:
        """A stop is sent immediately, even if a request is pending, and both get their replies."""
        asked = self.dialogue.request(b"j\n", 1.0)
        stop = self.dialogue.request(b"kup\n", 1.0)
        self.assertEqual(self.sent, [b"j\n", b"kup\n"])
        self.hear("=", "0", "5,", "j", "up", "k")
        self.assertEqual(self.successResultOf(asked), ["=", "0", "5,"])
        self.assertEqual(self.successResultOf(stop), ["up"])
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def test_a_command_too_long_has_failed(self) -> None:
        """A command that exceeds the robot's buffer fails, even if the robot then sends the end token.

        The next request succeeds.
        """
        long, next_one = self.dialogue.request(b"i8 10 9 10\n", 1.0), self.dialogue.request(b"j\n", 1.0)
        self.hear("OVF", "i", "=", "0", "5,", "j")
        self.failureResultOf(long, RobotError)
        self.assertEqual(self.successResultOf(next_one)[-3:], ["=", "0", "5,"])
        self.hear("OVF")

    def test_a_lost_answer_shifts_no_other(self) -> None:
        """If a reply is lost, the next reply is still assigned to its own request, also between two skills."""
        lost, got = self.dialogue.request(b"gp\n", 1.0), self.dialogue.request(b"j\n", 1.0)
        self.hear("j")
        self.failureResultOf(lost, NoReply)
        self.successResultOf(got)
        lost, got = self.dialogue.request(b"kwkF\n", 1.0), self.dialogue.request(b"kup\n", 1.0)
        self.hear("up", "k")
        self.failureResultOf(lost, NoReply)
        self.successResultOf(got)

    def test_a_rest_says_that_the_gyroscope_is_off(self) -> None:
        """The robot answers the command ``d`` (rest) with ``g`` and then ``d``.

        This ``g`` is not taken for the reply to an attitude request.
        """
        rest, attitude = self.dialogue.request(b"d\n", 1.0), self.dialogue.request(b"gp\n", 1.0)
        self.hear("g", "d")
        self.successResultOf(rest)
        self.assertNoResult(attitude)
        self.hear("ICM: 0 0 9 1 2 3", "g")
        self.assertEqual(len(self.successResultOf(attitude)), 1)

    def test_may_be_ended_while_it_fails_a_question(self) -> None:
        """The errback of a failed request may end the dialogue; no request fails twice."""
        first, second = self.dialogue.request(b"gp\n", 1.0), self.dialogue.request(b"P~", 1.0)
        third = self.dialogue.request(b"j\n", 1.0)
        first.addErrback(lambda _: self.dialogue.fail_all(LinkLost("gone")))
        self.hear("j")
        self.failureResultOf(second, LinkLost)
        self.failureResultOf(third, LinkLost)
        self.successResultOf(first)
        self.assertEqual(self.clock.getDelayedCalls(), [])

    def test_late_unknown_and_ended(self) -> None:
        """A request fails at its timeout, for an unknown skill, and at the end; lines without a request are ignored."""
        self.hear("k")
        late = self.dialogue.request(b"j\n", 1.0)
        self.clock.advance(1.0)
        self.failureResultOf(late, NoReply)
        unknown = self.dialogue.request(b"kfly\n", 1.0)
        self.hear("?swim?", "?fly?", "k")
        self.failureResultOf(unknown, Unsupported)
        ended = self.dialogue.request(b"j\n", 1.0)
        self.hear(*["chatter"] * (MAX_ANSWER_LINES + 5))
        self.dialogue.fail_all(LinkLost("gone"))
        self.failureResultOf(ended, LinkLost)
        self.assertEqual(self.clock.getDelayedCalls(), [])


class OptionTests(SynchronousTestCase):
    """The options of the Bittle."""

    def test_describes_what_the_gaits_can_do(self) -> None:
        """The limits are those of the gaits, without keys for missing axes; the capabilities depend on the board."""
        told = describe("bittle", {"port": "/dev/ttyUSB0", "gaits": {"wkF": [0.1, 0]}, "board": "nyboard"})
        self.assertEqual(told.limits, {"base.vx": (0.0, 0.1)})
        self.assertNotIn("ranger", told.capabilities)
        self.assertNotIn("power", told.capabilities)
        told = describe("bittle", {"port": "/dev/ttyUSB0", "ultrasonic": [16, 17]})
        self.assertIn("ranger", told.capabilities)
        self.assertEqual(told.limits["base.vx"], (-0.05, 0.15))
