"""The text protocol of main control (port 10020), in both directions; pure.

Commands are lines.  A reply is a keyword on a line, followed by a number of lines that the keyword defines.  The menu
(``refresh``) has five fields per item, or four in Tekkotsu 2.x; the reader infers the number from the first item.

The names of the servers differ between generations of Tekkotsu: the driver sends all names, and the dog ignores
unknown names. The name of a running server becomes ``#name``, so starting it again does nothing.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass

from drivers.aibo.codec import LineReader
from drivers.errors import BadFrame

MAX_COUNT = 256
MAX_MESSAGE_LINES = 4096
"""Maximum number of lines of one message, more than any real menu has."""
HELLO = "!hello"
EMPTY_SLOT = "----------"
SERVERS: dict[str, tuple[str, ...]] = {
    "estop": ("EStop Remote Control", "EStopControllerBehavior", "EStopController"),
    "state": ("World State Serializer",),
    "walk": ("Walk Remote Control", "WalkController"),
    "head": ("Head Remote Control", "HeadController"),
    "camera": ("Raw Cam Server", "RawCam"),
}
PICTURE_MS = 1000.0 / 30.0


@dataclass(frozen=True)
class Item:
    """One entry of a menu: the number of its subitems, whether it is highlighted, its name and its description."""

    item_count: int
    is_highlighted: bool
    title: str
    description: str = ""


@dataclass(frozen=True)
class Refresh:
    """The current menu."""

    title: str
    items: tuple[Item, ...]


@dataclass(frozen=True)
class Status:
    """A status text to be read by a person."""

    text: str


@dataclass(frozen=True)
class Load:
    """A server is opening ``port``."""

    java: str
    name: str
    port: int
    arguments: str = ""


@dataclass(frozen=True)
class Close:
    """The server ``name`` is closing."""

    name: str


@dataclass(frozen=True)
class Hello:
    """The answer to ``!hello``: the number of clients so far."""

    count: int


@dataclass(frozen=True)
class Stack:
    """The titles of the open menus, outermost first."""

    titles: tuple[str, ...]


@dataclass(frozen=True)
class OneWordMessage:
    """A message of one word: ``push`` and ``pop`` when a menu opens or closes, ``goodbye`` at the end."""

    word: str


Message = Refresh | Status | Load | Close | Hello | Stack | OneWordMessage
_Lines = Generator[None, str, Message]


def select(name: str) -> str:
    """Return the command that activates the item ``name``; it is idempotent: a running item is called ``#name``."""
    return f'!select "{name}"'


def unselect(name: str) -> str:
    """Return the command that stops the behaviour ``name`` if it runs."""
    return select("#" + name)


def format_setting(key: str, value: object) -> str:
    """Return the command that changes the dog's configuration."""
    return f"!set {key}={value}"


def make_greeting() -> list[str]:
    """Return the first commands: ask for the number of clients and the open menu."""
    return [HELLO, "!dump_stack", "!refresh"]


def make_start_commands(services: Iterable[str], transport: str, fps: float, width: int = 104) -> list[str]:
    """Return commands that set up and start ``services``; the answer to the last command confirms all commands.

    The commands try all names of each server; ``width`` is the width of the pictures in pixels.
    """
    lines = [
        format_setting("main.worldState_interval", 0),
        format_setting("vision.rawcam.transport", transport.upper()),
    ]
    lines += [format_setting("vision.rawcam.encoding", "color"), format_setting("vision.rawcam.compression", "jpeg")]
    lines += make_size_commands(width) + make_rate_commands(fps)
    lines += [select(name) for service in services for name in SERVERS[service]]
    return [*lines, HELLO]


def make_size_commands(width: int) -> list[str]:
    """Return commands that set the picture width in pixels; each camera layer halves the width of the layer above."""
    skip = {208: 1, 104: 2}[width]
    names = (f"vision.rawcam{mark}{channel}_skip" for mark in "._" for channel in ("y", "uv"))
    return [format_setting(name, skip + name.endswith("uv_skip")) for name in names]


def make_rate_commands(fps: float) -> list[str]:
    """Return commands that set the dog's wait after each picture: the frame interval minus half of ``PICTURE_MS``."""
    wait_ms = 0 if fps <= 0 or fps >= 29 else round(1000.0 / fps - PICTURE_MS / 2.0)
    return [format_setting("vision.rawcam.interval", wait_ms), format_setting("vision.rawcam_interval", wait_ms)]


def make_stop_commands(services: Iterable[str]) -> list[str]:
    """Return commands that stop ``services``."""
    return [unselect(name) for service in services for name in SERVERS[service]]


def make_sound_commands(name: str) -> list[str]:
    """Return commands that play a sound from the memory stick by its file name."""
    return [select("Play Sound"), select(name.upper())]


def encode_message(message: Message, has_four_fields: bool = False) -> bytes:
    """Encode ``message`` as the dog does."""
    return "".join(line + "\n" for line in _format_lines(message, has_four_fields)).encode("latin-1")


def _format_lines(message: Message, has_four_fields: bool) -> Iterator[str]:
    match message:
        case Refresh(title, items):
            yield from ("refresh", title, str(len(items)))
            for item in items:
                yield from (str(item.item_count), str(int(item.is_highlighted)), item.title)
                if not has_four_fields:
                    yield str(item.description.count("\n"))
                yield item.description
        case Status(text):
            yield from ("status", str(text.count("\n")), text)
        case Load(java, name, port, arguments):
            yield from ("load", java, name, str(port), arguments)
        case Close(name):
            yield from ("close", name)
        case Hello(count):
            yield from ("hello", str(count))
        case Stack(titles):
            yield from ("stack_dump", str(len(titles)), *titles)
        case OneWordMessage(word):
            yield word


class MenuReader:
    """Splits the stream of main control into messages; invalid lines are counted and dropped."""

    def __init__(self) -> None:
        self.bad_lines = 0
        self._lines = LineReader()
        self._parser: _Lines | None = None
        self._line_count = 0

    def read(self, data: bytes) -> Iterator[Message]:
        """Yield the messages that ``data`` completes."""
        before = self._lines.bad_lines
        for line in self._lines.read(data):
            try:
                message = self._feed(line)
            except BadFrame:
                self._parser = None
                self.bad_lines += 1
                continue
            if message is not None:
                self._parser = None
                yield message
        self.bad_lines += self._lines.bad_lines - before

    def _feed(self, line: str) -> Message | None:
        try:
            if self._parser is None:
                self._parser = _parse_message(line)
                self._line_count = 0
                next(self._parser)
            else:
                self._line_count += 1
                if self._line_count > MAX_MESSAGE_LINES:
                    raise BadFrame(f"message of more than {MAX_MESSAGE_LINES} lines")
                self._parser.send(line)
        except StopIteration as stop:
            done: Message = stop.value
            return done
        return None


def _parse_message(word: str) -> _Lines:
    """Receive the lines after ``word`` one by one, and return the message."""
    match word:
        case "push" | "pop" | "goodbye":
            return OneWordMessage(word)
        case "refresh":
            return (yield from _parse_refresh())
        case "status":
            return Status((yield from _parse_text(_parse_count((yield)))))
        case "load":
            java, name, port, arguments = (yield), (yield), (yield), (yield)
            return Load(java, name, _parse_count(port, 65535), arguments)
        case "close":
            return Close((yield))
        case "hello":
            return Hello(_parse_count((yield), 2**31))
        case "stack_dump":
            titles = []
            for _ in range(_parse_count((yield))):
                titles.append((yield))
            return Stack(tuple(titles))
    raise BadFrame(f"unknown message of main control: {word!r}")


def _parse_refresh() -> _Lines:
    title = yield
    items: list[Item] = []
    has_four_fields = False
    for number in range(_parse_count((yield))):
        held, lit, name, fourth = (yield), (yield), (yield), (yield)
        if number == 0:
            has_four_fields = not fourth.isdecimal()
        description = fourth if has_four_fields else (yield from _parse_text(_parse_count(fourth)))
        items.append(Item(_parse_count(held, 2**31), lit == "1", name, description))
    return Refresh(title, tuple(items))


def _parse_text(more: int) -> Generator[None, str, str]:
    lines = []
    for _ in range(more + 1):
        lines.append((yield))
    return "\n".join(lines)


def _parse_count(line: str, limit: int = MAX_COUNT) -> int:
    if not (line.isascii() and line.isdecimal()) or len(line) > 10 or int(line) > limit:
        raise BadFrame(f"{line!r} is not a number from 0 to {limit}")
    return int(line)
