"""Checker: what must hold of a history, whoever made it.

What stands in no history it cannot judge: workloads that compare what they see with the team as it is, such as lookups,
values, takeovers and tasks, do so themselves (``verdict``), under the same letters where the invariant is the same.

The invariants have letters and numbers, under which the documents promise them: E of execution, D of durability, T of
tuples, R of the wire.  Each is a function of the events; what was asked and never answered counts as "maybe".
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from sim.team.event import Event
from sim.team.invariant import agreement, durability, execution, taking, wire

Invariant = Callable[[Iterable[Event]], Iterator[str]]
Kinds = tuple[type[Event], ...]

PARTS: tuple[tuple[Kinds, tuple[tuple[str, Invariant], ...]], ...] = (
    (
        execution.KINDS,
        (
            ("E1", execution.e1),
            ("E2", execution.e2),
            ("E3", execution.e3),
            ("E5", execution.e5),
            ("E8", execution.e8),
            ("E9", execution.e9),
        ),
    ),
    (
        agreement.KINDS,
        (("E4", agreement.e4), ("E5", agreement.e5), ("E6", agreement.e6), ("E7", agreement.e7)),
    ),
    (
        durability.KINDS,
        (
            ("D1", durability.d1),
            ("D2", durability.d2),
            ("D3", durability.d3),
            ("D4", durability.d4),
            ("D5", durability.d5),
            ("D6", durability.d6),
            ("D7", durability.d7),
        ),
    ),
    (
        taking.KINDS,
        (
            ("T1", taking.t1),
            ("T2", taking.t2),
            ("T3", taking.t3),
            ("T4", taking.t4),
            ("T5", taking.t5),
            ("T6", taking.t6),
        ),
    ),
    (wire.KINDS, (("R1", wire.r1), ("R2", wire.r2), ("R3", wire.r3), ("R4", wire.r4))),
)
"""Of each part of a team the events that it goes by, and the invariants; E5 binds devices, and agents as well."""


def check(events: Iterable[Event]) -> list[str]:
    """Every violation, a line each, with its invariant before it; no line twice."""
    listed = list(events)
    found: dict[str, None] = {}
    for kinds, invariants in PARTS:
        wanted = frozenset(kinds)
        heard = [event for event in listed if type(event) in wanted]
        if heard:
            found |= dict.fromkeys(f"{name}: {text}" for name, invariant in invariants for text in invariant(heard))
    return list(found)
