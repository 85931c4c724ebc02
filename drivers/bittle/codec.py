"""Codec of OpenCat, the protocol of Petoi's robots: commands to the robot and lines from it; pure.

A command begins with its token.  A command with a lower-case token has text arguments and ends with a line feed; a
command with an upper-case token has binary arguments and ends with ``~``. The robot answers with lines; the last line
contains only the token.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from urllib.parse import quote_from_bytes

from drivers.errors import BadFrame
from formats.head import Head, encode_head, pop_head

END_TEXT, END_BYTES = b"\n", b"~"
MIN_ARGUMENT, MAX_ARGUMENT = -125, 125
"""Range of binary arguments; it excludes 126, the byte that ends a command."""
MAX_LINE_BYTES = 512
MAX_JOINTS = 16
MAX_JOINT_ANGLE_DEG = 270.0
MIN_BATTERY_V, MAX_BATTERY_V = 3.0, 13.0
MAX_RANGE_CM = 400.0
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")
NAME = re.compile(r"[A-Za-z][A-Za-z0-9]{0,15}")

# -- to the robot --------------------------------------------------------------------------------------------------


def encode_skill(name: str) -> bytes:
    """Return the command for a skill.

    A gait and a posture last until the next skill; a behaviour ends by itself.
    """
    if not NAME.fullmatch(name):
        raise ValueError(f"{name!r} is not a valid skill name")
    return b"k" + name.encode() + END_TEXT


def encode_text_command(token: str, *numbers: float) -> bytes:
    """Return a command with a lower-case token; ``i8 -20 9 -20`` moves joints 8 and 9 together, in degrees."""
    return token.encode() + b" ".join(b"%d" % round(number) for number in numbers) + END_TEXT


def encode_binary_command(token: str, numbers: Sequence[int]) -> bytes:
    """Return a command with an upper-case token and one byte per number, from -125 to 125."""
    if not all(MIN_ARGUMENT <= number <= MAX_ARGUMENT for number in numbers):
        raise ValueError(f"numbers must be from {MIN_ARGUMENT} to {MAX_ARGUMENT}: {list(numbers)}")
    return token.encode() + bytes(number & 0xFF for number in numbers) + END_BYTES


def encode_ultrasonic(trigger: int, echo: int) -> bytes:
    """Return the command that measures the distance with the ultrasonic sensor on these two pins."""
    return b"X" + encode_binary_command("U", (trigger, echo))


REST = b"d" + END_TEXT
JOINT_ANGLES = b"j" + END_TEXT
ATTITUDE = b"gp" + END_TEXT
NYBOARD_ATTITUDE = b"v" + END_TEXT
"""The attitude command of a NyBoard."""
VOLTAGE = b"P" + END_BYTES
VERSION = b"?" + END_TEXT


# -- from the robot ------------------------------------------------------------------------------------------------


class LineReader:
    """Splits the robot's bytes into lines; counts and drops lines that are not text."""

    def __init__(self) -> None:
        self.bad_frames = 0
        self._rest = bytearray()
        self._is_skipping = False

    def read(self, data: bytes) -> Iterator[str]:
        """Yield the non-empty lines that ``data`` completes, without their line ends."""
        self._rest += data
        while (at := self._rest.find(b"\n")) >= 0:
            line = bytes(self._rest[:at]).strip(b"\r \t")
            del self._rest[: at + 1]
            is_lost, self._is_skipping = self._is_skipping, False
            if is_lost or len(line) > MAX_LINE_BYTES or not _is_text(line):
                self.bad_frames += 1
            elif line:
                yield line.decode()
        if len(self._rest) > MAX_LINE_BYTES:
            self._rest.clear()
            self._is_skipping = True


def is_end(line: str, token: str) -> bool:
    """Return whether ``line`` ends the answer to ``token``; a toggle may answer in upper or lower case."""
    return line.lower() == token.lower()


def parse_unknown_skill(line: str) -> str | None:
    """Return the name of the skill that the robot reports as unknown, or None for other lines."""
    return line[1:-1] if len(line) > 2 and line.startswith("?") and line.endswith("?") else None


def is_banner(line: str) -> bool:
    """Return whether ``line`` is the banner of a robot that has just booted."""
    return line.replace(" ", "").lower() == "*start*"


def parse_board(lines: Sequence[str]) -> str:
    """Return ``nyboard`` or ``biboard`` according to the version in ``lines``; empty if there is none."""
    for line in lines:
        found = re.search(r"\b([BN])[A-Z0-9]*_\d{6}\b", line)
        if found:
            return "nyboard" if found[1] == "N" else "biboard"
    return ""


def parse_joints(lines: Sequence[str]) -> dict[int, float]:
    """Return the angle of each joint in radians; raise ``BadFrame`` unless there are as many angles as joints."""
    numbers = _find_numbers(lines)
    half = len(numbers) // 2
    if half == 0 or len(numbers) % 2 or numbers[:half] != [float(one) for one in range(half)] or half > MAX_JOINTS:
        raise BadFrame(f"the answer is not a list of joint angles: {' / '.join(lines)}")
    if any(abs(angle) > MAX_JOINT_ANGLE_DEG for angle in numbers[half:]):
        raise BadFrame(f"a joint angle is beyond {MAX_JOINT_ANGLE_DEG:g} degrees: {' / '.join(lines)}")
    return {joint: math.radians(angle) for joint, angle in enumerate(numbers[half:])}


def parse_attitude(lines: Sequence[str]) -> dict[str, float]:
    """Return ``roll``, ``pitch``, ``yaw`` in radians from a BiBoard's first sensor; raise ``BadFrame`` if invalid."""
    for line in lines:
        if line.startswith(("ICM:", "MCU:")):
            # If a number fills its column, no space separates it from the next column.
            numbers = _find_numbers([line[4:].split("MCU:")[0]])
            if len(numbers) == 6:
                return _to_radians(roll=numbers[5], pitch=numbers[4], yaw=numbers[3])
    raise BadFrame(f"not an attitude: {' / '.join(lines)}")


def parse_nyboard_attitude(lines: Sequence[str]) -> dict[str, float]:
    """Return ``roll`` and ``pitch`` in radians of a NyBoard; raise ``BadFrame`` if invalid."""
    for line in lines:
        numbers = _find_numbers([line])
        if len(numbers) >= 2:
            return _to_radians(pitch=numbers[0], roll=numbers[1])
    raise BadFrame(f"not an attitude: {' / '.join(lines)}")


def parse_voltage(lines: Sequence[str]) -> float:
    """Return the voltage of the battery; raise ``BadFrame`` if invalid."""
    for line in lines:
        numbers = _find_numbers([line])
        if "volt" in line.lower() and len(numbers) == 1 and MIN_BATTERY_V <= numbers[0] <= MAX_BATTERY_V:
            return numbers[0]
    raise BadFrame(f"not a voltage: {' / '.join(lines)}")


def parse_distance(lines: Sequence[str]) -> float:
    """Return the distance in metres from the ultrasonic sensor, NaN without an echo; raise ``BadFrame`` if invalid."""
    numbers = _find_numbers(lines)
    if len(numbers) != 1 or not 0.0 <= numbers[0] <= MAX_RANGE_CM:
        raise BadFrame(f"not a distance: {' / '.join(lines)}")
    return numbers[0] / 100.0 if numbers[0] else math.nan


def _is_text(line: bytes) -> bool:
    return all(32 <= byte < 127 or byte == 9 for byte in line)


def _find_numbers(lines: Sequence[str]) -> list[float]:
    return [float(found) for line in lines for found in NUMBER.findall(line)]


def _to_radians(**degrees: float) -> dict[str, float]:
    if any(abs(angle) > 360.0 for angle in degrees.values()):
        raise BadFrame(f"an angle is beyond 360 degrees: {degrees}")
    return {name: math.remainder(math.radians(angle), math.tau) for name, angle in degrees.items()}


# -- over Wi-Fi ----------------------------------------------------------------------------------------------------


def encode_request(host: str, path: str) -> bytes:
    """Return an HTTP request for ``path`` that asks the robot to close the connection after its response."""
    return encode_head(f"GET {path} HTTP/1.1", f"Host: {host}", "Connection: close")


def format_command_path(board: str, command: bytes) -> str:
    """Return the path to which ``command`` is sent on a robot with this board; the robot adds the line feed itself."""
    quoted = quote_from_bytes(command.removesuffix(END_TEXT), safe="")
    return f"/action?name={quoted}" if board == "nyboard" else f"/cmd?cmd={quoted}"


def format_status_path(task: str) -> str:
    """Return the path of a BiBoard's status of a task."""
    return f"/status?taskId={quote_from_bytes(task.encode(), safe='')}"


def parse_task_id(body: bytes) -> str:
    """Return the id of the task that a BiBoard created for a command; raise ``BadFrame`` if ``body`` has no id."""
    found = re.fullmatch(rb"\s*TASK_ID:\s*([0-9A-Za-z_-]{1,40})\s*", body)
    if not found:
        raise BadFrame(f"the response is not a task id: {body[:60]!r}")
    return found[1].decode()


def parse_task_result(body: bytes) -> bytes | None:
    """Return the result of a task, None while the task runs; raise ``BadFrame`` if it failed or ``body`` is invalid."""
    state, _, rest = body.partition(b"\n")
    state = state.strip()
    if state in (b"pending", b"running"):
        return None
    if state == b"completed":
        return rest
    raise BadFrame(f"the robot reports {b' '.join(body.split())[:80]!r}")


class ResponseReader:
    """Reads one HTTP response, which ends after ``Content-Length`` bytes or with the connection."""

    MAX_BYTES = 8192

    def __init__(self) -> None:
        self._data = bytearray()
        self._head: Head | None = None
        self._length: int | None = None

    def read(self, data: bytes) -> bytes | None:
        """Return the body when it is complete; raise ``BadFrame`` for a status other than 200 or invalid HTTP."""
        self._data += data
        if len(self._data) > self.MAX_BYTES:
            raise BadFrame("the response is too long")
        if self._head is None:
            self._head = pop_head(self._data)
            if self._head is None:
                return None
            if not re.match(rb"HTTP/1\.[01] 200\b", self._head.first):
                raise BadFrame(f"the robot answers {self._head.first[:60]!r}")
            length = self._head.fields.get(b"content-length", b"")
            self._length = int(length) if re.fullmatch(rb"\d{1,6}", length) else None
        if self._length is None or len(self._data) < self._length:
            return None
        return bytes(self._data[: self._length])

    def finish(self) -> bytes:
        """Return the body after the connection closed; raise ``BadFrame`` if it is incomplete."""
        if self._head is None or self._length is not None:
            raise BadFrame("the response is cut off")
        return bytes(self._data)
