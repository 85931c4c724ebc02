"""A node of this library on real UDP, encrypted, with its store in memory or in a SQLite file."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Callable
from typing import Any

from twisted.internet import reactor as _reactor
from twisted.internet.defer import Deferred, maybeDeferred

from benchmarks.dht.library import HOST, Cancel, OnDone, OnValue
from middleware.entangled.clock import use_monotonic_time
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.data.sqlite import SqliteStore
from middleware.entangled.data.store import Durability, Store
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.entangled.network.udp import UdpNetwork
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, hash_key
from middleware.entangled.space.tuplespace import TupleSpace

TEAM_KEY = b"the key of a team that only runs"
NAME = "bench"
JOIN_DELAY_S = 0.2
"""Seconds to wait until the replicas have registered a watch, which a watch does not report."""
reactor: Any = _reactor


class LossyUdp(UdpNetwork):
    """Real UDP that drops the share ``share`` of the sent datagrams."""

    loss_share = 0.0

    def send(self, datagram: bytes, to: Address) -> None:
        """Send or drop a datagram."""
        if not self.loss_share or random.random() >= self.loss_share:
            super().send(datagram, to)


class SwarmPeer:
    """A node of this library; ``store`` is "memory", "sqlite", or "crash" (SQLite that does not wait for the disk)."""

    def __init__(self, folder: str, store: str = "memory") -> None:
        use_monotonic_time()
        self._folder = folder if store != "memory" else ""
        self._durable: Durability = "crash" if store == "crash" else "power"
        self._rng = random.SystemRandom()
        self._space: Any = None

    def run(self, begin: Callable[[], None]) -> None:
        """Run the reactor."""
        reactor.callWhenRunning(begin)
        reactor.run(installSignalHandlers=False)

    def call_soon(self, call: Callable[..., object], *arguments: object) -> None:
        """Schedule a call in the reactor from any thread."""
        reactor.callFromThread(call, *arguments)

    def call_later(self, seconds: float, call: Callable[..., object], *arguments: object) -> Cancel:
        """Schedule a call after ``seconds``."""
        timer = reactor.callLater(seconds, call, *arguments)
        return lambda: timer.cancel() if timer.active() else None

    def start(self, port: int, known: int, done: Callable[[], None]) -> None:
        """Build the node and join."""
        store: Store = MemoryStore()
        if self._folder:
            path = os.path.join(self._folder, f"{port}.sqlite")
            store = SqliteStore.open(path, time.monotonic(), deliver=reactor.callFromThread, durable=self._durable)
        self._network = LossyUdp(reactor, HOST, port)
        identity = Identity(self._rng.randbytes(32))
        self._node = EntangledNode(identity, TEAM_KEY, self._network, store, reactor, self._rng)
        self._node.start()
        self._node.join([Address(HOST, known)] if known else []).addCallback(lambda _: done())

    def put(self, key: str, value: bytes, done: OnDone) -> None:
        """Store; call ``done`` when a majority of the replicas has it."""
        _report_result(maybeDeferred(self._node.put, hash_key(key), NAME, value), lambda held: done(held is not None))

    def get(self, key: str, value: bytes, done: OnValue) -> None:
        """Read; the first answer counts, as with the other libraries."""
        _report_result(self._node.get(hash_key(key), "fast"), lambda found: done(found[0].value if found else None))

    def list_held(self, keys: list[str]) -> list[bool | None]:
        """Look into the store."""
        return [bool(self._node.store.get(hash_key(key))) for key in keys]

    def watch(self, key: str, heard: OnValue, done: Callable[[], None]) -> None:
        """Watch."""

        def changed(records: list[Record]) -> None:
            for record in records:
                heard(record.value)

        self._node.watch(hash_key(key), changed)
        self.call_later(JOIN_DELAY_S, done)

    def run_space_operation(self, verb: str, fields: list[object], limit_s: float, done: OnDone) -> None:
        """Execute ``verb`` in the tuple space; "open" makes this node a member of it."""
        if self._space is None:
            self._space = TupleSpace(self._node, reactor, self._rng, NAME)
        if verb == "open":
            done(True)
        elif verb == "put":
            self._space.put(tuple(fields)).addCallbacks(lambda _: done(True), lambda _: done(False))
        else:
            waiting = {"timeout": limit_s} if verb in ("get", "read") else {}
            template = tuple(int if field is None else field for field in fields)
            _report_result(getattr(self._space, verb)(template, **waiting), lambda found: done(found is not None))

    def drop_datagrams(self, share: float) -> None:
        """Drop datagrams."""
        self._network.loss_share = share


def _report_result(outcome: Deferred[Any], on_result: Callable[[Any], object]) -> None:
    outcome.addErrback(lambda _: None).addCallback(on_result)
