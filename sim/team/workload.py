"""Workload: what clients do in a team beside the faults, what must hold of it, and the figures that come of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from sim.team.figure import Figure
from sim.team.team import Team


class Workload:
    """Made before the first node joins; births and deaths are told by ``World.attend``.

    What clients ask for and what they get they write down in the history, which the checker judges.
    """

    def step(self) -> None:
        """Do something, now and then while the faults last."""

    def settled(self) -> None:
        """The faults are over and the repair interval has passed: ask what is to be asked; 10 s are left for it."""

    def verdict(self) -> list[str]:
        """Write down how things stand; returns the violations that only the workload itself can judge, a line each."""
        return []

    def figures(self) -> list[Figure]:
        """What was measured so far; asked now and then while it runs, and at the end.

        The names are there from the beginning, so that targets can be checked, with None as long as nothing was
        measured.
        """
        return []


@dataclass(frozen=True)
class Kind:
    """A sort of workload: ``settings`` is a frozen dataclass whose fields have rules (``middleware.config.types``).

    ``make(team, settings)`` makes one.
    """

    settings: type[Any]
    make: Callable[[Team, Any], Workload]


Kinds = Mapping[str, Kind]
