"""Define the faults of a scenario: kind, time, duration, and affected nodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from formats.convert import UNIQUE, Unit, one_of

_AFFECTED_KEYS = ("count", "share", "places")
KEYS_BY_KIND: dict[str, tuple[str, ...]] = {
    "crash": (*_AFFECTED_KEYS, "lasts", "over"),
    "leave": (*_AFFECTED_KEYS, "lasts", "over"),
    "freeze": (*_AFFECTED_KEYS, "lasts", "over"),
    "cut": (*_AFFECTED_KEYS, "lasts"),
    "deaf": (*_AFFECTED_KEYS, "lasts"),
    "mute": (*_AFFECTED_KEYS, "lasts"),
    "clog": (*_AFFECTED_KEYS, "lasts", "over"),
    "pairs": ("share", "lasts"),
    "step": (*_AFFECTED_KEYS, "lasts", "amount"),
    "rate": (*_AFFECTED_KEYS, "lasts", "amount"),
    "full": (*_AFFECTED_KEYS, "lasts"),
    "crowd": ("count", "lasts", "over"),
    "weather": ("lasts", "amount"),
    "rebind": _AFFECTED_KEYS,
}
"""The kinds of faults, each with the further keys that it accepts."""
KINDS = tuple(KEYS_BY_KIND)
LASTING = ("cut", "deaf", "mute", "clog", "pairs", "freeze", "rate", "full", "weather")
"""The kinds that require a duration."""
KINDS_WITH_PLACES = tuple(kind for kind, taken in KEYS_BY_KIND.items() if "places" in taken)
"""The kinds that affect selected nodes."""


@dataclass(frozen=True)
class Fault:
    """``[[fault]]``: one fault.

    The affected nodes are either a random selection of living nodes, given by number (``count``) or by ``share``, or
    the nodes at ``places``, which are numbered from 0.
    """

    kind: Annotated[str, one_of(KINDS)]
    """``crash``: loss of power. ``leave``: graceful leave. ``freeze``: like SIGSTOP. ``cut``: the affected nodes are
    partitioned from all other nodes. ``deaf``: no datagrams reach the affected nodes. ``mute``: no datagrams of the
    affected nodes are delivered. ``clog``: each affected node is isolated. ``pairs``: a share of all pairs of nodes is
    cut. ``step``: wall clocks are changed by ``amount`` seconds. ``rate``: clocks run ``amount`` times as fast.
    ``full``: disks are full. ``crowd``: ``count`` new nodes join. ``weather``: network conditions worsen, and the
    share ``amount`` of all datagrams is lost in addition. ``rebind``: routers drop their mappings."""

    at: Annotated[float, Meta(ge=0.0, le=1e7), Unit("seconds")]
    """Start in seconds after the team has settled."""

    lasts: Annotated[float, Meta(ge=0.0, le=1e7), Unit("seconds")] = 0.0
    """Duration in seconds, after which the fault ends and crashed nodes restart from disk; 0: permanent."""

    count: Annotated[int, Meta(ge=0, le=100_000)] = 0
    """Number of affected nodes."""

    share: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    """Share of affected nodes."""

    places: Annotated[tuple[Annotated[int, Meta(ge=0)], ...], UNIQUE] = ()
    """The numbers of the affected nodes."""

    amount: Annotated[float, Meta(ge=-1e7, le=1e7)] = 0.0
    """Strength of the fault; its meaning depends on the kind."""

    over: Annotated[float, Meta(ge=0.0, le=1e6), Unit("seconds")] = 0.0
    """Seconds over which the fault spreads from node to node; 0: it affects all nodes at the same time."""

    def __str__(self) -> str:
        whom = ",".join(map(str, self.places)) or (f"{self.share:.0%}" if self.share else str(self.count or ""))
        words = [f"{self.at:g} s", self.kind, whom, f"by {self.amount:g}" if self.amount else ""]
        return " ".join(filter(None, [*words, f"for {self.lasts:g} s" if self.lasts else ""]))


Problem = tuple[str, str, str]


def find_problem(fault: Fault, nodes: int, seconds: float) -> Problem | None:
    """Return the error of a fault in a team of ``nodes`` that runs ``seconds``, as key, problem and remedy, or None."""
    chosen = sum(map(bool, (fault.count, fault.share, fault.places)))
    kind = fault.kind
    for key in (*_AFFECTED_KEYS, "lasts", "over", "amount"):
        if getattr(fault, key) and key not in KEYS_BY_KIND[kind]:
            return key, f"is not valid for {kind}", f"leave it out; {kind} takes {', '.join(KEYS_BY_KIND[kind])}"
    if fault.at > seconds:
        return "at", f"is after the end of the run, at {seconds:g} s", "increase seconds, or decrease at"
    if kind in LASTING and not fault.lasts:
        return "lasts", f"is required for {kind}", "write lasts = 10"
    if kind in KINDS_WITH_PLACES and chosen != 1:
        return "kind", f"{kind} needs one of count, share and places", "write share = 0.5, or count = 1"
    if kind == "pairs" and not 0 < fault.share < 1:
        return "share", "must be the share of blocked pairs", "write share = 0.05"
    if kind == "crowd" and not fault.count:
        return "count", "must be the number of newcomers", "write count = 100"
    if any(place >= nodes for place in fault.places):
        return "places", f"contains {max(fault.places)}, but the team has the places 0 to {nodes - 1}", "leave it out"
    if kind in KINDS_WITH_PLACES and fault.count > nodes:
        return "count", f"is more than the {nodes} nodes", "use a smaller number"
    if kind == "crash" and not fault.lasts and (fault.count == nodes or fault.share == 1.0):
        return "share", "leaves no node", "use a smaller number, or restart the nodes: lasts = 10"
    if kind == "rate" and not 0.5 <= fault.amount <= 2:
        return "amount", "must be 0.5 to 2 times as fast", "write amount = 1.05"
    if kind == "step" and not fault.amount:
        return "amount", "must be the step of the clock in seconds", "write amount = -60"
    if kind == "weather" and not 0 < fault.amount < 1:
        return "amount", "must be the share of lost datagrams", "write amount = 0.1"
    return None
