"""Configuration: the files of the demonstration's nodes, as text.

Knows what ``twistd swarm-node --config FILE`` reads, and nothing of what it does with that.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

LOOPBACK = "127.0.0.1"
BOOTSTRAP = "vaio"
RESERVE = "pi"
DOGS = ("dog1", "dog2", "dog3")

Table = Mapping[str, object]
FAULTS: Table = {"allow": True}
"""A demonstration is there to see robots fail."""


@dataclass(frozen=True)
class Plan:
    """Where everything of one demonstration listens and lies; ``nodes`` maps a node's name to its UDP port."""

    run_dir: Path
    team_key: str
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

    def file(self, name: str) -> Path:
        """The configuration file of the node ``name``."""
        return self.run_dir / f"{name}.toml"

    def texts(self) -> dict[str, str]:
        """The configuration of every node: the laptop that lets others in, the other web node, then the dogs."""
        laptop = self._node(BOOTSTRAP, "laptop", "Bootstrap node and web node", ["bootstrap", "edge", "web"])
        reserve = self._node(RESERVE, "computer", "Web node for when the other is lost", ["edge", "web"])
        ports = zip((self.web_port, self.reserve_port), self.tls_ports, strict=True)
        webs = {
            name: self._web(node, *each)
            for (name, node), each in zip(((BOOTSTRAP, laptop), (RESERVE, reserve)), ports, strict=True)
        }
        return {**webs, **{name: self._dog(name) for name in DOGS}}

    def _node(self, name: str, kind: str, description: str, roles: list[str]) -> Table:
        return {
            "name": name,
            "kind": kind,
            "description": description,
            "host": LOOPBACK,
            "port": self.nodes[name],
            "known_nodes": [] if name == BOOTSTRAP else [f"{LOOPBACK}:{self.nodes[BOOTSTRAP]}"],
            "store": str(self.run_dir / f"{name}.sqlite"),
            "team_key": self.team_key,
            "roles": roles,
        }

    def _web(self, node: Table, port: int, tls_port: int) -> str:
        yard = f"{LOOPBACK}:{self.yard_port}"
        web = {"host": self.web_host, "port": port, "yard": yard, "code": self.code}
        tls = {"tls": "auto", "tls_port": tls_port} if tls_port else {}
        return toml({"node": node, "web": {**web, **tls}, "faults": FAULTS})

    def _dog(self, name: str) -> str:
        options = {"host": LOOPBACK, "port": self.yard_port, "robot": name, "camera_fps": 15}
        return toml(
            {
                "node": self._node(name, "robot", f"Simulated ERS-7 with {name[-1]} yellow stripes", ["edge"]),
                "agent": {"module": "search"},
                "driver": {"kind": "sim", "options": options},
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
    # JSON's texts, numbers, booleans and lists are lawful TOML, but for DEL, which JSON leaves as it is.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
