"""Provide the node that the fuzz targets attack, and the checks after every input.

``state_of`` hashes the complete state of a node by walking its objects, so new attributes are included automatically.
It excludes the counters (including the handshake rate), the random generator, the clock and the network.
"""

from __future__ import annotations

import hashlib
import random
from collections import deque
from collections.abc import Callable
from types import FunctionType, MethodType
from typing import Any

from twisted.logger import ILogObserver, LogLevel, globalLogPublisher
from zope.interface import implementer

from middleware.entangled.clock import HeapClock
from middleware.entangled.contact import Contact
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address, Network
from middleware.entangled.network.switchboard import Switchboard
from middleware.entangled.node import EntangledNode
from middleware.entangled.wire.admission_check import OPEN_ADMISSION, AdmissionCheck
from middleware.entangled.wire.endpoint import Endpoint
from middleware.entangled.wire.fragmenter import MAX_IN_PER_PEER_BYTES

TEAM = b"k" * 32
STRANGER = Address("10.0.0.9", 999)
LEFT_OUT = (
    "admission",
    "counters",
    "_counters",
    "_rng",
    "_network",
    "_clock",
    "_log",
    "_limit",
    "_cookie_limit",
    "_bucket",
)
PLAIN = frozenset((bytes, str, int, float, bool, type(None)))
APART = (FunctionType, MethodType, type, random.Random, HeapClock, Switchboard)
"""Types that are not part of a node's state."""


class Violation(AssertionError):
    """Raised if an input had a forbidden effect."""


@implementer(ILogObserver)
class Ground:
    """A node ``target`` and a member ``other`` that share a session and use the same ``admission`` check.

    All datagrams to the target are recorded.
    """

    def __init__(self, admission: AdmissionCheck = OPEN_ADMISSION) -> None:
        self.room = admission.max_pass_bytes
        self.errors: list[str] = []
        self.known = ""  # the hash after the last input, for targets that do not advance the clock
        self._is_shooting = False
        self.clock = HeapClock()
        self.switchboard = Switchboard(self.clock, random.Random(1))
        self.recorded: list[bytes] = []
        self.sent: list[tuple[bytes, Address]] = []
        self.network = self.switchboard.make_network("10.0.0.1", 1)
        self.store = MemoryStore(1000)
        self.node = EntangledNode(
            Identity(b"t" * 32),
            TEAM,
            self._tapped(self.network),
            self.store,
            self.clock,
            random.Random(2),
            1.0,
            None,
            admission,
        )
        self.target = self.node.endpoint
        self.node.start()
        self.target.expose("echo", lambda peer, value: value)
        self.target.expose("add", lambda peer, value: value, changes=True)
        self.contact = Contact(Identity(b"t" * 32).public, self.network.address)
        self.identity = Identity(b"o" * 32)
        self.other = Endpoint(
            self.identity, TEAM, self.switchboard.make_network("10.0.0.2", 2), self.clock, random.Random(3), admission
        )
        self.other.start()
        self.other.expose("ping", lambda peer: "pong", changes=True)
        for method, value in (("echo", b"1"), ("add", bytes(3000))):
            self.other.ask(self.contact, method, value, changes=method == "add")
            self.clock.advance(0.5)
        self.other.discover(self.contact.address).addErrback(lambda failure: None)
        self.clock.advance(0.5)

    def stop(self) -> None:
        """Stop both nodes, which cancels their timers."""
        self.node.stop_silently()
        self.other.stop()

    def shoot(self, datagram: bytes, source: Address = STRANGER) -> int:
        """Deliver one datagram to the target; return the number of bytes that it sends to ``source``."""
        self.sent.clear()
        self._is_shooting = True
        receiver = self.network.receiver
        assert receiver is not None
        globalLogPublisher.addObserver(self)
        try:
            receiver(datagram, source)
        finally:
            globalLogPublisher.removeObserver(self)
            self._is_shooting = False
        if self.errors:
            raise Violation(f"logged: {self.errors}")
        fragmenter = self.target._fragmenter
        if fragmenter._bytes_in.total() > MAX_IN_PER_PEER_BYTES:
            raise Violation("more is in assembly than one peer may have")
        return sum(len(datagram) for datagram, to in self.sent if to == source)

    def state(self) -> str:
        """Return the hash of the target's state: tables, store, sessions, pending calls and timers."""
        timers = sorted(call.getTime() for call in self.clock.getDelayedCalls())
        return state_of([self.node, self.store, timers])

    def _tapped(self, network: Any) -> Network:
        listen, send = network.listen, network.send

        def tapped(receiver: Callable[[bytes, Address], None]) -> None:
            def receive(datagram: bytes, source: Address) -> None:
                if len(self.recorded) < 40:
                    self.recorded.append(datagram)
                receiver(datagram, source)

            listen(receive)

        def noted(datagram: bytes, to: Address) -> None:
            self.sent.append((datagram, to))
            if not self._is_shooting:  # a datagram in transit would be part of the hashed state
                send(datagram, to)

        network.listen, network.send = tapped, noted
        tapped_network: Network = network
        return tapped_network

    def __call__(self, event: Any) -> None:
        """Record the warnings that an input causes, except rejections of peers, which have a ``code``."""
        if event["log_level"] >= LogLevel.warn and "code" not in event:
            self.errors.append(str(event.get("log_format")))


def state_of(thing: object, without: object = None) -> str:
    """Return the hash of every object that is reachable from ``thing`` by a path without objects in ``without``."""
    said: list[str] = []
    _walk(thing, said.append, {id(without): -1})
    return hashlib.blake2b(";".join(said).encode(), digest_size=16).hexdigest()


def _walk(thing: object, say: Callable[[str], None], seen: dict[int, int]) -> None:
    kind = type(thing)
    if kind in PLAIN:
        say(f"{kind.__name__} {thing!r}")
        return
    if id(thing) in seen:
        say(f"again {seen[id(thing)]}")
        return
    if isinstance(thing, APART):
        return
    seen[id(thing)] = len(seen)
    if isinstance(thing, dict):
        say(f"dict {len(thing)}")
        for key, value in thing.items():
            _walk(key, say, seen)
            _walk(value, say, seen)
    elif isinstance(thing, (list, tuple, deque)):
        say(f"{kind.__name__} {len(thing)}")
        for item in thing:
            _walk(item, say, seen)
    elif isinstance(thing, (set, frozenset)):
        say(f"set {sorted(map(repr, thing))}")
    elif kind.__module__.startswith(("middleware.", "tests.")):
        say(kind.__name__)
        slots = (name for one in kind.__mro__ for name in getattr(one, "__slots__", ()))
        for name in (*getattr(thing, "__dict__", ()), *slots):
            value = getattr(thing, name, LEFT_OUT)
            if name not in LEFT_OUT and value is not LEFT_OUT:
                say(name)
                _walk(value, say, seen)
