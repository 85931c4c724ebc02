"""Run one node of ``benchmarks.flood``: it calls the other node and reports its state.

It communicates with its parent process in lines of JSON: first ``ready`` with its port, then, for each line on standard
input, a report of the measurements since the previous one.
"""

from __future__ import annotations

import json
import os
import random
import sys
import time
from pathlib import Path
from typing import Any

from middleware.entangled.clock import use_monotonic_time

use_monotonic_time()

from twisted.internet import reactor as running  # noqa: E402
from twisted.internet.protocol import Protocol  # noqa: E402
from twisted.internet.stdio import StandardIO  # noqa: E402

from benchmarks.measure import read_memory_bytes  # noqa: E402
from middleware.admission.membership_file import MembershipFile  # noqa: E402
from middleware.admission.team import Team  # noqa: E402
from middleware.entangled.contact import Contact  # noqa: E402
from middleware.entangled.data.memory import MemoryStore  # noqa: E402
from middleware.entangled.network.network import Address  # noqa: E402
from middleware.entangled.network.udp import UdpNetwork  # noqa: E402
from middleware.entangled.node import EntangledNode  # noqa: E402

HEARTBEAT_S = 0.1
CALL_INTERVAL_S = 0.02
TICK_S = 0.02
MAX_RECORDED = 64
FLOOD_PREFIX = "127.66."
"""Source addresses of the flood."""
reactor: Any = running


class Node(Protocol):
    """A node of a closed team that calls another node fifty times a second and sends it ten heartbeats a second."""

    def __init__(self, path: Path, known: list[Address], others: list[str]) -> None:
        kept, store = MembershipFile(path), MemoryStore()
        rng = random.SystemRandom()
        self.team = Team(kept, store, time.time, rng)
        self.network = UdpNetwork(reactor, "127.0.0.1", 0)
        self.node = EntangledNode(
            self.team.identity,
            self.team.secret,
            self.network,
            store,
            reactor,
            rng,
            wall=time.time,
            admission=self.team.admission,
        )
        self.team.attach(self.node, reactor)
        self.endpoint = self.node.endpoint
        self.endpoint.expose("device.settings", lambda peer, value: value)
        self.endpoint.expose("stream.part", self._record_heartbeat)
        self._others = [bytes.fromhex(other) for other in others]
        self._recorded: list[str] = []
        self._bytes = {"in": 0, "out": 0, "count": 0}
        self._beat_at = 0.0
        self._tick_at = 0.0
        self._clear()
        self.node.start()
        self._count_traffic()
        self.team.start()
        self.node.join(known)
        for every, call in ((CALL_INTERVAL_S, self._call), (HEARTBEAT_S, self._send_heartbeat), (TICK_S, self._tick)):
            self._repeat(every, call)

    def _clear(self) -> None:
        self.calls = {"good": 0, "bad": 0}
        self.gaps: list[float] = []
        self.lags: list[float] = []
        self.trips: list[float] = []

    def connectionMade(self) -> None:
        """Report the address of this node."""
        self._send_line({"ready": self.network.address.port, "public": self.team.identity.public.hex()})

    def dataReceived(self, data: bytes) -> None:
        """Send a report for each line."""
        for _ in range(data.count(b"\n")):
            self._send_line(self._report())

    def connectionLost(self, reason: object = None) -> None:
        """Exit when the parent has exited."""
        if reactor.running:
            reactor.stop()

    def _send_line(self, what: dict[str, Any]) -> None:
        assert self.transport is not None
        self.transport.write(json.dumps(what).encode() + b"\n")

    def _count_traffic(self) -> None:
        receive, send = self.network._receiver, self.network.send
        assert receive is not None

        def received(datagram: bytes, source: Address) -> None:
            if source.host.startswith(FLOOD_PREFIX):
                self._bytes["in"] += len(datagram)
                self._bytes["count"] += 1
            elif len(self._recorded) < MAX_RECORDED:
                self._recorded.append(datagram.hex())
            receive(datagram, source)

        def sent(datagram: bytes, to: Address) -> None:
            if to.host.startswith(FLOOD_PREFIX):
                self._bytes["out"] += len(datagram)
            send(datagram, to)

        self.network._receiver, self.network.send = received, sent  # type: ignore[method-assign]

    def _repeat(self, every: float, call: Any) -> None:
        due = reactor.seconds()

        def again() -> None:
            nonlocal due
            due = max(due + every, reactor.seconds())
            call()
            reactor.callLater(max(0.0, due - reactor.seconds()), again)

        again()

    def _list_contacts(self) -> list[Contact]:
        return [contact for contact in self.node.overlay.contacts() if contact.public in self._others]

    def _call(self) -> None:
        started_at = reactor.seconds()
        value = os.urandom(16)

        def done(answer: object) -> None:
            self.calls["good" if answer == value else "bad"] += 1
            self.trips.append(reactor.seconds() - started_at)

        def failed(failure: object) -> None:
            self.calls["bad"] += 1

        for contact in self._list_contacts():
            self.node.call(contact, "device.settings", value).addCallbacks(done, failed)

    def _send_heartbeat(self) -> None:
        for contact in self._list_contacts():
            self.endpoint.notify(contact, "stream.part", "beat")

    def _record_heartbeat(self, peer: Contact, text: str) -> None:
        now = reactor.seconds()
        if self._beat_at:
            self.gaps.append(now - self._beat_at - HEARTBEAT_S)
        self._beat_at = now

    def _tick(self) -> None:
        now = reactor.seconds()
        if self._tick_at:
            self.lags.append(now - self._tick_at - TICK_S)
        self._tick_at = now

    def _report(self) -> dict[str, Any]:
        times = os.times()
        endpoint = self.endpoint
        half, nat = endpoint._half_open, self.node.nat
        report = {
            "at": reactor.seconds(),
            "cpu": times.user + times.system,
            "rss": read_memory_bytes(),
            "bytes": dict(self._bytes),
            "calls": self.calls,
            "gaps": self.gaps,
            "lags": self.lags,
            "trips": self.trips,
            "counters": dict(endpoint.counters),
            "index": [session.local_index for session in endpoint._sessions.values()],
            "recorded": self._recorded,
            "tables": {
                "sessions": len(endpoint._sessions),
                "responses": len(half._responses),
                "unconfirmed": len(half._unconfirmed),
                "peers": len(endpoint._peers._peers),
                "assemblies": len(endpoint._fragmenter._incoming),
                "led": len(self.network._port_by_target),
                "seen": len(nat.external._reports),
            },
        }
        self._clear()
        return report


def main(path: str, known: str, *others: str) -> None:
    """Run until standard input ends."""
    host, _, port = known.partition(":")
    StandardIO(Node(Path(path), [Address(host, int(port))] if port else [], list(others)))
    reactor.run()


if __name__ == "__main__":
    main(*sys.argv[1:])
