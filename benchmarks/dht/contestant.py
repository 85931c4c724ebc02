"""Contestant: who is measured, what it promises, and what a node of it must be able to do."""

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
    """One node of one library, in a process of its own; every callback runs in the library's own loop.

    What a library cannot do raises ``NotImplementedError``.
    """

    def run(self, begin: Callable[[], None]) -> None:
        """Run the loop for good, with ``begin`` called inside it once."""

    def soon(self, call: Callable[..., object], *arguments: object) -> None:
        """Call from any thread into the loop."""

    def later(self, seconds: float, call: Callable[..., object], *arguments: object) -> Prevent:
        """Call after ``seconds``; returns what prevents it."""

    def start(self, port: int, known: int, done: Callable[[], None]) -> None:
        """Build the node on ``port`` and join through the port ``known`` (0: be the first); ``done`` when joined."""

    def put(self, key: str, value: bytes, done: Done) -> None:
        """Store, and say whether the library calls it stored."""

    def get(self, key: str, value: bytes, done: Got) -> None:
        """Read; ``value`` is only for libraries whose key is the hash of the value."""

    def holds(self, keys: list[str]) -> list[bool | None]:
        """Whether this node itself holds each of ``keys``; None where the library does not tell.  Asked while idle."""

    def watch(self, key: str, heard: Got, done: Callable[[], None]) -> None:
        """Call ``heard`` with each new value of ``key``; ``done`` when the watch stands."""

    def space(self, verb: str, fields: list[object], limit_s: float, done: Done) -> None:
        """Do ``verb`` in the tuple space, for ``limit_s`` at most; in a template None stands for any whole number."""

    def lose(self, share: float) -> None:
        """Lose this share of the datagrams that are sent from now on."""


@dataclass(frozen=True)
class Entry:
    """One column of the comparison.

    ``package`` is what must be importable; ``promise`` is what a finished put means; ``largest`` is the longest value
    that the library says it carries, in bytes; ``survives`` says of a store on disk if it is safe from less
    than a loss of power; ``can`` names what it has beside put and get.
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
        """What stands behind its figures: encryption, disk."""
        disk = f"SQLite{self.survives}" if self.is_on_disk else "memory"
        return f"{'sealed' if self.is_sealed else 'clear text'}, {disk}"

    @property
    def is_installed(self) -> bool:
        """Whether its library can be imported."""
        return importlib.util.find_spec(self.package) is not None

    def made(self, folder: str) -> Contestant:
        """A node; ``folder`` is for its files."""
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
    """The entries that ``words`` (with commas) name: "opendht" with its variants; raises ``ValueError``."""
    found: dict[str, Entry] = {}
    for word in words.split(","):
        named = {n: e for n, e in ENTRIES.items() if word == n or word == n.partition("-")[0]}
        if not named:
            raise ValueError(f"{word} is none of {', '.join(ENTRIES)}")
        found |= named
    return [entry for name, entry in ENTRIES.items() if name in found]
