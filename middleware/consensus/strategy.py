"""Strategy: who should act.  Pure, replaceable, loaded by name; it may be wrong, and then only the choice suffers.

A strategy sees the reports of the agents assigned to a task and names the one that should act (thesis, section 4.2.5
and Algorithm 4.5: ``consensus.find(contacts)``, ``consensus.assigned_agent``).  Who may act is not its business
(``lease``).
"""

from __future__ import annotations

import hashlib
import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from middleware.errors import UnknownStrategy

BUILT_IN = {"nearest": "middleware.consensus.nearest:Nearest"}
ENTRY_POINTS = "swarm_node.strategies"


@dataclass(frozen=True)
class Report:
    """One agent's report: ``agent`` is its uuid, ``cost`` what acting would cost it (for ``nearest``: metres)."""

    agent: str
    cost: float


@dataclass(frozen=True)
class Consensus:
    """The consensus point: who should act, those that stand by in order, and a digest of the reports used."""

    assigned_agent: str | None
    standby: tuple[str, ...] = ()
    digest: str = ""


class ConsensusAlgorithm(Protocol):
    """What a strategy is.  Each method is a pure function; equal reports in any order give an equal result."""

    name: str

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """The consensus point of the reports of all contacts, oneself included."""

    def improves(self, current: Report, offer: Report, hysteresis: float) -> bool:
        """Whether ``offer`` is so much better than ``current`` that the task should change hands."""


def digest_of(contacts: Sequence[Report]) -> str:
    """Eight hex digits that are equal for equal reports, whatever their order."""
    texts = sorted(f"{r.agent}={r.cost + 0.0:.6f};" for r in contacts)  # -0.0 is 0.0
    return hashlib.blake2s("".join(texts).encode(), digest_size=4).hexdigest()


def strategy_for(
    name: str, dotted: bool = False, deployed: Mapping[tuple[str, str], Callable[..., Any]] | None = None
) -> ConsensusAlgorithm:
    """The strategy called ``name``: a built-in one, or an entry point of ``swarm_node.strategies``.

    ``deployed:x`` is the module ``x`` that an operator pushed, among those in ``deployed``.

    With ``dotted`` also ``module:Class``, for names out of this machine's own settings: what a peer sends must never
    say what is imported here.  Raises ``UnknownStrategy``, which names those that there are.
    """
    if name.startswith("deployed:"):
        return _deployed(name, deployed or {})
    target = name if dotted and ":" in name else BUILT_IN.get(name)
    if target is None:
        from importlib.metadata import entry_points  # heavy, and most nodes never come here

        found = {point.name: point.value for point in entry_points(group=ENTRY_POINTS)}
        target = found.get(name)
        if target is None:
            raise UnknownStrategy(f"no strategy is called {name!r}; there are {', '.join(sorted(BUILT_IN | found))}")
    module, _, attribute = target.partition(":")
    try:
        strategy: ConsensusAlgorithm = getattr(importlib.import_module(module), attribute)()
    except Exception as error:  # a module of somebody else may fail in any way
        raise UnknownStrategy(f"strategy {name!r} cannot be loaded: {error}") from error
    return strategy


def _deployed(name: str, deployed: Mapping[tuple[str, str], Callable[..., Any]]) -> ConsensusAlgorithm:
    make = deployed.get(("strategy", name.removeprefix("deployed:")))
    if make is None:
        known = ", ".join(sorted(f"deployed:{each}" for kind, each in deployed if kind == "strategy")) or "none"
        raise UnknownStrategy(f"no strategy {name!r} here ([deployment] of this node); there are {known}")
    try:
        strategy: ConsensusAlgorithm = make()
    except Exception as error:  # a module of somebody else may fail in any way
        raise UnknownStrategy(f"strategy {name!r} cannot be made: {error}") from error
    return strategy
