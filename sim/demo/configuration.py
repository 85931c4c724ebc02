"""Write the configuration files of the demonstration's nodes.

This module only writes the format of the files that ``twistd swarm-node --config FILE`` reads.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sim.demo.robots import LOOPBACK, Robot

BOOTSTRAP = "vaio"
RESERVE = "pi"
DOGS = ("dog1", "dog2", "dog3")

JUDGE, SIMULATOR = "judge", "yard"
"""The two processes of a demonstration that are not nodes: this one, and the robot simulator."""

Table = Mapping[str, object]
FAULTS: Table = {"allow": True}
"""All nodes of a demonstration allow fault injection."""


@dataclass(frozen=True)
class Location:
    """The network location of one process of a demonstration; by default all are on one machine.

    ``host`` is the address on which the process listens. ``entry`` is the address at which it reaches the bootstrap
    and web node, ``yard`` the address at which it reaches the robot simulator. ``enter`` is the command prefix that
    runs the process at this location.
    """

    host: str = LOOPBACK
    entry: str = LOOPBACK
    yard: str = LOOPBACK
    enter: tuple[str, ...] = ()


@dataclass(frozen=True)
class Plan:
    """Addresses, ports and folders of one demonstration; ``nodes`` maps a node's name to its UDP port."""

    run_dir: Path
    web_host: str
    web_port: int
    simulator_port: int
    nodes: Mapping[str, int]
    code: str
    """The operators' sign-in code of the page."""
    reserve_port: int
    """The port of the second web node's page."""
    tls_ports: tuple[int, int] = (0, 0)
    """The TLS ports of the two pages; 0 for none."""
    robots: Mapping[str, Robot] = field(default_factory=dict)
    """The robots by the names of the dogs."""
    locations: Mapping[str, Location] = field(default_factory=dict)
    """The location of each process by name; other processes run on this machine."""

    def get_location(self, name: str) -> Location:
        """Return the location of the process ``name``."""
        return self.locations.get(name, Location())

    def get_config_path(self, name: str) -> Path:
        """Return the path of the configuration file of the node ``name``."""
        return self.run_dir / f"{name}.toml"

    def make_configs(self) -> dict[str, str]:
        """Return the configuration of every node: the bootstrap node, the second web node, then the dogs."""
        laptop = self._make_node_table(BOOTSTRAP, "laptop", "Bootstrap node and web node", ["bootstrap", "edge", "web"])
        reserve = self._make_node_table(RESERVE, "computer", "Web node for when the other is lost", ["edge", "web"])
        ports = zip((self.web_port, self.reserve_port), self.tls_ports, strict=True)
        webs = {
            name: self._make_web_config(name, node, *each)
            for (name, node), each in zip(((BOOTSTRAP, laptop), (RESERVE, reserve)), ports, strict=True)
        }
        return {**webs, **{name: self._make_dog_config(name) for name in DOGS}}

    def make_init_arguments(self) -> list[str]:
        """Return the arguments of ``swarm init`` that create the demonstration's closed team with all memberships."""
        team, folder = f"demo-{self.nodes[BOOTSTRAP]}", str(self.run_dir)
        words = [team, "--first", BOOTSTRAP, "--folder", folder, "--operator", str(self.run_dir / "operator.key")]
        members = [f"{RESERVE}=device,operator,gateway", *DOGS]
        return [*words, *(word for member in members for word in ("--member", member))]

    @property
    def emulated_robots(self) -> str:
        """The robots that the simulator emulates in addition to its own dogs, as TOML; may be empty."""
        return encode_toml({name: robot.simulator_table for name, robot in self.robots.items() if robot.kind != "sim"})

    def _make_node_table(self, name: str, kind: str, description: str, roles: list[str]) -> Table:
        return {
            "name": name,
            "kind": kind,
            "description": description,
            "host": self.get_location(name).host,
            "port": self.nodes[name],
            "known_nodes": [] if name == BOOTSTRAP else [f"{self.get_location(name).entry}:{self.nodes[BOOTSTRAP]}"],
            "store": str(self.run_dir / f"{name}.sqlite"),
            "membership": str(self.run_dir / f"{name}.membership"),
            "roles": roles,
        }

    def _make_web_config(self, name: str, node: Table, port: int, tls_port: int) -> str:
        simulator = f"{self.get_location(name).yard}:{self.simulator_port}"
        web = {"host": self.web_host, "port": port, "yard": simulator, "code": self.code}
        tls = {"tls": "auto", "tls_port": tls_port} if tls_port else {}
        return encode_toml({"node": node, "web": {**web, **tls}, "faults": FAULTS})

    def _make_dog_config(self, name: str) -> str:
        robot = self.robots[name]
        return encode_toml(
            {
                "node": self._make_node_table(name, robot.model, robot.description, ["edge"]),
                "agent": {"module": "search"},
                "driver": robot.driver_table,
                "faults": FAULTS,
            }
        )


def encode_toml(tables: Mapping[str, Table]) -> str:
    """Encode ``tables`` as TOML; values are strings, numbers, lists of these, or tables with such values."""
    lines: list[str] = []
    for title, table in tables.items():
        lines.append(f"[{title}]")
        lines += [f"{key} = {_encode_value(value)}" for key, value in table.items()]
        lines.append("")
    return "\n".join(lines)


def _encode_value(value: object) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_encode_value(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_encode_value(item) for item in value) + "]"
    # JSON strings, numbers, booleans and lists are valid TOML, except for DEL, which JSON does not escape.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
