"""Workload: what clients do in a team beside the faults, what must hold of it, and the figures that come of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from sim.team.figure import Figure
from sim.team.team import Team


class Workload(Protocol):
    """Made before the first node joins; births and deaths are told by ``Team.attend``."""

    def step(self) -> None:
        """Do something, every ``step`` seconds of the scenario while its faults last."""

    def settled(self) -> None:
        """The faults are over and the repair interval has passed: ask what is to be asked; 10 s are left for it."""

    def verdict(self) -> list[str]:
        """Every violation so far, a line each."""

    def figures(self) -> list[Figure]:
        """What was measured so far; asked now and then while it runs, and at the end.

        The names are there from the beginning, so that targets can be checked, with None as long as nothing was
        measured.
        """


@dataclass(frozen=True)
class Kind:
    """A sort of workload: ``settings`` is a frozen dataclass whose fields have rules (``middleware.config.types``).

    ``make(team, settings)`` makes one.
    """

    settings: type[Any]
    make: Callable[[Team, Any], Workload]


Kinds = Mapping[str, Kind]
