"""The faults of a scenario: what happens to the team at a moment, and for how long."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from formats.convert import UNIQUE, Unit, one_of

_WHOM = ("count", "share", "places")
TAKES: dict[str, tuple[str, ...]] = {
    "crash": (*_WHOM, "lasts", "over"),
    "leave": (*_WHOM, "lasts", "over"),
    "freeze": (*_WHOM, "lasts", "over"),
    "cut": (*_WHOM, "lasts"),
    "deaf": (*_WHOM, "lasts"),
    "mute": (*_WHOM, "lasts"),
    "clog": (*_WHOM, "lasts", "over"),
    "pairs": ("share", "lasts"),
    "step": (*_WHOM, "lasts", "amount"),
    "rate": (*_WHOM, "lasts", "amount"),
    "full": (*_WHOM, "lasts"),
    "crowd": ("count", "lasts", "over"),
    "weather": ("lasts", "amount"),
    "rebind": _WHOM,
}
"""The kinds, and what else each of them needs or may be told."""
KINDS = tuple(TAKES)
LASTING = ("cut", "deaf", "mute", "clog", "pairs", "freeze", "rate", "full", "weather")
"""Those that mean something only for a while."""
WHOM = tuple(kind for kind, taken in TAKES.items() if "places" in taken)
"""Those that befall chosen nodes."""


@dataclass(frozen=True)
class Fault:
    """``[[fault]]``: one of them.

    Whom it befalls is drawn from the seed: so many (``count``) or that ``share`` of those that live; or ``places``
    names them by their number, from 0 on.
    """

    kind: Annotated[str, one_of(KINDS)]
    """``crash``: the power fails.  ``leave``: with a goodbye.  ``freeze``: as after SIGSTOP.  ``cut``: away from all
    others, among themselves connected; ``deaf``: only nothing comes in; ``mute``: only nothing gets out; ``clog``: each
    of them alone.  ``pairs``: that ``share`` of all pairs of nodes is cut.  ``step``: wall clocks are set ``amount``
    seconds on or back.  ``rate``: clocks run ``amount`` times as fast.  ``full``: disks are full.  ``crowd``: ``count``
    newcomers.  ``weather``: the share ``amount`` of all datagrams is lost besides.  ``rebind``: routers forget their
    mappings."""

    at: Annotated[float, Meta(ge=0.0, le=1e7), Unit("seconds")]
    """When, in seconds after the team stands."""

    lasts: Annotated[float, Meta(ge=0.0, le=1e7), Unit("seconds")] = 0.0
    """For how long; after that it is taken back: who crashed or left starts again from its disk.  0: for good."""

    count: Annotated[int, Meta(ge=0, le=100_000)] = 0
    """How many."""

    share: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    """Which share of them."""

    places: Annotated[tuple[Annotated[int, Meta(ge=0)], ...], UNIQUE] = ()
    """Who, by number."""

    amount: Annotated[float, Meta(ge=-1e7, le=1e7)] = 0.0
    """How much."""

    over: Annotated[float, Meta(ge=0.0, le=1e6), Unit("seconds")] = 0.0
    """Seconds over which it spreads, one after the other; 0: all at once."""

    def __str__(self) -> str:
        whom = ",".join(map(str, self.places)) or (f"{self.share:.0%}" if self.share else str(self.count or ""))
        words = [f"{self.at:g} s", self.kind, whom, f"by {self.amount:g}" if self.amount else ""]
        return " ".join(filter(None, [*words, f"for {self.lasts:g} s" if self.lasts else ""]))


Problem = tuple[str, str, str]


def fault_problem(fault: Fault, nodes: int, seconds: float) -> Problem | None:
    """What is impossible about a fault in such a team: the key, the problem and the remedy."""
    chosen = sum(map(bool, (fault.count, fault.share, fault.places)))
    kind = fault.kind
    for key in (*_WHOM, "lasts", "over", "amount"):
        if getattr(fault, key) and key not in TAKES[kind]:
            return key, f"means nothing for {kind}", f"leave it out; {kind} goes by {', '.join(TAKES[kind])}"
    if fault.at > seconds:
        return "at", f"is after the end, {seconds:g} s", "let the scenario last longer, or let it happen earlier"
    if kind in LASTING and not fault.lasts:
        return "lasts", f"is needed: {kind} ends some time", "write lasts = 10"
    if kind in WHOM and chosen != 1:
        return "kind", f"{kind} needs one of count, share and places", "write share = 0.5, or count = 1"
    if kind == "pairs" and not 0 < fault.share < 1:
        return "share", "must say which share of the pairs is cut", "write share = 0.05"
    if kind == "crowd" and not fault.count:
        return "count", "must say how many come", "write count = 100"
    if any(place >= nodes for place in fault.places):
        return "places", f"names {max(fault.places)}, and there are 0 to {nodes - 1}", "leave it out"
    if kind in WHOM and fault.count > nodes:
        return "count", f"is more than the {nodes} nodes", "take fewer"
    if kind == "crash" and not fault.lasts and (fault.count == nodes or fault.share == 1.0):
        return "share", "leaves nobody", "take fewer, or let them come back: lasts = 10"
    if kind == "rate" and not 0.5 <= fault.amount <= 2:
        return "amount", "must be 0.5 to 2 times as fast", "write amount = 1.05"
    if kind == "step" and not fault.amount:
        return "amount", "must say how far the clock is set", "write amount = -60"
    if kind == "weather" and not 0 < fault.amount < 1:
        return "amount", "must be the share that is lost", "write amount = 0.1"
    return None
