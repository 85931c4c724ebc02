"""Check the invariants of a history of events.

The workloads for lookups, values, takeovers and tasks compare their observations with the true state of the team,
which a history does not contain. They check their invariants themselves (``Workload.find_violations``), and use the
same names for the same invariants.

An invariant is named as in the documentation, by a letter and a number: E for execution, D for durability, T for
tuples, R for the wire. Each invariant is a function of the events; a request without an answer may or may not have
been executed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from types import ModuleType

from sim.team.event import Event
from sim.team.invariant import agreement, durability, execution, tuple_space, wire

Invariant = Callable[[Iterable[Event]], Iterator[str]]
EventKinds = tuple[type[Event], ...]


def _find_invariants(part: ModuleType) -> tuple[tuple[str, Invariant], ...]:
    """Return the invariants of a module: its functions whose names are a letter and a digit."""
    return tuple((name.upper(), found) for name, found in vars(part).items() if re.fullmatch(r"[a-z]\d", name))


PARTS: tuple[tuple[EventKinds, tuple[tuple[str, Invariant], ...]], ...] = tuple(
    (part.KINDS, _find_invariants(part)) for part in (execution, agreement, durability, tuple_space, wire)
)
"""The event classes and the invariants of each part of a team; E5 is checked for devices and for agents."""


def find_violations(events: Iterable[Event]) -> list[str]:
    """Return every violation as a line that starts with its invariant, without duplicates."""
    listed = list(events)
    found: dict[str, None] = {}
    for kinds, invariants in PARTS:
        wanted = frozenset(kinds)
        heard = [event for event in listed if type(event) in wanted]
        if heard:
            found |= dict.fromkeys(f"{name}: {text}" for name, invariant in invariants for text in invariant(heard))
    return list(found)
