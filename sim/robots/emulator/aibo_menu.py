"""AiboMenu: main control of an emulated dog: which servers run, what they are called, and what it says of that."""

from __future__ import annotations

import shlex
from collections.abc import Callable

from drivers.aibo.codec import LineReader
from drivers.aibo.menu import EMPTY_SLOT, Close, Hello, Item, Load, Message, Refresh, Stack, Status, Word, encoded

CLASSES = {
    "estop": ("", ""),
    "state": ("org.tekkotsu.mon.WorldStateRecordGUI", "World State"),
    "walk": ("org.tekkotsu.mon.WalkGUI", "WalkGUI"),
    "head": ("org.tekkotsu.mon.HeadPointGUI", "HeadPointGUI"),
    "camera": ("org.tekkotsu.mon.VisionGUI", "RawVisionGUI"),
}
"""What the dog has a client load for each server, and the name of that."""
NAMES = {
    "estop": "EStopControllerBehavior",
    "state": "World State Serializer",
    "walk": "Walk Remote Control",
    "head": "Head Remote Control",
    "camera": "Raw Cam Server",
}
OLD_NAMES = {**NAMES, "estop": "EStop Remote Control"}


class AiboMenu:
    """Answers lines; ``on_server`` is told of each server that starts or stops, ``on_setting`` of each setting."""

    def __init__(
        self,
        ports: dict[str, int],
        is_old: bool,
        on_server: Callable[[str, bool], None],
        on_setting: Callable[[str, str], None],
    ) -> None:
        self.running: set[str] = set()
        self.settings: dict[str, str] = {}
        self.played: list[str] = []
        self.clients = 0
        self._ports = ports
        self._is_old = is_old
        self._names = OLD_NAMES if is_old else NAMES
        self._on_server = on_server
        self._on_setting = on_setting
        self._lines = LineReader()
        self.reset()

    def reset(self) -> None:
        """The dog was switched on: only the e-stop runs, and on an old dog not even that."""
        self.running = set() if self._is_old else {"estop"}
        self.settings.clear()

    def client(self) -> None:
        """Somebody connected."""
        self._lines = LineReader()
        self.clients += 1

    def answers(self, data: bytes) -> bytes:
        """What the dog writes upon these bytes."""
        written = b""
        for line in self._lines.read(data):
            written += b"".join(encoded(message, self._is_old) for message in self._answer(line))
        return written

    def _answer(self, line: str) -> list[Message]:
        try:
            words = shlex.split(line)
        except ValueError:
            return [Status(f"Unbalanced quotes in {line}")]
        match words:
            case ["!hello"]:
                return [Hello(self.clients)]
            case ["!dump_stack"]:
                return [Stack(("Root Control",))]
            case ["!refresh" | "!reset"]:
                return [self._menu()]
            case ["!select", name]:
                return self._selected(name)
            case ["!set", *rest]:
                key, _, value = " ".join(rest).partition("=")
                self.settings[key] = value
                self._on_setting(key, value)
                return []
        return [Status(f"unknown command\n{line}")]

    def _selected(self, name: str) -> list[Message]:
        for service, title in self._names.items():
            java, instance = CLASSES[service]
            if name == title and service not in self.running:
                self.running.add(service)
                self._on_server(service, True)
                loads: list[Message] = []
                if java:
                    transport = self.settings.get("vision.rawcam.transport", "udp").lower()
                    arguments = f'"raw" "{self._ports[service]}" "{transport}"' if service == "camera" else ""
                    loads = [Load(java, instance, self._ports[service], arguments)]
                return [Word("push"), *loads, Word("pop"), self._menu(), self._menu()]
            if name == "#" + title and service in self.running:
                self.running.discard(service)
                self._on_server(service, False)
                return [Close(instance), self._menu()]
        if name.endswith((".WAV", ".MOT")):
            self.played.append(name)
        return [self._menu()]

    def _menu(self) -> Refresh:
        items = [Item(0, False, EMPTY_SLOT), Item(2, True, "Mode Switch", 'Contains\nthe "major"\nmodes')]
        for service, title in self._names.items():
            shown = ("#" if service in self.running else "") + title
            items.append(Item(0, False, shown, f"serves port {self._ports[service]}"))
        if self._is_old:
            items = [Item(item.items, item.is_lit, item.title, item.description.replace("\n", " ")) for item in items]
        return Refresh("TekkotsuMon", tuple(items))
