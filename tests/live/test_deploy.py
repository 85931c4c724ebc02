"""Tests of the deployment page of the documentation: its code blocks run on computers that are network namespaces."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from sim.namespaces.internet import PUBLIC_HOST, Internet, Site
from sim.namespaces.namespace import make_environment
from sim.namespaces.nat import NatKind
from tests.live.namespaces import NamespaceCase
from tests.live.until import until

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "how-to" / "set-up-a-team.md"
BLOCK = re.compile(r"^```sh (\w+)( again)?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"\b[0-9A-Z]{5}(?:-[0-9A-Z]{5}){3}\b")
AT_HOME, RENTED = "192.168.1.10", "203.0.113.7"
"""The addresses of the first laptop and of the rented computer in the page."""
PATIENCE_S = 40.0
FIREWALL = """table inet filter {
  chain input {
    type filter hook input priority 0; policy drop;
    ct state established,related accept
    iifname "lo" accept
  }
}"""

Block = tuple[str, bool, list[str]]


class DeployTests(NamespaceCase):
    """Each computer has its name from the page, its own home directory, and only the page's files."""

    def setUp(self) -> None:
        super().setUp()
        # The folders of Trial have paths that are too long for a socket.
        self.folder = Path(tempfile.mkdtemp())
        self.addCleanup(shutil.rmtree, self.folder)
        self.programs = self.folder / "bin"
        self.programs.mkdir()
        starts = {
            "swarm": "from swarmnode.command import main",
            "twistd": "from twisted.scripts.twistd import run as main",
        }
        for name, start in starts.items():
            path = self.programs / name
            path.write_text(f'#!/bin/sh\nexec {sys.executable} -c "import sys; {start}; sys.exit(main())" "$@"\n')
            path.chmod(0o755)
        self.codes: dict[str, str] = {}
        self.nodes: dict[str, subprocess.Popen[bytes]] = {}

    def blocks(self, first: str, last: str) -> Iterator[Block]:
        """For each block between two headings, yield the computer, whether its node is stopped first, and the lines."""
        text = PAGE.read_text(encoding="utf-8")
        part = text[text.index(f"## {first}") : text.index(f"## {last}") if last else len(text)]
        for name, again, lines in BLOCK.findall(part):
            yield name, bool(again), lines.splitlines()

    def home(self, name: str) -> Path:
        """Return the home directory of a computer."""
        path = self.folder / name
        path.mkdir(exist_ok=True)
        return path

    def surroundings(self, name: str) -> dict[str, str]:
        """Return the environment variables of a user at a computer."""
        home = self.home(name)
        inherited = {key: value for key, value in make_environment().items() if not key.startswith(("SWARM_", "XDG_"))}
        here = {"HOME": str(home), "XDG_RUNTIME_DIR": str(home), "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}
        return {**inherited, **here, "PATH": f"{self.programs}:{inherited['PATH']}"}

    def follow(self, net: Internet, places: dict[str, str], blocks: Iterable[Block]) -> dict[str, str]:
        """Run the blocks; return the last output of each line by computer and line."""
        said: dict[str, str] = {}
        for name, again, lines in blocks:
            host = places[name]
            if again:
                self.nodes[name].terminate()
                self.nodes[name].wait()
            for line in lines:
                if line.startswith("twistd "):
                    self.start(net, host, name, line)
                else:
                    said[f"{name}: {line}"] = self.run_line(net, host, name, self.meant(line, name, net))
                invited = re.match(r"swarm invite (\w+)", line)
                if invited:
                    found = CODE.search(said[f"{name}: {line}"])
                    assert found is not None
                    self.codes[invited[1]] = found[0]
        return said

    def meant(self, line: str, name: str, net: Internet) -> str:
        """Return a line of the page in which the code and addresses are replaced by the real ones."""
        if "swarm join " in line:
            line = CODE.sub(self.codes[name], line)
        if "w1" in net.hosts:
            line = line.replace(AT_HOME, net.address("w1"))
        return line.replace(RENTED, net.address(PUBLIC_HOST))

    def run_line(self, net: Internet, host: str, name: str, line: str) -> str:
        """Run a line, which must succeed; return its output."""
        done = subprocess.run(
            net.command(host, ["sh", "-c", line]),
            cwd=self.home(name),
            env=self.surroundings(name),
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
        )
        self.assertEqual(done.returncode, 0, f"{name}$ {line}\n{done.stdout}{done.stderr}\n{self.logs()}")
        return done.stdout

    def start(self, net: Internet, host: str, name: str, line: str) -> None:
        """Start a node; wait until it has joined its team."""
        log = self.home(name) / "log"
        with open(log, "wb") as file:
            options = {"cwd": self.home(name), "env": self.surroundings(name), "stdout": file, "stderr": file}
            self.nodes[name] = net.start(host, line.split(), **options)
        until(lambda: " joined as number " in log.read_text(), told=self.logs)

    def logs(self) -> str:
        """Return the logs of all nodes."""
        return "\n".join(f"-- {path.parent.name}\n{path.read_text()}" for path in self.folder.glob("*/log"))

    def test_three_laptops(self) -> None:
        """With the lines of the documentation page, three laptops behind one router form a team.

        One laptop opens the web page of another laptop.
        """
        with Internet([Site("w", NatKind.PORT, hosts=3)]) as net:
            places = {"vaio": "w1", "dog1": "w2", "dog2": "w3"}
            said = self.follow(net, places, self.blocks("Three laptops on one Wi-Fi", "Over the internet"))
            members = said["vaio: swarm members"]
            for name, host in places.items():
                self.assertRegex(members, rf"{name} .*{re.escape(net.address(host))}:8484")
            asking = "from urllib.request import urlopen; print(urlopen('http://%s:8080/', timeout=10).status)"
            command = f'{sys.executable} -c "{asking % net.address("w1")}"'
            self.assertEqual(self.run_line(net, "w2", "dog1", command).strip(), "200")

    def test_over_the_internet(self) -> None:
        """The lines of the documentation page work for a rented computer with a firewall and laptops behind routers.

        One of the laptops has no UDP.
        """
        sites = [Site("o", NatKind.PORT), Site("h", NatKind.PORT), Site("u", NatKind.NOUDP)]
        with Internet(sites) as net:
            net.get_namespace(PUBLIC_HOST).run(f"nft -f - <<'END'\n{FIREWALL}\nEND\n")
            places = {"boss": "o1", "host1": PUBLIC_HOST, "cam1": "h1", "cam2": "u1"}
            making, *rest = self.blocks("Over the internet", "")
            self.follow(net, places, [making])
            for ending in ("toml", "membership"):  # the documentation page uses scp here
                shutil.move(self.home("boss") / f"host1.{ending}", self.home("host1"))
            said = self.follow(net, places, rest)
            gone = self.home("cam2") / "log"
            until(lambda: "revoked the certificate" in gone.read_text(), told=self.logs)
            members = said["boss: swarm members"]
            self.assertRegex(members, r"cam2 +revoked")
            self.assertRegex(members, r"cam1 .*bootstrap")
            self.assertRegex(members, rf"host1 .*{re.escape(net.address(PUBLIC_HOST))}:8484")
            self.assertFalse((self.home("host1") / ".config").exists(), "the operator's key is on no other computer")
