"""Run the team that ``benchmarks.page`` loads: a real web node, or three robots with timestamps in their pictures.

``python -m benchmarks.page_team web`` prints its port, and for each line on its input the delay of its timers and its
memory; ``robots UDP_PORT`` joins three robots. Each is a separate process, and ends with its input.
"""

from __future__ import annotations

import json
import struct
import sys
import time
from functools import partial
from typing import Any

from twisted.internet.stdio import StandardIO
from twisted.protocols.basic import LineReceiver

from benchmarks.measure import MIB, percentile, read_memory_bytes
from middleware.config.settings import Settings
from middleware.entangled.clock import use_monotonic_time
from middleware.node import CAMERA
from swarmnode.environment import make_dependencies
from swarmnode.memory_savings import STARTUP_S, block_tls_import, release_memory
from swarmnode.service import NodeService
from swarmnode.web import make_web_page

ROBOTS = ("dog1", "dog2", "dog3")
CODE = "page-bench"
KEY = "5b" * 32
FPS, PICTURE = 30.0, 6000
"""Pictures a second of each robot, and their bytes, as in the demonstration."""
WORDS_S = 0.5
"""Seconds between two messages of each robot, which change the state."""
TICK_S = 0.002
JPEG_START = b"\xff\xd8"


def make_settings(name: str, port: int, **tables: Any) -> Settings:
    """Return the settings of a node on this machine without stored data; ``port`` is the web node's."""
    known = [] if "web" in tables else [f"127.0.0.1:{port}"]
    node = {"name": name, "host": "127.0.0.1", "port": port if "web" in tables else 0, "known_nodes": known}
    roles = ["edge", "web"] if "web" in tables else ["edge"]
    return Settings.from_mapping({"node": {**node, "team_key": KEY, "roles": roles, "store": ":memory:"}, **tables}, "")


class ReportProtocol(LineReceiver):
    """Answer each line with measurements; exit at the end of the input."""

    delimiter = b"\n"

    def __init__(self, reactor: Any, first: dict[str, Any], late: list[float]) -> None:
        self._reactor = reactor
        self._first = first
        self._late = late

    def connectionMade(self) -> None:
        """Report that the team is ready."""
        self.sendLine(json.dumps(self._first).encode())

    def lineReceived(self, line: bytes) -> None:
        """Report the timer delays since the previous line (ms), the memory (MiB) and the processor time (s)."""
        late = sorted(self._late) or [0.0]
        self._late.clear()
        told = {
            "late_ms": 1000 * late[-1],
            "late_p99_ms": 1000 * percentile(late, 0.99),
            "rss": read_memory_bytes() / MIB,
            "processor_s": time.process_time(),
        }
        self.sendLine(json.dumps(told).encode())

    def connectionLost(self, reason: Any = None) -> None:
        """Exit."""
        if self._reactor.running:
            self._reactor.stop()


def main(arguments: list[str]) -> None:
    """Run the web node, or the robots."""
    use_monotonic_time()
    block_tls_import()
    from twisted.internet import reactor as made

    reactor: Any = made
    late: list[float] = []
    if arguments[0] == "web":
        ports = [int(word) for word in arguments[1:]]
        wanted = make_settings("vaio", ports[0], web={"host": "127.0.0.1", "port": ports[1], "code": CODE})
        dependencies = make_dependencies(wanted, reactor)
        services = [NodeService(wanted, dependencies, [partial(make_web_page, wanted, dependencies, reactor)])]

        def tick(due: float) -> None:
            now = reactor.seconds()
            late.append(now - due)
            reactor.callLater(TICK_S, tick, now + TICK_S)

        reactor.callWhenRunning(lambda: tick(reactor.seconds()))
    else:
        port = int(arguments[1])
        services = [make_robot(name, port, reactor) for name in ROBOTS]
    for service in services:
        reactor.callWhenRunning(service.startService)
        reactor.addSystemEventTrigger("before", "shutdown", service.stopService)
    reactor.callLater(STARTUP_S, release_memory)
    reactor.callWhenRunning(lambda: StandardIO(ReportProtocol(reactor, {"is": arguments[0]}, late), reactor=reactor))
    reactor.run()


def make_robot(name: str, port: int, reactor: Any) -> NodeService:
    """Run a robot with a camera that encodes the time in its pictures, and that sends a message from time to time."""
    wanted = make_settings(name, port)
    camera = {CAMERA: {"width": 208, "height": 160, "fps": FPS}}
    wanted = Settings.from_mapping(
        {
            "node": {
                "name": name,
                "team_key": KEY,
                "host": "127.0.0.1",
                "port": 0,
                "store": ":memory:",
                "known_nodes": [f"127.0.0.1:{port}"],
                "capabilities": camera,
            }
        },
        "",
    )
    service = NodeService(wanted, make_dependencies(wanted, reactor))
    node = service.assembly.node

    def shoot(number: int) -> None:
        node.streams.publish(CAMERA, number, JPEG_START + struct.pack("!d", time.monotonic()) + bytes(PICTURE))
        reactor.callLater(1 / FPS, shoot, number + 1)

    def say(number: int) -> None:
        node.presence.add_message(time.time(), f"word {number}")
        reactor.callLater(WORDS_S, say, number + 1)

    reactor.callWhenRunning(shoot, 1)
    node.joined.addCallback(lambda _: say(1))
    return service


if __name__ == "__main__":
    main(sys.argv[1:])
