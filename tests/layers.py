"""The layers of the code as data: the job of each package, and the packages that its modules may import.

``tests.test_house`` checks each import against ``LAYERS``; ``python -m tests.layers`` writes the tables in
docs/explanation/architecture.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "explanation" / "architecture.md"
BEGIN, END = "<!-- layers: python -m tests.layers -->\n", "<!-- end of the layers -->\n"
TOP = ("agents", "drivers", "formats", "middleware", "sim", "swarmnode", "webnode")
"""The packages of the product."""


@dataclass(frozen=True)
class Layer:
    """The ``job`` of a package in one line, and the other packages or modules that the package ``uses``."""

    job: str
    uses: tuple[str, ...] = ()


def _entangled(*names: str) -> tuple[str, ...]:
    return tuple(f"middleware.entangled.{name}" for name in names)


def _middleware(*names: str) -> tuple[str, ...]:
    return tuple(f"middleware.{name}" for name in names)


BASE = _entangled("background", "bounded", "contact", "errors", "identity", "listeners", "record", "token_bucket")
"""Small modules of the library that all its packages may import."""
LIBRARY = _middleware("entangled", "errors")

LAYERS: dict[str, Layer] = {
    "formats": Layer("settings and options checked by their annotations; HTTP heads, WebSocket and JPEG as bytes"),
    "middleware.entangled.network": Layer(
        "datagrams: UDP, TCP and WebSocket tunnels, multicast, and the switchboard in memory", ("formats", *BASE)
    ),
    "middleware.entangled.wire": Layer(
        "Noise sessions, requests and answers, fragments, retransmission", (*BASE, *_entangled("network"))
    ),
    "middleware.entangled.kademlia": Layer(
        "contacts, buckets, lookups, the table of members", (*BASE, *_entangled("network", "wire"))
    ),
    "middleware.entangled.nat": Layer(
        "paths to nodes behind routers: introduction, hole punching, relays", (*BASE, *_entangled("network", "wire"))
    ),
    "middleware.entangled.data": Layer("the store: in memory and in SQLite", BASE),
    "middleware.entangled.replication": Layer(
        "records that a node owns, holds for others, reads, watches and hands over",
        (*BASE, *_entangled("data", "kademlia", "wire")),
    ),
    "middleware.entangled.quorum": Layer("agreement by a majority: Paxos with leases ([quorum.md](quorum.md))"),
    "middleware.entangled.space": Layer(
        "keywords and the tuple space ([tuplespace.md](../reference/tuple-space.md))",
        (*BASE, *_entangled("data", "kademlia.distance", "quorum", "replication")),
    ),
    "middleware.entangled.control": Layer(
        "the socket for shells and other languages; the quality of links", ("middleware.entangled",)
    ),
    "middleware.entangled": Layer(
        "the peer-to-peer library: `node.py` wires the packages below; knows no device",
        _entangled("data", "kademlia", "nat", "network", "replication", "space", "wire"),
    ),
    "middleware.directory": Layer("presence of devices, and the list of all, split by prefix", LIBRARY),
    "middleware.consensus.lease": Layer("task leases with fencing tokens, granted by a majority of a council", LIBRARY),
    "middleware.stop": Layer("stops of the whole team and their releases", LIBRARY),
    "middleware.tasks": Layer(
        "tasks, orders about them, and their councils", (*LIBRARY, *_middleware("directory", "consensus.lease"))
    ),
    "middleware.consensus": Layer(
        "the choice of the acting agent: strategies, their conformance kit, the checks around them, decision records",
        (*LIBRARY, *_middleware("directory", "tasks")),
    ),
    "middleware.consensus.bidding": Layer(
        "the delivery of bids to the council and of its announcement back: direct, tree, flood",
        (*LIBRARY, *_middleware("consensus", "directory", "tasks")),
    ),
    "middleware.admission": Layer(
        "closed teams: certificates, roles, joining, revocation, renewal", (*LIBRARY, "middleware.directory.prefix")
    ),
    "middleware": Layer(
        "`node.py` wires the packages above; `errors.py` has their exceptions",
        (*LIBRARY, *_middleware("admission.team", "consensus", "directory", "stop", "tasks")),
    ),
    "middleware.config": Layer(
        "the settings file, its types, and changes while the node runs",
        (*LIBRARY, "formats", *_middleware("directory", "node")),
    ),
    "middleware.deployment": Layer(
        "strategies and behaviours that an operator pushes; off unless allowed",
        (*LIBRARY, *_middleware("admission.roles", "config", "consensus", "directory")),
    ),
    "middleware.diagnostics": Layer(
        "answers about a running node: its store, contacts, links and decisions",
        (*LIBRARY, *_middleware("consensus", "directory", "node", "tasks")),
    ),
    "middleware.faults": Layer(
        "fault injection into a running node ([faults.md](../how-to/inject-faults.md))",
        (*LIBRARY, "formats", *_middleware("directory", "node", "tasks")),
    ),
    "drivers": Layer("one contract for every robot, one package a kind; no kind knows another", ("formats",)),
    "agents": Layer(
        "observe, report, decide, execute, give back",
        (
            *LIBRARY,
            *("formats", "drivers.driver", "drivers.errors", "drivers.reading"),
            *_middleware("consensus", "directory", "node", "stop", "tasks"),
        ),
    ),
    "middleware.frontend": Layer(
        "the team as a user interface needs it: a view of its records, a client that calls and orders",
        (*LIBRARY, *_middleware("consensus", "diagnostics", "directory", "node", "stop", "tasks")),
    ),
    "webnode": Layer(
        "the page over the node's store",
        (
            *("formats", *LIBRARY),
            *_middleware("admission.roles", "config", "diagnostics.node_diagnostics", "directory.presence", "faults"),
            *_middleware("frontend", "node", "stop", "tasks"),
        ),
    ),
    "sim.robots": Layer(
        "the simulator of robots: world, cameras, sensors, emulators, and the server that drivers connect to",
        ("formats", "drivers", "middleware.entangled.listeners", "middleware.faults.stream"),
    ),
    "sim.demo": Layer("the demonstration", ("drivers", "sim.robots")),
    "sim.team": Layer(
        "the simulator of teams in virtual time: nodes, faults, schedules, invariants "
        "([simulate-teams.md](../how-to/simulate-teams.md))",
        ("formats", "middleware", *(f"drivers.{name}" for name in ("driver", "errors", "gate", "link"))),
    ),
    "sim.namespaces": Layer(
        "an internet of network namespaces, and the demonstration across it ([nat.md](../internals/nat.md))",
        ("sim.demo",),
    ),
    "swarmnode": Layer("settings in, a running node out; the `swarm` command", TOP),
}
"""The layers from bottom to top.  A module belongs to the layer with the longest matching name."""


def layer_of(module: str) -> str:
    """Return the package of ``LAYERS`` that contains ``module``; raise ``ValueError`` if there is none."""
    return max((name for name in LAYERS if is_within(module, name)), key=len)


def may_import(module: str, name: str) -> bool:
    """Return whether the layers permit ``module`` to import ``name``."""
    package = layer_of(module)
    if not any(is_within(name, each) for each in LAYERS):
        return False  # tests, for example, are not part of the product
    if layer_of(name) == package:
        return True
    return any(is_within(name, used) for used in LAYERS[package].uses)


def is_within(module: str, package: str) -> bool:
    """Return whether ``module`` is ``package`` or inside it."""
    return module == package or module.startswith(package + ".")


def write_table() -> str:
    """Return the table of the architecture page."""
    rows = [f"| `{name.replace('.', '/')}` | {each.job} | {_uses(name, each)} |\n" for name, each in LAYERS.items()]
    return f"{BEGIN}\n| package | its job | may import, in addition to itself |\n|---|---|---|\n{''.join(rows)}\n{END}"


def _uses(package: str, layer: Layer) -> str:
    inside = package.startswith("middleware.entangled.")
    names = [name for name in layer.uses if name not in BASE]
    short = [name.removeprefix("middleware.entangled." if inside else "middleware.") for name in names]
    return ", ".join(f"`{name.replace('.', '/')}`" for name in short)


def main() -> None:
    """Replace the table in the page."""
    text = PAGE.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN, 1)
    PAGE.write_text(before + write_table() + rest.split(END, 1)[1], encoding="utf-8")


if __name__ == "__main__":
    main()
