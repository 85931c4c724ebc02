"""A node of OpenDHT through its Python binding, with its request limits or without."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import opendht

from benchmarks.dht.aio import AsyncioPeer
from benchmarks.dht.library import HOST, OnDone, OnValue

JOIN_DELAY_S = 0.5
"""Seconds to wait until the replicas have registered a listen, which the binding does not report."""


class OpenDhtPeer(AsyncioPeer):
    """A node of OpenDHT; "free" removes the limits on requests per second, which all nodes of one address share."""

    def __init__(self, folder: str, limits: str = "") -> None:
        super().__init__(folder)
        self._config = opendht.DhtConfig()
        if limits == "free":
            self._config.setRateLimit(-1, -1)
        self._kept: list[Any] = []

    def start(self, port: int, known: int, done: Callable[[], None]) -> None:
        """Start the node's threads; the library does not report when it has joined."""
        self._node = opendht.DhtRunner()
        self._node.run(port=port, ipv4=HOST, ipv6="", config=self._config)
        if known:
            self._node.bootstrap(HOST, str(known))
        done()

    def put(self, key: str, value: bytes, done: OnDone) -> None:
        """Store."""
        self._node.put(opendht.InfoHash.get(key), opendht.Value(value), lambda ok, nodes: self.call_soon(done, ok))

    def get(self, key: str, value: bytes, done: OnValue) -> None:
        """Read the first value that arrives, and end the search."""
        is_open = True

        def finish(result: bytes | None) -> None:
            nonlocal is_open
            if is_open:
                is_open = False
                self.call_soon(done, result)

        def found(value: Any) -> bool:
            finish(bytes(value.data))
            return False

        self._node.get(opendht.InfoHash.get(key), found, lambda ok, nodes: finish(None))

    def watch(self, key: str, heard: OnValue, done: Callable[[], None]) -> None:
        """Listen."""

        def came(value: Any, is_expired: bool) -> bool:
            if not is_expired:
                self.call_soon(heard, bytes(value.data))
            return True

        self._kept.append((came, self._node.listen(opendht.InfoHash.get(key), came)))
        self.call_later(JOIN_DELAY_S, done)

    def list_held(self, keys: list[str]) -> list[bool | None]:
        """Read the log of the store, but never under load: the binding holds Python's global lock during the call."""
        log = self._node.getStorageLog()
        return [str(opendht.InfoHash.get(key)) in log for key in keys]
