"""Tests of the simulated internet of namespaces: its routers, its links, and its complete removal."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

from sim.namespaces.capture import Capture
from sim.namespaces.internet import PUBLIC_ADDRESSES, ROOT, Internet, Site
from sim.namespaces.nat import NatKind
from tests.live.namespaces import NamespaceCase
from tests.live.test_processes import is_alive
from tests.live.until import until

LIMIT_S = 60.0
TARGETS = (f"{PUBLIC_ADDRESSES[0]}:4000", f"{PUBLIC_ADDRESSES[0]}:4001", f"{PUBLIC_ADDRESSES[1]}:4000")
"""Two ports of one address, and another address."""
ECHO = """
import select, socket, sys
held = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in sys.argv[1:]]
for one, (host, port) in zip(held, [each.split(":") for each in sys.argv[1:]]):
    one.bind((host, int(port)))
print("ready", flush=True)
while True:
    for one in select.select(held, [], [])[0]:
        data, source = one.recvfrom(2048)
        one.sendto(repr(source).encode(), source)
"""
ASK = """
import socket, sys
own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
own.bind(("0.0.0.0", 5000))
own.settimeout(0.5)
seen = []
for host, port in [each.split(":") for each in sys.argv[1:]]:
    own.sendto(b"who am I", (host, int(port)))
    try:
        seen.append(eval(own.recv(2048)))
    except OSError:
        seen.append(None)
print(seen)
"""


class InternetTests(NamespaceCase):
    """Behaviour of ``Internet``."""

    def seen(self, net: Internet, host: str) -> list[tuple[str, int] | None]:
        """Return the source addresses that three echo servers on the public host see for one socket of ``host``."""
        done = net.run(host, [sys.executable, "-c", ASK, *TARGETS], timeout=LIMIT_S)
        self.assertEqual(done.returncode, 0, done.stderr)
        found: list[tuple[str, int] | None] = json.loads(
            done.stdout.replace("(", "[").replace(")", "]").replace("'", '"').replace("None", "null")
        )
        return [None if each is None else (each[0], each[1]) for each in found]

    def echo(self, net: Internet) -> None:
        """Start the echo servers on the public host."""
        process = net.start("pub", [sys.executable, "-c", ECHO, *TARGETS], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        self.assertEqual(process.stdout.readline(), "ready\n")

    def test_mappings_are_of_their_kind(self) -> None:
        """Depending on its kind, a router maps a socket to one port for all peers, to one port per peer, or to none."""
        kinds = list(NatKind)
        net = self.internet(*(Site(kind.value, kind) for kind in kinds))
        self.echo(net)
        for kind in kinds:
            seen = self.seen(net, f"{kind.value}1")
            if kind is NatKind.NOUDP:
                self.assertEqual(seen, [None] * 3)
                continue
            outside = net.address("none1") if kind is NatKind.NONE else net.get_external_address(kind.value)
            self.assertEqual({each[0] for each in seen if each is not None}, {outside}, kind)
            ports = {each[1] for each in seen if each is not None}
            self.assertEqual(len(ports), 3 if kind is NatKind.SYM else 1, (kind, seen))

    def test_lines_lose_what_is_said(self) -> None:
        """A cut blocks all datagrams in one direction, losses are counted, and a repaired link passes all datagrams."""
        net = self.internet(Site("a", NatKind.PORT))
        self.echo(net)
        self.assertNotIn(None, self.seen(net, "a1"))
        net.cut("a", "in")
        self.assertEqual(self.seen(net, "a1"), [None] * 3)
        counts = net.read_counts()["a-gw"]
        self.assertEqual((counts["up"]["lost"], counts["down"]["lost"]), (0, 3))
        self.assertEqual(counts["up"]["passed"], 6)
        net.heal("a")
        self.assertNotIn(None, self.seen(net, "a1"))

    def test_routers_get_another_address(self) -> None:
        """A renumbered site is seen only at its new address, and a moved host only at the address of its new router."""
        net = self.internet(Site("a", NatKind.PORT), Site("b", NatKind.FULL))
        self.echo(net)
        before, new = net.get_external_address("a"), net.renumber("a")
        self.assertNotEqual(before, new)
        self.assertEqual({each[0] for each in self.seen(net, "a1") if each}, {new})
        net.move("a1", "b")
        self.assertEqual({each[0] for each in self.seen(net, "a1") if each}, {net.get_external_address("b")})

    def test_captures_hold_and_count(self) -> None:
        """A capture counts datagrams and bytes per peer, and finds words that were sent unencrypted."""
        net = self.internet(Site("a", NatKind.PORT))
        self.echo(net)
        file, whole = Path(self.mktemp()), Path(self.mktemp())
        net.record_frames(whole)
        with Capture(net, "pub", file) as seen:
            self.seen(net, "a1")
        net.record_frames(None)
        traffic = seen.from_host(net.get_external_address("a"))
        self.assertEqual((traffic.received, traffic.sent), (3, 3))
        self.assertEqual(traffic.received_bytes, 3 * len("who am I"))
        self.assertGreater(traffic.amplification, 1.0)
        self.assertEqual(seen.find_plain_text([b"who am I", b"red target"]), [b"who am I"])
        self.assertIn(b"who am I", whole.read_bytes())

    def test_nothing_is_left(self) -> None:
        """After an exception, or if the creating process is killed, no process of a simulated internet is left."""
        program = (
            "import os, signal, sys\n"
            "from sim.namespaces.internet import Internet, Site\nfrom sim.namespaces.nat import NatKind\n"
            "with Internet([Site('a', NatKind.PORT)]) as net:\n"
            "    started = net.start('a1', ['sleep', '600'])\n"
            "    print(started.pid, *[net.get_namespace(name).pid for name in ('', 'a1', 'a-gw')], flush=True)\n"
            "    if sys.argv[1] == 'raise': raise SystemExit(3)\n"
            "    signal.pause()\n"
        )
        left: list[int] = []
        for end in ("raise", "kill"):
            child = subprocess.Popen([sys.executable, "-c", program, end], cwd=ROOT, stdout=subprocess.PIPE, text=True)
            assert child.stdout is not None
            pids = [int(word) for word in child.stdout.readline().split()]
            self.assertEqual(len(pids), 4)
            if end == "kill":
                child.send_signal(signal.SIGKILL)
            child.wait(LIMIT_S)
            child.stdout.close()
            left += pids
        until(lambda: not any(map(is_alive, left)), 10.0, lambda: f"one is left of {left}")


class MatrixTests(NamespaceCase):
    """A small run of ``make live-nat``."""

    def test_whoever_can_reach_each_other_does(self) -> None:
        """In one round, nodes without routers connect immediately, and table, JSON and figure are written."""
        folder = Path(self.mktemp()).absolute()
        command = [sys.executable, "-m", "benchmarks.nat", "--count", "1", "--lossy", "0", "--out", str(folder)]
        ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
        self.assertIn(ran.returncode, (0, 1), ran.stderr)
        found = json.loads((folder / "live-nat.json").read_text())["trials"]
        (open_one,) = [one for one in found if (one["part"], one["a"], one["b"]) == ("plain", "none", "none")]
        self.assertEqual(open_one["path"], "direct", ran.stdout)
        self.assertLess(max(open_one["took_s"]), 1.0)
        self.assertTrue((folder / "live-nat.svg").read_text().startswith("<svg"))
