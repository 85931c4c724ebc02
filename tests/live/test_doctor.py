"""Tests of ``swarm doctor`` in a simulated internet of namespaces: each cause is created and must be reported."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sim.namespaces.internet import PUBLIC_ADDRESSES, Internet, Site
from sim.namespaces.nat import NatKind
from tests.live.namespaces import NamespaceCase
from tests.live.until import until

LIMIT_S = 30.0
TEAM = "of the test"
NODE = [sys.executable, "-c", "from twisted.scripts.twistd import run; run()", "-n", "--pidfile=", "swarm-node"]
DOCTOR = """
import sys, time
from functools import partial
from swarmnode.doctor.command import main
from swarmnode.doctor.measure import measure_facts
late = float(sys.argv[1])
sys.exit(main(sys.argv[2:], measure=partial(measure_facts, wall=lambda: time.time() - late)))
"""
OTHER_VERSION = """
import socket, sys
from middleware.entangled.network.network import Address
from middleware.entangled.wire.probe import pack_reply
own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
own.bind((sys.argv[1], int(sys.argv[2])))
print("ready", flush=True)
while True:
    data, source = own.recvfrom(2048)
    if data[0] == 0x19:
        answer = bytearray(pack_reply(data, bytes(8), 0.0, Address(*source)))
        answer[17] = 9
        own.sendto(bytes(answer), source)
"""


class DoctorCase(NamespaceCase):
    """A simulated internet with nodes, and the doctor."""

    net: Internet

    def setUp(self) -> None:
        super().setUp()
        self.folder = Path(self.mktemp()).absolute()
        self.folder.mkdir()

    def settings(self, name: str, host: str, known: Sequence[str] = (), **others: object) -> Path:
        """Write the settings of a node."""
        node = {"name": name, "host": host, "port": 8484, "team_key": TEAM, "known_nodes": list(known), **others}
        lines = "".join(f"{key} = {json.dumps(value)}\n" for key, value in node.items())
        file = self.folder / f"{name}.toml"
        file.write_text(f"[node]\n{lines}", encoding="utf-8")
        file.chmod(0o600)
        return file

    def node(self, at: str, settings: Path) -> subprocess.Popen[Any]:
        """Run a node on a host; wait until it has a control socket."""
        log = open(settings.with_suffix(".log"), "w", encoding="utf-8")  # noqa: SIM115 (the process has it)
        self.addCleanup(log.close)
        home = self.home(settings)
        words = ["env", f"XDG_RUNTIME_DIR={home}", *NODE, "--config", str(settings)]
        process = self.net.start(at, words, stdout=log, stderr=log)
        said = settings.with_suffix(".log")
        until(lambda: list(home.glob("swarm-node/*.control")), told=lambda: said.read_text(encoding="utf-8"))
        return process

    def home(self, settings: Path) -> Path:
        """Return the folder of a node's control socket; each host has its own, because the hosts share one disk."""
        home = Path("/tmp") / f"doctor-{abs(hash((str(self.folder), settings.stem))) % 10**9}"
        if not home.exists():
            home.mkdir(mode=0o700)
            self.addCleanup(self.emptied, home)
        return home

    def emptied(self, home: Path) -> None:
        """Remove a folder of sockets."""
        self.net.close()
        for file in sorted(home.rglob("*"), reverse=True):
            file.rmdir() if file.is_dir() else file.unlink()
        home.rmdir()

    def asked(self, at: str, settings: Path, late: float = 0.0) -> Mapping[str, Any]:
        """Return the findings of the doctor on a host."""
        words = ["env", f"XDG_RUNTIME_DIR={self.home(settings)}", sys.executable, "-c", DOCTOR, str(late)]
        done = self.net.run(at, [*words, "--json", str(settings)], timeout=LIMIT_S)
        self.assertIn(done.returncode, (0, 1), done.stderr)
        said: Mapping[str, Any] = json.loads(done.stdout)
        self.assertEqual(done.returncode, int(any(each["weight"] != "note" for each in said["findings"])))
        return said

    def causes(self, at: str, settings: Path, late: float = 0.0) -> list[str]:
        """Return the names of the causes that the doctor found."""
        return [finding["cause"] for finding in self.asked(at, settings, late)["findings"]]


class WayTests(DoctorCase):
    """Causes on the path between a node and the internet."""

    def test_routers_and_firewalls(self) -> None:
        """Nodes behind each kind of router, and behind a firewall that blocks UDP, report it.

        A cut connection is reported as a missing bootstrap node.
        """
        net = self.net = self.internet(
            Site("c", NatKind.PORT),
            Site("s", NatKind.SYM),
            Site("n", NatKind.NOUDP),
            Site("o", NatKind.NONE),
            Site("x", NatKind.PORT),
        )
        known = [f"{address}:8484" for address in PUBLIC_ADDRESSES]
        for number, address in enumerate(PUBLIC_ADDRESSES):
            self.node("pub", self.settings(f"pub{number}", address, known[:number]))
        for host, causes in (("c1", ["nat-cone"]), ("s1", ["nat-symmetric"]), ("n1", ["udp-blocked"]), ("o1", [])):
            settings = self.settings(host, net.address(host), known, lan=False)
            self.assertEqual(self.causes(host, settings), causes, host)
        net.cut("x")
        settings = self.settings("x1", net.address("x1"), known, lan=False)
        self.assertEqual(self.causes("x1", settings), ["no-bootstrap"])


class LanTests(DoctorCase):
    """Causes on a LAN."""

    def setUp(self) -> None:
        super().setUp()
        net = self.net = self.internet(Site("a", NatKind.PORT, hosts=2))
        self.other = f"{net.address('a2')}:8484"
        self.node("a2", self.settings("other", net.address("a2")))
        self.own = self.settings("own", net.address("a1"), [self.other])

    def test_well(self) -> None:
        """Two nodes with no known nodes in their settings find each other; the doctor finds no problem."""
        settings = self.settings("own", self.net.address("a1"))
        self.node("a1", settings)
        said = self.asked("a1", settings)
        self.assertEqual(said["findings"], [])
        self.assertEqual([link["address"] for link in said["links"]], [self.other])
        self.assertGreaterEqual(said["links"][0]["score"], 80)

    def test_one_of_no_team_finds_whom_to_ask(self) -> None:
        """A machine without a team finds the nodes on its LAN by discovery."""
        imported = "from swarmnode.doctor.measure import discover_on_lan"
        program = f"{imported}; print(*[each.address for each in discover_on_lan()])"
        done = self.net.run("a1", [sys.executable, "-c", program], timeout=LIMIT_S)
        self.assertEqual((done.stdout.strip(), done.stderr), (self.other, ""))

    def test_multicast_blocked(self) -> None:
        """A LAN without multicast is reported, even if the node is reachable at its address."""
        self.assertEqual(self.causes("a1", self.own), [])
        for port in ("h1", "h2"):
            self.net.get_namespace("a-gw").run(f"ip link set {port} type bridge_slave mcast_flood off mcast_router 0\n")
        self.net.get_namespace("a-gw").run("ip link set lan type bridge mcast_snooping 0\n")
        self.assertEqual(self.causes("a1", self.own), ["multicast-blocked"])

    def test_firewall_of_this_machine(self) -> None:
        """A firewall on this machine that blocks multicast is reported as this machine's firewall."""
        self.net.get_namespace("a1").run(_DROP.format(port=8483))
        said = self.asked("a1", self.own)["findings"]
        self.assertEqual([finding["cause"] for finding in said], ["multicast-blocked"])
        self.assertIn("This machine", said[0]["what"])

    def test_firewall_of_the_other(self) -> None:
        """If a neighbour's firewall blocks the neighbour's port, it is reported as the neighbour's firewall."""
        self.net.get_namespace("a2").run(_DROP.format(port=8484))
        self.assertIn("peer-firewall", self.causes("a1", self.own))

    def test_client_isolation(self) -> None:
        """Client isolation at the access point is reported."""
        for port in ("h1", "h2"):
            self.net.get_namespace("a-gw").run(f"ip link set {port} type bridge_slave isolated on\n")
        self.assertEqual(self.causes("a1", self.own), ["client-isolation"])

    def test_settings_and_clock(self) -> None:
        """A port without a node, an impossible host, another team and a wrong clock are reported."""
        own, other = self.net.address("a1"), self.net.address("a2")
        nobody = self.settings("own", own, [f"{other}:9999"], lan=False)
        self.assertEqual(self.causes("a1", nobody), ["nobody-listens"])
        for host in ("198.19.77.7", "127.0.0.1"):
            self.assertIn("wrong-interface", self.causes("a1", self.settings("own", host, [self.other])))
        foreign = self.settings("own", own, [self.other], team_key="of others")
        self.assertEqual(self.causes("a1", foreign), ["wrong-team"])
        settings = self.settings("own", own, [self.other])
        self.assertEqual(self.causes("a1", settings, late=3600.0), ["clock-off"])

    def test_version(self) -> None:
        """A node with a different protocol version is reported."""
        words = [sys.executable, "-c", OTHER_VERSION, self.net.address("a2"), "8499"]
        process = self.net.start("a2", words, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        self.assertEqual(process.stdout.readline(), "ready\n")
        settings = self.settings("own", self.net.address("a1"), [f"{self.net.address('a2')}:8499"], lan=False)
        self.assertEqual(self.causes("a1", settings), ["version-skew"])

    def test_machine(self) -> None:
        """A port in use, an unusable store, and settings that other users can read are reported together."""
        settings = self.settings("taken", self.net.address("a2"), [], store="nowhere/a.sqlite", lan=False)
        settings.chmod(0o644)
        self.assertEqual(self.causes("a2", settings), ["port-in-use", "store-unwritable", "key-readable"])


_DROP = """nft add table ip test
nft 'add chain ip test input {{ type filter hook input priority 0; }}'
nft add rule ip test input udp dport {port} drop
"""
