"""A node of the ``kademlia`` package with default settings (k = 20, 5 s per request, store in memory)."""

from __future__ import annotations

from collections.abc import Callable

from kademlia.network import Server
from kademlia.utils import digest

from benchmarks.dht.aio import AsyncioPeer
from benchmarks.dht.contestant import HOST, Done, Got


class KademliaPeer(AsyncioPeer):
    """A contestant."""

    def start(self, port: int, known: int, done: Callable[[], None]) -> None:
        """Listen, and bootstrap."""
        self._server = Server()

        async def up() -> None:
            await self._server.listen(port, HOST)
            if known:
                await self._server.bootstrap([(HOST, known)])

        self.fork(up(), lambda _: done())

    def put(self, key: str, value: bytes, done: Done) -> None:
        """Store; the library waits for every replica."""
        self.fork(self._server.set(key, value), lambda ok: done(bool(ok)))

    def get(self, key: str, value: bytes, done: Got) -> None:
        """Read; from the own store if it has the key."""
        self.fork(self._server.get(key), done)

    def holds(self, keys: list[str]) -> list[bool | None]:
        """Look into the store."""
        return [self._server.storage.get(digest(key)) is not None for key in keys]
