"""A node of the ``kademlia`` package with default settings (k = 20, 5 s per request, store in memory)."""

from __future__ import annotations

from collections.abc import Callable

from kademlia.network import Server
from kademlia.utils import digest

from benchmarks.dht.aio import AsyncioPeer
from benchmarks.dht.library import HOST, OnDone, OnValue


class KademliaPeer(AsyncioPeer):
    """A node of the library ``kademlia``."""

    def start(self, port: int, known: int, done: Callable[[], None]) -> None:
        """Listen, and bootstrap."""
        self._server = Server()

        async def up() -> None:
            await self._server.listen(port, HOST)
            if known:
                await self._server.bootstrap([(HOST, known)])

        self.run_in_thread(up(), lambda _: done())

    def put(self, key: str, value: bytes, done: OnDone) -> None:
        """Store; the library waits for every replica."""
        self.run_in_thread(self._server.set(key, value), lambda ok: done(bool(ok)))

    def get(self, key: str, value: bytes, done: OnValue) -> None:
        """Read, from this node's store if it contains the key."""
        self.run_in_thread(self._server.get(key), done)

    def list_held(self, keys: list[str]) -> list[bool | None]:
        """Look into the store."""
        return [self._server.storage.get(digest(key)) is not None for key in keys]
