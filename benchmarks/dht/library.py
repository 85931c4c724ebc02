"""The compared libraries, their guarantees, and the interface of a node."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

HOST = "127.0.0.1"
MIB = 1 << 20

OnDone = Callable[[bool], None]
OnValue = Callable[[bytes | None], None]
Cancel = Callable[[], None]


class LibraryNode(Protocol):
    """One node of one library, in a separate process; every callback runs in the library's loop.

    Unsupported operations raise ``NotImplementedError``.
    """

    def run(self, begin: Callable[[], None]) -> None:
        """Run the loop forever, and call ``begin`` inside it once."""

    def call_soon(self, call: Callable[..., object], *arguments: object) -> None:
        """Schedule a call in the loop from any thread."""

    def call_later(self, seconds: float, call: Callable[..., object], *arguments: object) -> Cancel:
        """Schedule a call after ``seconds``; return a function that cancels it."""

    def start(self, port: int, known: int, done: Callable[[], None]) -> None:
        """Build the node on ``port`` and join through the port ``known`` (0: first node); call ``done`` when joined."""

    def put(self, key: str, value: bytes, done: OnDone) -> None:
        """Store; call back with whether the library reports the value as stored."""

    def get(self, key: str, value: bytes, done: OnValue) -> None:
        """Read; ``value`` is used only by libraries whose key is the hash of the value."""

    def list_held(self, keys: list[str]) -> list[bool | None]:
        """Return whether this node stores each of ``keys``, None if the library cannot tell. Called while idle."""

    def watch(self, key: str, heard: OnValue, done: Callable[[], None]) -> None:
        """Call ``heard`` with each new value of ``key``; call ``done`` when the watch is active."""

    def run_space_operation(self, verb: str, fields: list[object], limit_s: float, done: OnDone) -> None:
        """Execute ``verb`` in the tuple space, within ``limit_s``; in a template None stands for any integer."""

    def drop_datagrams(self, share: float) -> None:
        """Drop this share of the datagrams sent from now on."""


@dataclass(frozen=True)
class Library:
    """One column of the comparison.

    ``package`` is the module that must be importable; ``guarantee`` is the guarantee of a finished put; ``largest`` is
    the documented maximum length of a value in bytes; ``survives`` lists the failures that a store on disk survives, if
    a loss of power is not one of them; ``features`` lists the features besides put and get.
    """

    name: str
    module: str
    class_name: str
    options: tuple[str, ...]
    package: str
    guarantee: str
    largest: int
    is_encrypted: bool = False
    is_on_disk: bool = False
    survives: str = ""
    features: tuple[str, ...] = ()

    @property
    def storage(self) -> str:
        """The encryption and storage of the library."""
        disk = f"SQLite{self.survives}" if self.is_on_disk else "memory"
        return f"{'sealed' if self.is_encrypted else 'clear text'}, {disk}"

    @property
    def is_installed(self) -> bool:
        """Return whether the library can be imported."""
        return importlib.util.find_spec(self.package) is not None

    def make_node(self, folder: str) -> LibraryNode:
        """Create a node; ``folder`` is for its files."""
        maker = getattr(importlib.import_module(f"benchmarks.dht.{self.module}"), self.class_name)
        node: LibraryNode = maker(folder, *self.options)
        return node


OURS = "swarm-sqlite"
OURS_IN_MEMORY = "swarm-memory"

_EIGHT = "at least one of 8 took it"
_FIVE = "5 of 8 hold it"
_ALL_FEATURES = ("watch", "space", "lose")
LIBRARIES = {
    entry.name: entry
    for entry in (
        Library(OURS, "swarm", "SwarmPeer", ("sqlite",), "nacl", _FIVE, MIB, True, True, "", _ALL_FEATURES),
        Library(
            "swarm-crash",
            "swarm",
            "SwarmPeer",
            ("crash",),
            "nacl",
            _FIVE,
            MIB,
            True,
            True,
            " (crash only)",
            _ALL_FEATURES,
        ),
        Library(OURS_IN_MEMORY, "swarm", "SwarmPeer", (), "nacl", _FIVE, MIB, True, False, "", _ALL_FEATURES),
        Library("kademlia", "kademlia", "KademliaPeer", (), "kademlia", "all 20 were asked, one took it", 8000),
        Library("opendht", "opendht", "OpenDhtPeer", (), "opendht", _EIGHT, 65_000, features=("watch",)),
        Library("opendht-free", "opendht", "OpenDhtPeer", ("free",), "opendht", _EIGHT, 65_000, features=("watch",)),
        Library("libtorrent", "libtorrent", "LibtorrentPeer", (), "libtorrent", _EIGHT, 990),
        Library("libtorrent-free", "libtorrent", "LibtorrentPeer", ("free",), "libtorrent", _EIGHT, 990),
    )
}


def select_libraries(words: str) -> list[Library]:
    """Return the entries named by ``words`` (comma-separated): "opendht" with its variants; raises ``ValueError``."""
    found: dict[str, Library] = {}
    for word in words.split(","):
        named = {n: e for n, e in LIBRARIES.items() if word == n or word == n.partition("-")[0]}
        if not named:
            raise ValueError(f"--peers: {word} is unknown; choose from {', '.join(LIBRARIES)}")
        found |= named
    return [entry for name, entry in LIBRARIES.items() if name in found]
