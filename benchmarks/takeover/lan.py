"""A network namespace for each node, and a router between them that can cut a node off.

Needs Linux with ``unshare`` and ``ip``, without privileges: ``python -m benchmarks.takeover --real`` runs itself in a
user and network namespace, in which this process is the router. The robots are attached to the router itself, so a node
that loses its radio connection keeps its robot.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

RULE = "100"
PORT = 7000


def run_in_network(arguments: Sequence[str]) -> int:
    """Run this program's ``arguments`` as the router of a separate network; return its exit code."""
    own = ["unshare", "--user", "--map-root-user", "--net", "--kill-child", "--fork", "--pid", "--mount-proc"]
    return subprocess.run([*own, sys.executable, *arguments], check=False).returncode


class Lan:
    """Nodes by name, each in a separate namespace; create it inside of ``run_in_network``."""

    def __init__(self, names: Sequence[str]) -> None:
        self._numbers = {name: number for number, name in enumerate(names, start=1)}
        self._holders: dict[str, subprocess.Popen[bytes]] = {}
        _run_ip("link", "set", "lo", "up")
        Path("/proc/sys/net/ipv4/ip_forward").write_text("1", encoding="ascii")
        for name in names:
            self._connect(name)

    def get_address(self, name: str) -> str:
        """Return the address of the node ``name``."""
        return f"10.9.{self._numbers[name]}.2"

    def get_router_address(self, name: str) -> str:
        """Return the router's address for the node ``name``, at which its robot is."""
        return f"10.9.{self._numbers[name]}.1"

    def command(self, name: str, arguments: Sequence[str]) -> list[str]:
        """Return ``arguments`` as a command that runs in the namespace of ``name``."""
        return ["nsenter", "--net", f"--target={self._holders[name].pid}", *arguments]

    def silence(self, name: str, one_way: bool = False) -> None:
        """Drop all traffic from a node to the other nodes, and unless ``one_way`` all traffic to this node."""
        _run_ip("rule", "add", "iif", self._get_link_name(name), "blackhole", "priority", RULE)
        for other in self._numbers if not one_way else ():
            if other != name:
                _run_ip(
                    "rule",
                    "add",
                    "iif",
                    self._get_link_name(other),
                    "to",
                    self.get_address(name),
                    "blackhole",
                    "priority",
                    RULE,
                )

    def close(self) -> None:
        """Remove every namespace with its processes."""
        for holder in self._holders.values():
            holder.kill()
            holder.wait()
        for name in self._numbers:
            subprocess.run(["ip", "link", "delete", self._get_link_name(name)], check=False, stderr=subprocess.DEVNULL)
        while (
            subprocess.run(["ip", "rule", "del", "priority", RULE], check=False, stderr=subprocess.DEVNULL).returncode
            == 0
        ):
            pass

    def _get_link_name(self, name: str) -> str:
        return f"way{self._numbers[name]}"

    def _connect(self, name: str) -> None:
        holder = self._holders[name] = subprocess.Popen(["unshare", "--net", "sleep", "600"])
        here = os.readlink("/proc/self/ns/net")
        while os.readlink(f"/proc/{holder.pid}/ns/net") == here:
            time.sleep(0.005)
        link, host, router = self._get_link_name(name), self.get_address(name), self.get_router_address(name)
        _run_ip("link", "add", link, "type", "veth", "peer", "name", "air", "netns", str(holder.pid))
        _run_ip("address", "add", f"{router}/24", "dev", link)
        _run_ip("link", "set", link, "up")
        for words in (
            ["link", "set", "lo", "up"],
            ["address", "add", f"{host}/24", "dev", "air"],
            ["link", "set", "air", "up"],
            ["route", "add", "default", "via", router],
        ):
            subprocess.run(self.command(name, ["ip", *words]), check=True)


def _run_ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)
