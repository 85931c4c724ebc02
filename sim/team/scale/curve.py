"""Define the curves: figures against the number of nodes, with theoretical and published values.  Pure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sim.team.metric import Bound
from sim.team.scale import theory
from sim.team.scale.theory import Published, Theory


@dataclass(frozen=True)
class Curve:
    """The curve of ``metric``, in ``unit``; ``bound`` is its target, ``bounds_by_size`` the targets of single sizes."""

    metric: str
    title: str
    unit: str
    theory: Theory | None = None
    theory_label: str = ""
    """A description of the theoretical curve."""
    is_limit: bool = False
    """Whether the theoretical curve is the target."""
    bound: Bound | None = None
    min_nodes: int = 0
    """Minimum number of nodes for which the target applies."""
    bounds_by_size: tuple[tuple[int, Bound], ...] = ()
    published: Sequence[Published] = ()

    def get_target(self, nodes: int) -> Bound | None:
        """Return the target for a team of that size."""
        if self.is_limit and self.theory is not None:
            return Bound(self.theory(nodes))
        return dict(self.bounds_by_size).get(nodes, self.bound if nodes >= self.min_nodes else None)


LARGE_NODES = 1000
"""Minimum number of nodes for which the targets of cost apply."""

CURVES = (
    Curve("lookups.success", "Lookups that find their node within 4 s", "share", bound=Bound(0.999, is_maximum=False)),
    Curve("lookups.hops.mean", "Hops of a lookup", "hops", theory.hops, "log2(n) / 2, the most that is wanted", True),
    Curve(
        "lookups.reached.p50",
        "Until who is looked for answers, half of them; 156 ms there and back",
        "s",
        bound=Bound(0.45),
        published=(
            Published(1024, 0.45, "Kademlia in p2psim, Li et al. 2005"),
            Published(5000, 0.63, "5 parallel in OverSim, Heep 2010"),
        ),
    ),
    Curve("lookups.seconds.p50", "... until all of the k closest have answered", "s"),
    Curve("lookups.exact", "Lookups with exactly the k closest, in quiet", "share", bound=Bound(1.0, is_maximum=False)),
    Curve("traffic.datagrams", "Datagrams sent by a node, in quiet", "a second"),
    Curve(
        "traffic.bytes",
        "Bytes sent by a node, in quiet",
        "B/s",
        bound=Bound(200.0),
        min_nodes=LARGE_NODES,
        published=(
            Published(1000, 900.0, "Bamboo, sessions of 1.4 min, Rhea et al. 2004"),
            Published(5000, 300.0, "Kademlia in OverSim, Heep 2010"),
        ),
    ),
    Curve("traffic.contacts", "Contacts of a node", "contacts", theory.contacts, "k out of each half of the ids"),
    Curve("traffic.memory", "Memory of a node, simulated", "KiB", bound=Bound(200.0), min_nodes=LARGE_NODES),
    Curve(
        "traffic.cpu",
        "Processor of a node, simulated, in quiet",
        "ms a second",
        bound=Bound(0.5),
        min_nodes=LARGE_NODES,
    ),
    Curve(
        "auctions.agree.p95",
        "One task for all: seconds until 95 % of the agents agree, 10 % loss",
        "s",
        theory.agreement,
        "rounds of the simulation in docs/explanation/choosing-a-robot.md",
        bound=Bound(1.0),
        bounds_by_size=((100, Bound(0.6)), (1000, Bound(0.8))),
    ),
    Curve("auctions.right", "... the share of agents that is right", "share", bound=Bound(0.99, is_maximum=False)),
    Curve(
        "auctions.messages",
        "... datagrams sent by an agent",
        "datagrams",
        theory.tree,
        "4 (n - 1) / n: a tree, without loss",
        bound=Bound(6.0),
        bounds_by_size=((3, Bound(10.0)), (10, Bound(10.0)), (30, Bound(10.0))),
        published=(Published(100, 4.6, "acknowledged tree, simulated"),),
    ),
    Curve(
        "auctions.busiest",
        "... datagrams at the busiest node",
        "datagrams",
        theory.busiest,
        "the same simulation, without loss",
        bound=Bound(1000.0),
    ),
    Curve(
        "takeovers.seconds.p50",
        "Takeover after who acts died, half of them; lease 1.5 s, 10 % loss",
        "s",
        theory.takeover,
        "the lease alone, simulated",
        bound=Bound(1.5),
    ),
    Curve("takeovers.seconds.p99", "... 99 % of them", "s", bound=Bound(2.0)),
    Curve(
        "directory.busiest",
        "Directory: share of all devices that the busiest node holds",
        "share",
        theory.share,
        "k / n: spread evenly",
        bound=Bound(0.01),
        min_nodes=LARGE_NODES,
    ),
    Curve("directory.seconds.p50", "... seconds until a node has listed all devices", "s"),
)
