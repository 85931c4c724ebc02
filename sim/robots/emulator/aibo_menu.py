"""Main control of an emulated AIBO: the menu of its servers."""

from __future__ import annotations

import shlex
from collections.abc import Callable

from drivers.aibo.codec import LineReader
from drivers.aibo.menu import (
    EMPTY_SLOT,
    Close,
    Hello,
    Item,
    Load,
    Message,
    OneWordMessage,
    Refresh,
    Stack,
    Status,
    encode_message,
)

CLASSES = {
    "estop": ("", ""),
    "state": ("org.tekkotsu.mon.WorldStateRecordGUI", "World State"),
    "walk": ("org.tekkotsu.mon.WalkGUI", "WalkGUI"),
    "head": ("org.tekkotsu.mon.HeadPointGUI", "HeadPointGUI"),
    "camera": ("org.tekkotsu.mon.VisionGUI", "RawVisionGUI"),
}
"""The Java class and the name that a client loads for each server."""
NAMES = {
    "estop": "EStopControllerBehavior",
    "state": "World State Serializer",
    "walk": "Walk Remote Control",
    "head": "Head Remote Control",
    "camera": "Raw Cam Server",
}
OLD_NAMES = {**NAMES, "estop": "EStop Remote Control"}


class AiboMenu:
    """Answers commands; calls ``on_server`` when a server starts or stops, and ``on_setting`` for each setting."""

    def __init__(
        self,
        ports: dict[str, int],
        is_old: bool,
        on_server: Callable[[str, bool], None],
        on_setting: Callable[[str, str], None],
    ) -> None:
        self.running: set[str] = set()
        self.settings: dict[str, str] = {}
        self.played_sounds: list[str] = []
        self.clients = 0
        self._ports = ports
        self._is_old = is_old
        self._names = OLD_NAMES if is_old else NAMES
        self._on_server = on_server
        self._on_setting = on_setting
        self._lines = LineReader()
        self.reset()

    def reset(self) -> None:
        """Restore the state after power-on: only the emergency stop runs, or no server on a dog with Tekkotsu 2.x."""
        self.running = set() if self._is_old else {"estop"}
        self.settings.clear()

    def add_client(self) -> None:
        """Count a new client."""
        self._lines = LineReader()
        self.clients += 1

    def make_answer(self, data: bytes) -> bytes:
        """Return the answer to these bytes."""
        output = b""
        for line in self._lines.read(data):
            output += b"".join(encode_message(message, self._is_old) for message in self._answer(line))
        return output

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
                return [self._make_menu()]
            case ["!select", name]:
                return self._select(name)
            case ["!set", *rest]:
                key, _, value = " ".join(rest).partition("=")
                self.settings[key] = value
                self._on_setting(key, value)
                return []
        return [Status(f"unknown command\n{line}")]

    def _select(self, name: str) -> list[Message]:
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
                return [OneWordMessage("push"), *loads, OneWordMessage("pop"), self._make_menu(), self._make_menu()]
            if name == "#" + title and service in self.running:
                self.running.discard(service)
                self._on_server(service, False)
                return [Close(instance), self._make_menu()]
        if name.endswith((".WAV", ".MOT")):
            self.played_sounds.append(name)
        return [self._make_menu()]

    def _make_menu(self) -> Refresh:
        items = [Item(0, False, EMPTY_SLOT), Item(2, True, "Mode Switch", 'Contains\nthe "major"\nmodes')]
        for service, title in self._names.items():
            shown = ("#" if service in self.running else "") + title
            items.append(Item(0, False, shown, f"serves port {self._ports[service]}"))
        if self._is_old:
            items = [
                Item(item.item_count, item.is_highlighted, item.title, item.description.replace("\n", " "))
                for item in items
            ]
        return Refresh("TekkotsuMon", tuple(items))
