"""Results of trials, and the requirements that they meet; pure."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial

from sim.demo.trials import percentile
from sim.namespaces.nat import NatKind

MATRIX = (NatKind.NONE, NatKind.FULL, NatKind.ADDR, NatKind.PORT, NatKind.SYM, NatKind.NOUDP)
PLAIN, ALONE, LOSS, HOME, LEAKY, FORGOTTEN, RENUMBERED, MOVED, IDLE = (
    "plain",
    "bootstrap cut off",
    "30 % loss",
    "one router",
    "leaky",
    "forgotten",
    "renumbered",
    "moved",
    "idle",
)
"""The parts of a run."""
DIRECT_S, RELAYED_S, LOSS_S, LEAKY_S, BACK_S, JOIN_S = 1.0, 2.5, 5.0, 5.0, 5.0, 2.5


@dataclass
class Outcome:
    """A trial of the pair ``a`` and ``b``; ``took_s`` has the seconds of each node, None without an answer.

    ``path`` is the path at the first answers, ``later`` the path at the end of the trial.
    """

    part: str
    a: str
    b: str
    took_s: list[float | None]
    path: str = ""
    later: str = ""
    joined_s: list[float] = field(default_factory=list)
    trouble: str = ""
    note: str = ""

    @property
    def seconds(self) -> float:
        """The seconds of the slower node; infinity if a node got no answer."""
        return max((math.inf if took is None else took for took in self.took_s), default=math.inf)

    @property
    def pair(self) -> tuple[str, str]:
        """The two kinds."""
        return self.a, self.b


@dataclass(frozen=True)
class Requirement:
    """A requirement, its measured result, and whether the result meets it."""

    what: str
    seen: str
    is_kept: bool


def is_punchable(a: NatKind, b: NatKind) -> bool:
    """Return whether datagrams sent at the same time from both sides can open a path (hole punching).

    This fails if one router filters by port and the other uses a different port for each peer.
    """
    closed = {NatKind.PORT, NatKind.SYM}
    return NatKind.NOUDP not in (a, b) and not (NatKind.SYM in (a, b) and {a, b} <= closed)


def format_cell(outcomes: Sequence[Outcome]) -> str:
    """Return the table cell of a pair: the path, the median and the maximum of the seconds."""
    if not outcomes:
        return ""
    there = [one for one in outcomes if one.seconds < math.inf]
    if not there:
        return "fails"
    paths = sorted({one.path for one in there}, key=lambda path: -sum(one.path == path for one in there))
    middle = statistics.median(one.seconds for one in there)
    words = f"{'/'.join(paths)} {middle:.2f} ({max(one.seconds for one in there):.2f})"
    return words if len(there) == len(outcomes) else f"{words}, {len(outcomes) - len(there)} of {len(outcomes)} fail"


def check_requirements(outcomes: Iterable[Outcome]) -> list[Requirement]:
    """Return the requirements of a run in the order of the parts, except for parts that were not run."""
    every = list(outcomes)
    plain = [one for one in every if one.part == PLAIN]
    open_ones = [one for one in plain if is_punchable(NatKind(one.a), NatKind(one.b))]
    closed = [one for one in plain if not is_punchable(NatKind(one.a), NatKind(one.b))]
    wanted: list[Requirement] = []

    def want(what: str, some: Sequence[Outcome], kept: Callable[[Outcome], bool], share: float = 1.0) -> None:
        if some:
            held = [one for one in some if kept(one)]
            times = [one.seconds for one in some]
            p50, worst = _format_seconds(percentile(times, 0.5)), _format_seconds(max(times))
            seen = f"{len(held)} of {len(some)}; p50 {p50}, worst {worst}"
            wanted.append(Requirement(what, seen, len(held) >= share * len(some)))

    want(
        "pairs that hole punching can connect are direct",
        open_ones,
        lambda one: one.path == "direct" and one.seconds < math.inf,
    )
    if open_ones:
        p95 = percentile([one.seconds for one in open_ones], 0.95)
        wanted.append(
            Requirement(f"their 95th percentile is at most {DIRECT_S:g} s", _format_seconds(p95), p95 <= DIRECT_S)
        )
    want(f"all other pairs connect within {RELAYED_S:g} s", closed, partial(_is_within, RELAYED_S))
    tunnelled = [one for one in closed if NatKind.NOUDP.value in one.pair]
    if tunnelled:
        times = [max(one.joined_s, default=math.inf) if len(one.joined_s) == 2 else math.inf for one in tunnelled]
        seen = f"{sum(took <= JOIN_S for took in times)} of {len(times)}; worst {_format_seconds(max(times))}"
        wanted.append(Requirement(f"nodes without UDP join within {JOIN_S:g} s", seen, max(times) <= JOIN_S))
    for part, (limit, words) in _LIMITS_BY_PART.items():
        some = [one for one in every if one.part == part]
        want(f"{words} within {limit:g} s", some, partial(_is_within, limit))
    lossy = [one for one in every if one.part == LOSS]
    with_udp = [one for one in lossy if NatKind.NOUDP.value not in one.pair]
    without = [one for one in lossy if NatKind.NOUDP.value in one.pair]
    for some, of in ((lossy, "of all pairs"), (with_udp, "of pairs with UDP"), (without, "of pairs without UDP")):
        want(f"30 % lost on both lines: within {LOSS_S:g} s 95 % {of}", some, partial(_is_within, LOSS_S), 0.95)
    return wanted


_LIMITS_BY_PART = {
    ALONE: (DIRECT_S, "direct pairs continue without the bootstrap node: an answer"),
    HOME: (DIRECT_S, "two hosts behind one router"),
    LEAKY: (LEAKY_S, "a router without a firewall, and one side late:"),
    FORGOTTEN: (BACK_S, "all mappings lost: reconnected"),
    RENUMBERED: (BACK_S, "new external address: reconnected"),
    MOVED: (BACK_S, "host moved to another network: reconnected in both directions"),
    IDLE: (DIRECT_S, "mappings expire after 20 s, no traffic for a minute: an answer"),
}


def _is_within(limit: float, outcome: Outcome) -> bool:
    return outcome.seconds <= limit


def _format_seconds(seconds: float) -> str:
    return "never" if seconds == math.inf else f"{seconds:.2f} s"
