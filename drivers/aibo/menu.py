"""Menu: the text of main control (port 10020), both ways; pure.

Commands are lines; what comes back are words on lines of their own, each with a known number of lines after it.  The
menu (``refresh``) has five fields an item, or four from Tekkotsu 2.x, which shows in its first item.

The servers are called differently in each generation of Tekkotsu: each name is sent, and the dog ignores those that
it does not know.  A running server is called ``#name``, so starting it again does nothing.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass

from drivers.aibo.codec import LineReader
from drivers.errors import BadFrame

MAX_LINES = 256
MAX_MESSAGE = 4096
"""No menu of a dog has so many lines."""
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
    """One entry of a menu: how many it holds itself, whether it is highlighted, its name, and what it says of it."""

    items: int
    is_lit: bool
    title: str
    description: str = ""


@dataclass(frozen=True)
class Refresh:
    """The menu as it is now."""

    title: str
    items: tuple[Item, ...]


@dataclass(frozen=True)
class Status:
    """Some lines for people."""

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
    """The server called so is closing."""

    name: str


@dataclass(frozen=True)
class Hello:
    """The answer to ``!hello``: so many clients there have been."""

    count: int


@dataclass(frozen=True)
class Stack:
    """Through which menus one came here."""

    titles: tuple[str, ...]


@dataclass(frozen=True)
class Word:
    """A message of one word: ``push`` and ``pop`` for a menu that opens and closes, ``goodbye`` at the end."""

    word: str


Message = Refresh | Status | Load | Close | Hello | Stack | Word
_Lines = Generator[None, str, Message]


def select(name: str) -> str:
    """The command that activates the item of this name; an idempotent start, as a running one is called ``#name``."""
    return f'!select "{name}"'


def unselect(name: str) -> str:
    """The command that stops the behaviour of this name if it runs."""
    return select("#" + name)


def setting(key: str, value: object) -> str:
    """The command that changes the dog's configuration."""
    return f"!set {key}={value}"


def greeting() -> list[str]:
    """What is asked first: who is there, and which menu is open."""
    return [HELLO, "!dump_stack", "!refresh"]


def started(services: Iterable[str], transport: str, fps: float, width: int = 104) -> list[str]:
    """Settings, then the servers, in both spellings of each; the last line's answer says that all before were read."""
    lines = [setting("main.worldState_interval", 0), setting("vision.rawcam.transport", transport.upper())]
    lines += [setting("vision.rawcam.encoding", "color"), setting("vision.rawcam.compression", "jpeg")]
    lines += sized(width) + paced(fps)
    lines += [select(name) for service in services for name in SERVERS[service]]
    return [*lines, HELLO]


def sized(width: int) -> list[str]:
    """The width of the pictures, in pixels: each layer of the camera is half as wide as the one above."""
    skip = {208: 1, 104: 2}[width]
    names = (f"vision.rawcam{mark}{channel}_skip" for mark in "._" for channel in ("y", "uv"))
    return [setting(name, skip + name.endswith("uv_skip")) for name in names]


def paced(fps: float) -> list[str]:
    """The camera's pace: the dog waits from the end of one picture on, so half a picture is taken off the wait."""
    wait_ms = 0 if fps <= 0 or fps >= 29 else round(1000.0 / fps - PICTURE_MS / 2.0)
    return [setting("vision.rawcam.interval", wait_ms), setting("vision.rawcam_interval", wait_ms)]


def stopped(services: Iterable[str]) -> list[str]:
    """What stops these servers."""
    return [unselect(name) for service in services for name in SERVERS[service]]


def sound(name: str) -> list[str]:
    """What plays a sound from the stick, under the name that its file has there."""
    return [select("Play Sound"), select(name.upper())]


def encoded(message: Message, has_four_fields: bool = False) -> bytes:
    """The lines of ``message`` as the dog writes them."""
    return "".join(line + "\n" for line in _written(message, has_four_fields)).encode("latin-1")


def _written(message: Message, has_four_fields: bool) -> Iterator[str]:
    match message:
        case Refresh(title, items):
            yield from ("refresh", title, str(len(items)))
            for item in items:
                yield from (str(item.items), str(int(item.is_lit)), item.title)
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
        case Word(word):
            yield word


class MenuReader:
    """Cuts the stream of main control into messages, however it is cut; lines that are none are counted and dropped."""

    def __init__(self) -> None:
        self.bad_lines = 0
        self._lines = LineReader()
        self._open: _Lines | None = None
        self._taken = 0

    def read(self, data: bytes) -> Iterator[Message]:
        """Yield the messages that ``data`` completes."""
        before = self._lines.bad_lines
        for line in self._lines.read(data):
            try:
                message = self._fed(line)
            except BadFrame:
                self._open = None
                self.bad_lines += 1
                continue
            if message is not None:
                self._open = None
                yield message
        self.bad_lines += self._lines.bad_lines - before

    def _fed(self, line: str) -> Message | None:
        try:
            if self._open is None:
                self._open = _message(line)
                self._taken = 0
                next(self._open)
            else:
                self._taken += 1
                if self._taken > MAX_MESSAGE:
                    raise BadFrame("a message without an end")
                self._open.send(line)
        except StopIteration as stop:
            done: Message = stop.value
            return done
        return None


def _message(word: str) -> _Lines:
    """Takes the lines after ``word`` one by one, and ends with the message."""
    match word:
        case "push" | "pop" | "goodbye":
            return Word(word)
        case "refresh":
            return (yield from _refresh())
        case "status":
            return Status((yield from _text(_count((yield)))))
        case "load":
            java, name, port, arguments = (yield), (yield), (yield), (yield)
            return Load(java, name, _count(port, 65535), arguments)
        case "close":
            return Close((yield))
        case "hello":
            return Hello(_count((yield), 2**31))
        case "stack_dump":
            titles = []
            for _ in range(_count((yield))):
                titles.append((yield))
            return Stack(tuple(titles))
    raise BadFrame(f"{word!r} is no message of main control")


def _refresh() -> _Lines:
    title = yield
    items: list[Item] = []
    has_four_fields = False
    for number in range(_count((yield))):
        held, lit, name, fourth = (yield), (yield), (yield), (yield)
        if number == 0:
            has_four_fields = not fourth.isdecimal()
        description = fourth if has_four_fields else (yield from _text(_count(fourth)))
        items.append(Item(_count(held, 2**31), lit == "1", name, description))
    return Refresh(title, tuple(items))


def _text(more: int) -> Generator[None, str, str]:
    lines = []
    for _ in range(more + 1):
        lines.append((yield))
    return "\n".join(lines)


def _count(line: str, limit: int = MAX_LINES) -> int:
    if not (line.isascii() and line.isdecimal()) or len(line) > 10 or int(line) > limit:
        raise BadFrame(f"{line!r} is no count up to {limit}")
    return int(line)
