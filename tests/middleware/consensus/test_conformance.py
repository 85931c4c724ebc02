"""Tests that every built-in strategy conforms, and that the conformance kit finds violations."""

from __future__ import annotations

import math
import runpy
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.assignment import Item
from middleware.consensus.conformance import CHECKS, Conformance, broken
from middleware.consensus.guarded_strategy import GuardedStrategy
from middleware.consensus.strategies.capability_cost import CapabilityCost
from middleware.consensus.strategies.cbba import Cbba
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import BUILT_IN, Consensus, Report, digest_of, load_strategy
from tests.replay import replayed

ROOT = Path(__file__).resolve().parents[3]


def _test_case(name: str) -> None:
    make = type(load_strategy(name))
    case = f"{make.__name__}Tests"
    globals()[case] = type(case, (Conformance, SynchronousTestCase), {"make": make, "__module__": __name__})


for _name in BUILT_IN:
    _test_case(_name)


class GuardedTests(Conformance, SynchronousTestCase):
    """A guard around a conforming strategy also conforms."""

    @staticmethod
    def make() -> GuardedStrategy:
        return GuardedStrategy(Nearest())


def point(order: Sequence[Report]) -> Consensus:
    """Return a consensus that ranks the agents in the order of these reports."""
    if not order:
        return Consensus(None)
    names = list(dict.fromkeys(r.agent for r in order))
    return Consensus(names[0], tuple(names[1:]), digest_of(order))


class Unnamed(Nearest):
    name = ""


class Remembers(Nearest):
    """Excludes the winner of the previous call."""

    def __init__(self) -> None:
        self.last: str | None = None

    def find(self, contacts: Sequence[Report]) -> Consensus:
        found = super().find([r for r in contacts if r.agent != self.last] or contacts)
        self.last = found.assigned_agent
        return found


class Sorts(Nearest):
    """Sorts its argument in place."""

    def find(self, contacts: Sequence[Report]) -> Consensus:
        contacts.sort(key=lambda r: r.agent, reverse=True)  # type: ignore[attr-defined]
        return super().find(contacts)


class FirstCome(Nearest):
    """Breaks ties by the order of the reports."""

    def find(self, contacts: Sequence[Report]) -> Consensus:
        found = super().find(contacts)
        first = [r for r in contacts if r.cost == min((c.cost for c in contacts), default=0.0)]
        return replace(found, assigned_agent=first[0].agent) if found.assigned_agent and first else found


class Trusting(Nearest):
    """Accepts every number, including NaN."""

    def find(self, contacts: Sequence[Report]) -> Consensus:
        return point(sorted(contacts, key=lambda r: (not math.isnan(float(r.cost)), r.cost, r.agent)))


class Concatenates(Nearest):
    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        return (*a, *b)


class Forgets(Nearest):
    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        return super().merge(a, b)[-1:]


class NamesNobody(Nearest):
    def find(self, contacts: Sequence[Report]) -> Consensus:
        return replace(super().find(contacts), assigned_agent="agent-999")


class Nervous(Nearest):
    def improves(self, current: Report, offer: Report, hysteresis: float) -> bool:
        return offer.agent != current.agent


class ByHash(Nearest):
    """Breaks ties by the iteration order of a set."""

    def find(self, contacts: Sequence[Report]) -> Consensus:
        found = super().find(contacts)
        least = {r.agent for r in contacts if found.assigned_agent and r.cost <= 5.0}
        return replace(found, assigned_agent=next(iter(least))) if least else found


class SmallIds(Nearest):
    """Stores the number of an agent in one signed byte."""

    def find(self, contacts: Sequence[Report]) -> Consensus:
        found = super().find(contacts)
        if found.assigned_agent is None:
            return found
        names = sorted({r.agent for r in contacts})
        number = (names.index(found.assigned_agent) + 128) % 256 - 128
        return replace(found, assigned_agent=names[number])


class Raises(Nearest):
    def find(self, contacts: Sequence[Report]) -> Consensus:
        raise ZeroDivisionError("I divide")


class Greedy(Cbba):
    """Ignores the capacity of the agents."""

    def find_group(self, contacts: Sequence[Report], items: Sequence[Item]) -> tuple[Consensus, ...]:
        return super().find_group([replace(r, capacity=99) for r in contacts], items)


class Lazy(Cbba):
    """Assigns all tasks except the last one."""

    def find_group(self, contacts: Sequence[Report], items: Sequence[Item]) -> tuple[Consensus, ...]:
        return super().find_group(contacts, items)[: len(items) - 1]


class Peeks(CapabilityCost):
    """Reads the battery level, although its declared fields do not include the battery level."""

    reads = ("load",)  # type: ignore[assignment]


BREACHES: dict[str, tuple[Callable[[], Any], ...]] = {
    "name": (Unnamed,),
    "purity": (Remembers, Sorts),
    "order": (FirstCome,),
    "merge": (Concatenates, Forgets),
    "ties": (FirstCome,),
    "winners": (NamesNobody,),
    "hostile": (Trusting,),
    "improves": (Nervous,),
    "hashing": (ByHash,),
    "many": (Raises, SmallIds),
    "group": (Greedy, Lazy),
    "reads": (Peeks,),
}
"""Strategies by the rule that each of them breaks."""


class ConformanceTests(SynchronousTestCase):
    def test_every_built_in_says_its_name(self) -> None:
        """The name of each built-in strategy is the name by which it is loaded."""
        self.assertEqual({name: load_strategy(name).name for name in BUILT_IN}, {name: name for name in BUILT_IN})

    def test_each_breach_is_seen(self) -> None:
        """A strategy that breaks a rule fails the check of that rule."""
        self.assertEqual(set(BREACHES), set(CHECKS))
        unseen = [
            (rule, strategy)
            for rule, strategies in BREACHES.items()
            for strategy in strategies
            if rule not in broken(strategy)
        ]
        self.assertEqual(unseen, [])

    def test_only_what_is_broken(self) -> None:
        """A strategy that breaks one rule fails only the check of this rule."""
        self.assertEqual(list(broken(Unnamed)), ["name"])
        self.assertEqual(list(broken(Nervous)), ["improves"])
        self.assertEqual(list(broken(Concatenates)), ["merge"])

    def test_examples_conform(self) -> None:
        """The template and the example of a custom strategy conform."""
        for name in ("spare:Spare", "template:Farthest"):
            module, _, attribute = name.partition(":")
            found = runpy.run_path(str(ROOT / "examples" / "strategy" / f"{module}.py"))
            self.assertEqual(broken(found[attribute]), {}, name)

    def test_same_in_every_process(self) -> None:
        """Every strategy gives the same result and digest, whatever the hash seed of the process."""
        replayed(
            self,
            "import random; from middleware.consensus.conformance import make_team\n"
            "from middleware.consensus.strategy import BUILT_IN, load_strategy\n"
            "for n in sorted(BUILT_IN): print(load_strategy(n).find(make_team(random.Random(3), 90)))\n",
        )
