"""Codec of OpenCat, what Petoi's robots speak: commands to the robot, and lines from it; pure.

A command begins with its token.  A lower-case token has arguments as text and ends with a line feed, an upper-case one
has bytes and ends with ``~``.  The robot answers with lines, the last of which is the token alone.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from urllib.parse import quote_from_bytes

from drivers.errors import BadFrame
from formats.head import Head, head, taken

END_TEXT, END_BYTES = b"\n", b"~"
LEAST_BYTE, MOST_BYTE = -125, 125
"""Angles in bytes stay clear of 126, which ends a command."""
MAX_LINE = 512
JOINTS = 16
MOST_DEGREES = 270.0
LEAST_VOLTS, MOST_VOLTS = 3.0, 13.0
FAR_CM = 400.0
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")
NAME = re.compile(r"[A-Za-z][A-Za-z0-9]{0,15}")

# -- to the robot --------------------------------------------------------------------------------------------------


def skill(name: str) -> bytes:
    """Do the skill: a gait runs until another is asked for, a posture is held, a behaviour ends by itself."""
    if not NAME.fullmatch(name):
        raise ValueError(f"{name!r} is no name of a skill")
    return b"k" + name.encode() + END_TEXT


def text(token: str, *numbers: float) -> bytes:
    """A command with a lower-case token; ``i8 -20 9 -20`` moves joints 8 and 9 together, in degrees."""
    return token.encode() + b" ".join(b"%d" % round(number) for number in numbers) + END_TEXT


def binary(token: str, numbers: Sequence[int]) -> bytes:
    """A command with an upper-case token and a byte a number, from -125 to 125."""
    if not all(LEAST_BYTE <= number <= MOST_BYTE for number in numbers):
        raise ValueError(f"bytes go from {LEAST_BYTE} to {MOST_BYTE}: {list(numbers)}")
    return token.encode() + bytes(number & 0xFF for number in numbers) + END_BYTES


def ultrasonic(trigger: int, echo: int) -> bytes:
    """How far is it?  The sensor hangs on these two pins."""
    return b"X" + binary("U", (trigger, echo))


REST = b"d" + END_TEXT
JOINT_ANGLES = b"j" + END_TEXT
ATTITUDE = b"gp" + END_TEXT
ATTITUDE_OLD = b"v" + END_TEXT
"""The same of a NyBoard."""
VOLTAGE = b"P" + END_BYTES
VERSION = b"?" + END_TEXT


# -- from the robot ------------------------------------------------------------------------------------------------


class LineReader:
    """Cuts the robot's bytes into lines, however they are cut; counts and drops what is no text."""

    def __init__(self) -> None:
        self.bad_frames = 0
        self._rest = bytearray()
        self._is_lost = False

    def read(self, data: bytes) -> Iterator[str]:
        """Yield the lines that ``data`` completes, without their ends; empty ones are left out."""
        self._rest += data
        while (at := self._rest.find(b"\n")) >= 0:
            line = bytes(self._rest[:at]).strip(b"\r \t")
            del self._rest[: at + 1]
            is_lost, self._is_lost = self._is_lost, False
            if is_lost or len(line) > MAX_LINE or not _is_text(line):
                self.bad_frames += 1
            elif line:
                yield line.decode()
        if len(self._rest) > MAX_LINE:
            self._rest.clear()
            self._is_lost = True


def is_end(line: str, token: str) -> bool:
    """Whether ``line`` says that the command with ``token`` is done; toggles answer in either case."""
    return line.lower() == token.lower()


def unknown_of(line: str) -> str | None:
    """The name of the skill that the robot does not know, where it says so."""
    return line[1:-1] if len(line) > 2 and line.startswith("?") and line.endswith("?") else None


def is_banner(line: str) -> bool:
    """Whether the robot has just been started."""
    return line.replace(" ", "").lower() == "*start*"


def board_of(lines: Sequence[str]) -> str:
    """``nyboard`` or ``biboard``, by the version in what it says of itself; empty where there is none."""
    for line in lines:
        found = re.search(r"\b([BN])[A-Z0-9]*_\d{6}\b", line)
        if found:
            return "nyboard" if found[1] == "N" else "biboard"
    return ""


def joints(lines: Sequence[str]) -> dict[int, float]:
    """Joint to its angle in radians; raises ``BadFrame`` for anything but as many angles as joints."""
    numbers = _numbers(lines)
    half = len(numbers) // 2
    if half == 0 or len(numbers) % 2 or numbers[:half] != [float(one) for one in range(half)] or half > JOINTS:
        raise BadFrame(f"these are no joints: {' / '.join(lines)}")
    if any(abs(angle) > MOST_DEGREES for angle in numbers[half:]):
        raise BadFrame(f"no joint turns so far: {' / '.join(lines)}")
    return {joint: math.radians(angle) for joint, angle in enumerate(numbers[half:])}


def attitude(lines: Sequence[str]) -> dict[str, float]:
    """``roll``, ``pitch``, ``yaw`` in radians of a BiBoard, of its first sensor; raises ``BadFrame``."""
    for line in lines:
        if line.startswith(("ICM:", "MCU:")):
            # Columns touch where a number fills its own.
            numbers = _numbers([line[4:].split("MCU:")[0]])
            if len(numbers) == 6:
                return _angles(roll=numbers[5], pitch=numbers[4], yaw=numbers[3])
    raise BadFrame(f"this is no attitude: {' / '.join(lines)}")


def attitude_old(lines: Sequence[str]) -> dict[str, float]:
    """``roll`` and ``pitch`` in radians of a NyBoard; raises ``BadFrame``."""
    for line in lines:
        numbers = _numbers([line])
        if len(numbers) >= 2:
            return _angles(pitch=numbers[0], roll=numbers[1])
    raise BadFrame(f"this is no attitude: {' / '.join(lines)}")


def volts(lines: Sequence[str]) -> float:
    """The battery's; raises ``BadFrame``."""
    for line in lines:
        numbers = _numbers([line])
        if "volt" in line.lower() and len(numbers) == 1 and LEAST_VOLTS <= numbers[0] <= MOST_VOLTS:
            return numbers[0]
    raise BadFrame(f"this is no voltage: {' / '.join(lines)}")


def distance(lines: Sequence[str]) -> float:
    """Metres to what the ultrasonic sensor hears, NaN for nothing; raises ``BadFrame``."""
    numbers = _numbers(lines)
    if len(numbers) != 1 or not 0.0 <= numbers[0] <= FAR_CM:
        raise BadFrame(f"this is no distance: {' / '.join(lines)}")
    return numbers[0] / 100.0 if numbers[0] else math.nan


def _is_text(line: bytes) -> bool:
    return all(32 <= byte < 127 or byte == 9 for byte in line)


def _numbers(lines: Sequence[str]) -> list[float]:
    return [float(found) for line in lines for found in NUMBER.findall(line)]


def _angles(**degrees: float) -> dict[str, float]:
    if any(abs(angle) > 360.0 for angle in degrees.values()):
        raise BadFrame(f"these are no angles: {degrees}")
    return {name: math.remainder(math.radians(angle), math.tau) for name, angle in degrees.items()}


# -- over Wi-Fi ----------------------------------------------------------------------------------------------------


def request(host: str, path: str) -> bytes:
    """A request of HTTP for ``path``, after which the robot closes."""
    return head(f"GET {path} HTTP/1.1", f"Host: {host}", "Connection: close")


def command_path(board: str, command: bytes) -> str:
    """Where a robot with this board takes a command; the line feed is the robot's business."""
    said = quote_from_bytes(command.removesuffix(END_TEXT), safe="")
    return f"/action?name={said}" if board == "nyboard" else f"/cmd?cmd={said}"


def status_path(task: str) -> str:
    """Where a BiBoard tells how a task stands."""
    return f"/status?taskId={quote_from_bytes(task.encode(), safe='')}"


def task_of(body: bytes) -> str:
    """The number of the task that a BiBoard made of a command; raises ``BadFrame``."""
    found = re.fullmatch(rb"\s*TASK_ID:\s*([0-9A-Za-z_-]{1,40})\s*", body)
    if not found:
        raise BadFrame(f"this is no task: {body[:60]!r}")
    return found[1].decode()


def result_of(body: bytes) -> bytes | None:
    """What a task has brought, None while it runs; raises ``BadFrame`` where it failed or is none."""
    state, _, rest = body.partition(b"\n")
    state = state.strip()
    if state in (b"pending", b"running"):
        return None
    if state == b"completed":
        return rest
    raise BadFrame(f"the robot says {b' '.join(body.split())[:80]!r}")


class ResponseReader:
    """Reads one response of HTTP, which ends with its length, or with the link."""

    MAX = 8192

    def __init__(self) -> None:
        self._data = bytearray()
        self._head: Head | None = None
        self._length: int | None = None

    def read(self, data: bytes) -> bytes | None:
        """The body once all of it is there; raises ``BadFrame`` for any status but 200, and for what is no HTTP."""
        self._data += data
        if len(self._data) > self.MAX:
            raise BadFrame("the response is too long")
        if self._head is None:
            self._head = taken(self._data)
            if self._head is None:
                return None
            if not re.match(rb"HTTP/1\.[01] 200\b", self._head.first):
                raise BadFrame(f"the robot answers {self._head.first[:60]!r}")
            length = self._head.fields.get(b"content-length", b"")
            self._length = int(length) if re.fullmatch(rb"\d{1,6}", length) else None
        if self._length is None or len(self._data) < self._length:
            return None
        return bytes(self._data[: self._length])

    def ended(self) -> bytes:
        """The body now that the link is gone; raises ``BadFrame`` where some of it is missing."""
        if self._head is None or self._length is not None:
            raise BadFrame("the response is cut off")
        return bytes(self._data)
