"""Checker: what must hold of a history, whoever made it.

What stands in no history it cannot judge: workloads that compare what they see with the team as it is, such as lookups,
values, takeovers and tasks, do so themselves (``verdict``), under the same letters where the invariant is the same.

The invariants have letters and numbers, under which the documents promise them: E of execution, D of durability, T of
tuples, R of the wire.  Each is a function of the events; what was asked and never answered counts as "maybe".
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from types import ModuleType

from sim.team.event import Event
from sim.team.invariant import agreement, durability, execution, taking, wire

Invariant = Callable[[Iterable[Event]], Iterator[str]]
Kinds = tuple[type[Event], ...]


def _named(part: ModuleType) -> tuple[tuple[str, Invariant], ...]:
    """The invariants of a module, which are its functions of one letter and a number."""
    return tuple((name.upper(), found) for name, found in vars(part).items() if re.fullmatch(r"[a-z]\d", name))


PARTS: tuple[tuple[Kinds, tuple[tuple[str, Invariant], ...]], ...] = tuple(
    (part.KINDS, _named(part)) for part in (execution, agreement, durability, taking, wire)
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
