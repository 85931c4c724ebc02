"""Configuration: the files of the demonstration's nodes, as text.

Knows what ``twistd swarm-node --config FILE`` reads, and nothing of what it does with that.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sim.demo.cast import LOOPBACK, Robot

BOOTSTRAP = "vaio"
RESERVE = "pi"
DOGS = ("dog1", "dog2", "dog3")

JUDGE, YARD = "judge", "yard"
"""The two processes of a demonstration that are no nodes: this one, and the world."""

Table = Mapping[str, object]
FAULTS: Table = {"allow": True}
"""A demonstration is there to see robots fail."""


@dataclass(frozen=True)
class Place:
    """Where one process of a demonstration runs, as its network sees it; without more said all are on one machine.

    ``host`` is where it listens, ``entry`` where it finds the bootstrap and web node, ``yard`` where it finds the yard,
    and ``enter`` what stands before its command, so that it runs there.
    """

    host: str = LOOPBACK
    entry: str = LOOPBACK
    yard: str = LOOPBACK
    enter: tuple[str, ...] = ()


@dataclass(frozen=True)
class Plan:
    """Where everything of one demonstration listens and lies; ``nodes`` maps a node's name to its UDP port."""

    run_dir: Path
    web_host: str
    web_port: int
    yard_port: int
    nodes: Mapping[str, int]
    code: str
    """What operators sign in to the page with."""
    reserve_port: int
    """Where the second web node serves the page, for when the first is lost."""
    tls_ports: tuple[int, int] = (0, 0)
    """Where each of the two serves it over TLS; 0: nowhere."""
    robots: Mapping[str, Robot] = field(default_factory=dict)
    """What each dog is."""
    places: Mapping[str, Place] = field(default_factory=dict)
    """Where each process runs, by its name; those that are not named run on this machine."""

    def place(self, name: str) -> Place:
        """Where the process ``name`` runs."""
        return self.places.get(name, Place())

    def file(self, name: str) -> Path:
        """The configuration file of the node ``name``."""
        return self.run_dir / f"{name}.toml"

    def texts(self) -> dict[str, str]:
        """The configuration of every node: the laptop that lets others in, the other web node, then the dogs."""
        laptop = self._node(BOOTSTRAP, "laptop", "Bootstrap node and web node", ["bootstrap", "edge", "web"])
        reserve = self._node(RESERVE, "computer", "Web node for when the other is lost", ["edge", "web"])
        ports = zip((self.web_port, self.reserve_port), self.tls_ports, strict=True)
        webs = {
            name: self._web(name, node, *each)
            for (name, node), each in zip(((BOOTSTRAP, laptop), (RESERVE, reserve)), ports, strict=True)
        }
        return {**webs, **{name: self._dog(name) for name in DOGS}}

    def founding(self) -> list[str]:
        """What makes the demonstration's own closed team, as ``swarm init`` takes it: each node has its membership."""
        team, folder = f"demo-{self.nodes[BOOTSTRAP]}", str(self.run_dir)
        words = [team, "--first", BOOTSTRAP, "--folder", folder, "--operator", str(self.run_dir / "operator.key")]
        members = [f"{RESERVE}=device,operator,gateway", *DOGS]
        return [*words, *(word for member in members for word in ("--member", member))]

    @property
    def played(self) -> str:
        """What the yard has to play beside its own simulated dogs; empty where it has nothing to."""
        return toml({name: robot.played for name, robot in self.robots.items() if robot.kind != "sim"})

    def _node(self, name: str, kind: str, description: str, roles: list[str]) -> Table:
        return {
            "name": name,
            "kind": kind,
            "description": description,
            "host": self.place(name).host,
            "port": self.nodes[name],
            "known_nodes": [] if name == BOOTSTRAP else [f"{self.place(name).entry}:{self.nodes[BOOTSTRAP]}"],
            "store": str(self.run_dir / f"{name}.sqlite"),
            "membership": str(self.run_dir / f"{name}.membership"),
            "roles": roles,
        }

    def _web(self, name: str, node: Table, port: int, tls_port: int) -> str:
        yard = f"{self.place(name).yard}:{self.yard_port}"
        web = {"host": self.web_host, "port": port, "yard": yard, "code": self.code}
        tls = {"tls": "auto", "tls_port": tls_port} if tls_port else {}
        return toml({"node": node, "web": {**web, **tls}, "faults": FAULTS})

    def _dog(self, name: str) -> str:
        robot = self.robots[name]
        return toml(
            {
                "node": self._node(name, robot.model, robot.about, ["edge"]),
                "agent": {"module": "search"},
                "driver": robot.driver,
                "faults": FAULTS,
            }
        )


def toml(tables: Mapping[str, Table]) -> str:
    """The TOML text of ``tables``, whose values are texts, numbers, lists of them, or one more level of table."""
    lines: list[str] = []
    for title, table in tables.items():
        lines.append(f"[{title}]")
        lines += [f"{key} = {_value(value)}" for key, value in table.items()]
        lines.append("")
    return "\n".join(lines)


def _value(value: object) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_value(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    # JSON's texts, numbers, booleans and lists are lawful TOML, but for DEL, which JSON leaves as it is.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
