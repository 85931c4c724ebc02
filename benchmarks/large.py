"""What a node costs in a large network: memory, time of a core, traffic, and what a join takes.

``n`` nodes as they ship join one after the other through random ones, on one turned clock; then time passes.  Memory is
what the process grew by; with ``--lookups`` the k closest that lookups find are compared with the true ones.
"""

from __future__ import annotations

import argparse
import gc
import random
import sys
import time
from collections import Counter
from pathlib import Path

from middleware.entangled.clock import HeapClock
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.errors import EntangledError
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.distance import closest
from middleware.entangled.kademlia.overlay import K
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import Switchboard, SwitchboardNetwork, Weather
from middleware.entangled.node import EntangledNode
from middleware.entangled.wire.session import INIT

HEADER = 28
"""Bytes of IP and UDP around a datagram."""
PAGE = 4096
SETTLING = 60.0


class Meter(SwitchboardNetwork):
    """A network that counts what all of its kind send."""

    sent: Counter[str] = Counter()

    def send(self, datagram: bytes, to: Address) -> None:
        """Count a datagram and send it."""
        Meter.sent["datagrams"] += 1
        Meter.sent["bytes"] += len(datagram) + HEADER
        Meter.sent["handshakes"] += datagram[0] == INIT
        super().send(datagram, to)


class Crowd:
    """Nodes in one process; ``session`` is how long one stays on average, in seconds (0: for good)."""

    def __init__(self, n: int, seed: int, weather: Weather, rate: float, session: float = 0.0) -> None:
        self.clock = HeapClock()
        self.rng = random.Random(seed)
        self.board = Switchboard(self.clock, random.Random(f"{seed}/board"), weather)
        self.seed = seed
        self.session = session
        self.lives = 0
        self.nodes: list[EntangledNode] = []
        for _ in range(n):
            self.enter()
            self.clock.advance(1 / rate)

    def enter(self) -> None:
        """One more node, which joins through random ones."""
        number, self.lives = self.lives, self.lives + 1
        address = Address(f"10.{number >> 16}.{number >> 8 & 255}.{number & 255}", 7000)
        identity = Identity(random.Random(f"{self.seed}/{number}").randbytes(32))
        dice = random.Random(f"{self.seed}/{number}/dice")
        node = EntangledNode(identity, b"t" * 32, Meter(self.board, address), MemoryStore(), self.clock, dice)
        known = [other.contact.address for other in self.rng.sample(self.nodes, min(2, len(self.nodes)))]
        node.start()
        node.join(known).addErrback(lambda failure: failure.trap(EntangledError))
        self.nodes.append(node)

    def churn(self) -> None:
        """Let nodes leave without a word from now on, each followed by a newcomer at once."""

        def leave(node: EntangledNode) -> None:
            if node not in self.nodes:
                return
            node.vanish()
            self.nodes.remove(node)
            self.enter()
            self.clock.callLater(self.rng.expovariate(1 / self.session), leave, self.nodes[-1])

        for node in self.nodes:
            self.clock.callLater(self.rng.expovariate(1 / self.session), leave, node)

    def looked_up(self, count: int, within: float = 4.0, every: float = 0.1) -> tuple[float, float, float, float]:
        """Lookups from random nodes for ids of random nodes.

        Gives the shares that found the node itself, and just the k closest, in time; the mean of hops; seconds, median.
        """
        found = exact = 0
        hops: list[int] = []
        took: list[float] = []

        def begin() -> None:
            target, asker = self.rng.sample(self.nodes, 2)
            began, wanted = self.clock.seconds(), target.identity.node_id

            def ended(contacts: list) -> None:  # type: ignore[type-arg]
                nonlocal found, exact
                seconds = self.clock.seconds() - began
                others = [node.contact for node in self.nodes if node is not asker]
                found += seconds <= within and any(c.node_id == wanted for c in contacts)
                exact += seconds <= within and contacts == closest(others, wanted, K)
                hops.append(asker.overlay.lookups[-1].hops)
                took.append(seconds)

            asker.find_node(wanted).addCallbacks(ended, lambda failure: None)

        for _ in range(count):
            begin()
            self.clock.advance(every)
        self.clock.advance(10.0)
        return found / count, exact / count, sum(hops) / max(1, len(hops)), sorted(took)[len(took) // 2]


def resident() -> float:
    """KiB of memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE / 1024


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.large", description=__doc__)
    parser.add_argument("--nodes", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=60.0, help="of virtual time that are measured (default 60)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rate", type=float, default=20.0, help="nodes that join in a second (default 20)")
    parser.add_argument(
        "--delay", type=float, default=0.02, help="seconds on the way, plus or minus half (default 0.02)"
    )
    parser.add_argument("--median", type=float, default=0.0, help="of the sessions, in minutes (default: for good)")
    parser.add_argument("--lookups", type=int, default=0, help="that are compared with the truth")
    parser.add_argument("--half", action="store_true", help="let half of the nodes vanish at once, and look up again")
    given = parser.parse_args()
    gc.set_threshold(200_000, 20, 100)
    before, began = resident(), time.process_time()
    weather = Weather(given.delay, given.delay / 2)
    crowd = Crowd(given.nodes, given.seed, weather, given.rate, given.median * 60 / 0.6931)
    joined, joining = time.process_time() - began, dict(Meter.sent)
    say(
        "join",
        f"{joined / given.nodes * 1000:.1f} ms of a core a node, {joining['handshakes'] / given.nodes:.0f} handshakes",
    )
    if given.median:
        crowd.churn()
    crowd.clock.advance(SETTLING)
    gc.collect()
    Meter.sent.clear()
    began = time.process_time()
    crowd.clock.advance(given.seconds)
    each = given.seconds * given.nodes
    took = (time.process_time() - began) / each
    say("core", f"{took * 1000:.3f} ms a node and second, {1 / (took * given.nodes):.2f} x real time")
    sent = Meter.sent
    say("traffic", f"{sent['datagrams'] / each:.2f} datagrams, {sent['bytes'] / each:.0f} bytes a node and second")
    say("handshakes", f"{sent['handshakes'] / each:.3f} a node and second")
    gc.collect()
    say("memory", f"{(resident() - before) / given.nodes:.0f} KiB a node")
    contacts = [len(node.overlay.contacts()) for node in crowd.nodes]
    say("contacts", f"{sum(contacts) / len(contacts):.0f} a node, {min(contacts)} to {max(contacts)}")
    say("whole", f"{sum(node.overlay.is_complete for node in crowd.nodes)} nodes take what they know for all")
    if given.lookups:
        report(crowd, given.lookups)
    if given.half:
        for node in crowd.rng.sample(crowd.nodes, len(crowd.nodes) // 2):
            node.vanish()
            crowd.nodes.remove(node)
        report(crowd, 100, "at once after half")
        crowd.clock.advance(50.0)
        report(crowd, 100, "60 s after half")
    return 0


def report(crowd: Crowd, count: int, when: str = "lookups") -> None:
    """Look up, and print how it went."""
    found, exact, hops, seconds = crowd.looked_up(count)
    say(when, f"{found:.2%} found, {exact:.2%} exact, {hops:.2f} hops, {seconds * 1000:.0f} ms at median")


def say(what: str, figures: str) -> None:
    """Print one line."""
    sys.stdout.write(f"{what:<18} {figures}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
