"""The contestants: their guarantees, and the interface of a node."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

HOST = "127.0.0.1"
MIB = 1 << 20

Done = Callable[[bool], None]
Got = Callable[[bytes | None], None]
Prevent = Callable[[], None]


class Contestant(Protocol):
    """One node of one library, in a separate process; every callback runs in the library's loop.

    Unsupported operations raise ``NotImplementedError``.
    """

    def run(self, begin: Callable[[], None]) -> None:
        """Run the loop forever, and call ``begin`` inside it once."""

    def soon(self, call: Callable[..., object], *arguments: object) -> None:
        """Schedule a call in the loop from any thread."""

    def later(self, seconds: float, call: Callable[..., object], *arguments: object) -> Prevent:
        """Schedule a call after ``seconds``; return a function that cancels it."""

    def start(self, port: int, known: int, done: Callable[[], None]) -> None:
        """Build the node on ``port`` and join through the port ``known`` (0: first node); call ``done`` when joined."""

    def put(self, key: str, value: bytes, done: Done) -> None:
        """Store; call back with whether the library reports the value as stored."""

    def get(self, key: str, value: bytes, done: Got) -> None:
        """Read; only libraries whose key is the hash of the value use ``value``."""

    def holds(self, keys: list[str]) -> list[bool | None]:
        """Return whether this node stores each of ``keys``, None if the library cannot tell. Called while idle."""

    def watch(self, key: str, heard: Got, done: Callable[[], None]) -> None:
        """Call ``heard`` with each new value of ``key``; call ``done`` when the watch is active."""

    def space(self, verb: str, fields: list[object], limit_s: float, done: Done) -> None:
        """Execute ``verb`` in the tuple space, within ``limit_s``; in a template None stands for any integer."""

    def lose(self, share: float) -> None:
        """Drop this share of the datagrams sent from now on."""


@dataclass(frozen=True)
class Entry:
    """One column of the comparison.

    ``package`` is the module that must be importable; ``promise`` is the guarantee of a finished put; ``largest`` is
    the documented maximum length of a value in bytes; ``survives`` names the failures that a store on disk survives, if
    it does not survive a loss of power; ``can`` names its features in addition to put and get.
    """

    name: str
    module: str
    maker: str
    options: tuple[str, ...]
    package: str
    promise: str
    largest: int
    is_sealed: bool = False
    is_on_disk: bool = False
    survives: str = ""
    can: tuple[str, ...] = ()

    @property
    def behind(self) -> str:
        """The encryption and storage of the library."""
        disk = f"SQLite{self.survives}" if self.is_on_disk else "memory"
        return f"{'sealed' if self.is_sealed else 'clear text'}, {disk}"

    @property
    def is_installed(self) -> bool:
        """Return whether its library can be imported."""
        return importlib.util.find_spec(self.package) is not None

    def made(self, folder: str) -> Contestant:
        """Create a node; ``folder`` is for its files."""
        maker = getattr(importlib.import_module(f"benchmarks.dht.{self.module}"), self.maker)
        contestant: Contestant = maker(folder, *self.options)
        return contestant


OURS = "swarm-sqlite"
OURS_IN_MEMORY = "swarm-memory"

_EIGHT = "at least one of 8 took it"
_FIVE = "5 of 8 hold it"
_VERBS = ("watch", "space", "lose")
ENTRIES = {
    entry.name: entry
    for entry in (
        Entry(OURS, "swarm", "SwarmPeer", ("sqlite",), "nacl", _FIVE, MIB, True, True, "", _VERBS),
        Entry("swarm-crash", "swarm", "SwarmPeer", ("crash",), "nacl", _FIVE, MIB, True, True, " (crash only)", _VERBS),
        Entry(OURS_IN_MEMORY, "swarm", "SwarmPeer", (), "nacl", _FIVE, MIB, True, False, "", _VERBS),
        Entry("kademlia", "kademlia", "KademliaPeer", (), "kademlia", "all 20 were asked, one took it", 8000),
        Entry("opendht", "opendht", "OpenDhtPeer", (), "opendht", _EIGHT, 65_000, can=("watch",)),
        Entry("opendht-free", "opendht", "OpenDhtPeer", ("free",), "opendht", _EIGHT, 65_000, can=("watch",)),
        Entry("libtorrent", "libtorrent", "LibtorrentPeer", (), "libtorrent", _EIGHT, 990),
        Entry("libtorrent-free", "libtorrent", "LibtorrentPeer", ("free",), "libtorrent", _EIGHT, 990),
    )
}


def chosen(words: str) -> list[Entry]:
    """Return the entries named by ``words`` (comma-separated): "opendht" with its variants; raises ``ValueError``."""
    found: dict[str, Entry] = {}
    for word in words.split(","):
        named = {n: e for n, e in ENTRIES.items() if word == n or word == n.partition("-")[0]}
        if not named:
            raise ValueError(f"--peers: {word} is unknown; choose from {', '.join(ENTRIES)}")
        found |= named
    return [entry for name, entry in ENTRIES.items() if name in found]
