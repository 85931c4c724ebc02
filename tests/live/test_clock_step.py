"""Tests that setting the wall clock changes no timer, lease or TTL of a running node (invariant R5)."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

ROOT = Path(__file__).resolve().parents[2]
STEPS = (60.0, -60.0, 3600.0, -3600.0)
CLOCKS_OF_THE_WALL = (
    "time.time",
    "datetime.now",
    "datetime.utcnow",
    "datetime.today",
    "time.localtime",
    "time.time_ns",
)
NODES = """
import json, random, sys, time
from pathlib import Path

real, offset = time.time, [0.0]
time.time = lambda: real() + offset[0]

from middleware.entangled.clock import use_monotonic_time
use_monotonic_time()
from twisted.internet import reactor
from middleware.entangled.identity import Identity
from middleware.entangled.network.udp import UdpNetwork
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import hash_key
from middleware.entangled.data.sqlite import SqliteStore

folder, step = sys.argv[1], float(sys.argv[2])
key, short = hash_key("device"), hash_key("short")
nodes, networks = [], []
for number in range(2):
    network = UdpNetwork(reactor, "127.0.0.1", 0)
    store = SqliteStore.open(f"{folder}/{number}", reactor.seconds(), deliver=reactor.callFromThread)
    node = EntangledNode(
        Identity(bytes([number + 1]) * 32), b"t" * 32, network, store, reactor, random.SystemRandom(), 1.0, time.time
    )
    node.start()
    node.join([nodes[0].contact.address] if nodes else [])
    nodes.append(node)

seen, beats, wrong = [], [], []

def beat():
    beats.append(time.monotonic())
    reactor.callLater(0.1, beat)

def look(records):
    seen.append([time.monotonic(), len(records)])

def begin():
    nodes[0].put(key, "heartbeat", b"1", "leased").addErrback(lambda f: wrong.append(str(f.value)))
    nodes[1].watch(key, look)
    beat()
    reactor.callLater(0.8, lambda: offset.__setitem__(0, step))
    reactor.callLater(0.8, lambda: beats.append(time.monotonic()))
    reactor.callLater(2.8, silence)

def silence():
    seen.append([time.monotonic(), "silent"])
    nodes[0].stop_silently()
    reactor.callLater(2.5, end)

def end():
    nodes[1].stop()
    for node in nodes:
        node.store.close()
    reactor.stop()

reactor.callLater(0.7, begin)
reactor.run()
print(json.dumps({"seen": seen, "beats": beats, "wrong": wrong}))
"""


class ClockStepTest(SynchronousTestCase):
    def test_steps(self) -> None:
        """When the wall clock is set, a lease survives and later expires in time, and all timers run on time."""
        children = []
        for step in STEPS:
            folder = Path(self.mktemp())
            folder.mkdir(parents=True)
            command = [sys.executable, "-c", NODES, str(folder.resolve()), str(step)]
            children.append(
                subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
            )
        for step, child in zip(STEPS, children, strict=True):
            out, err = child.communicate(timeout=60)
            self.assertEqual((child.returncode, err), (0, ""), step)
            told = json.loads(out)
            self.assertEqual(told["wrong"], [], step)
            gaps = [after - before for before, after in zip(told["beats"], told["beats"][1:], strict=False)]
            self.assertGreater(len(gaps), 30, f"{step}: {gaps}")
            self.assertLess(max(gaps), 2.0, f"{step}: a timer stood still")
            mark = [what for _, what in told["seen"]].index("silent")
            before, after = told["seen"][:mark], told["seen"][mark:]
            self.assertEqual(before[-1][1], 1, f"{step}: the lease ended while its owner lived: {told['seen']}")
            self.assertNotIn(0, [count for _, count in before[1:]], f"{step}: the record was gone for a moment")
            gone = [moment for moment, count in after if count == 0]
            self.assertTrue(gone, f"{step}: the lease of the dead does not end: {told['seen']}")
            self.assertGreater(gone[0] - after[0][0], 0.3, step)

    def test_nobody_asks_the_wall(self) -> None:
        """No module of the library, the drivers or the agents reads the wall clock; the time is an argument."""
        asking = []
        for room in ("formats", "middleware", "drivers", "agents"):
            for path in sorted((ROOT / room).rglob("*.py")):
                module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
                tree = ast.parse(path.read_text(encoding="utf-8"))
                used = {ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
                named = {
                    f"{node.module}.{alias.name}"
                    for node in ast.walk(tree)
                    if isinstance(node, ast.ImportFrom)
                    for alias in node.names
                }
                if (used | named) & set(CLOCKS_OF_THE_WALL):
                    asking.append(module)
        self.assertEqual(asking, [])
