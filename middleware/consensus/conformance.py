"""Conformance: what every strategy must hold to, as tests that anyone can run on one's own.

::

    class MineTests(Conformance, SynchronousTestCase):
        make = Mine

or, without a test case, ``broken(Mine)``, which gives a line for each rule that is broken.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from middleware.consensus.item import Item
from middleware.consensus.strategy import READABLE, Consensus, ConsensusAlgorithm, Report, reads_of, refusal

Make = Callable[[], ConsensusAlgorithm]
TEAMS = 40
"""Random teams for each rule; the same in every run."""
HOSTILE = (
    {"cost": math.nan},
    {"cost": math.inf},
    {"cost": -math.inf},
    {"cost": -1.0},
    {"cost": 1e300},
    {"cost": 10**400},
    {"cost": True},
    {"cost": "1"},
    {"cost": None},
    {"weight": math.inf},
    {"weight": -1.0},
    {"value": (math.nan, 0.0)},
    {"value": (1e300, 0.0)},
    {"value": [0.0]},
    {"epoch": -1},
    {"epoch": 10**400},
    {"capacity": 0.5},
    {"battery": 2.0},
    {"load": math.nan},
    {"age": 9.0, "valid_for": 5.0},
    {"unmet": ("has no camera",)},
    {"agent": ""},
    {"agent": "x" * 10_000},
    {"choice": "x" * 10_000},
)
"""What makes a report unlawful; each would win, if it counted."""
_BARE = Report("", 0.0)


class Breach(AssertionError):
    """A strategy breaks a rule; the text says which, and on which reports."""


class Salted(str):
    """A name that lies elsewhere in a set, as all names do where the process hashes otherwise."""

    salt = 0

    def __hash__(self) -> int:
        return hash((Salted.salt, str(self)))


def team(dice: random.Random, most: int = 9) -> list[Report]:
    """Reports of a random team, with ties, and with everything in them that some strategy may want."""
    costs = [0.0, 1.0, 1.0, 2.5, dice.uniform(0.0, 50.0), dice.uniform(0.0, 1e6)]
    return [
        Report(
            f"agent-{number:03d}",
            dice.choice(costs),
            value=(dice.uniform(-9.0, 9.0), dice.uniform(-9.0, 9.0)),
            choice=dice.choice(["left", "left", "right"]),
            weight=dice.choice([1.0, 1.0, 2.0]),
            battery=dice.choice([1.0, 0.25]),
            load=float(dice.randrange(3)),
        )
        for number in dice.sample(range(500), dice.randint(1, most))
    ]


def check_name(make: Make) -> None:
    """It says its name and version."""
    strategy = make()
    for label in ("name", "version"):
        text = getattr(strategy, label, None)
        _demand(isinstance(text, str) and (label == "version" or bool(text)), f"{label} is {text!r}")


def check_purity(make: Make) -> None:
    """The answer depends on the reports alone: not on what was asked before, nor by whom, and they stay as they are."""
    old = make()
    for dice, contacts in _teams():
        kept = list(contacts)
        first = old.find(contacts)
        _demand(contacts == kept, "find changes the reports that it is given", contacts)
        old.find(team(dice))
        _demand(old.find(contacts) == first, "asked again it finds something else", contacts)
        _demand(make().find(contacts) == first, "another one of it finds something else", contacts)


def check_order(make: Make) -> None:
    """Neither the order of the reports nor their repetition makes a difference."""
    strategy = make()
    for dice, contacts in _teams():
        mixed = [*contacts, *contacts[: len(contacts) // 2]]
        dice.shuffle(mixed)
        _demand(strategy.find(mixed) == strategy.find(contacts), "the order or repetition of reports shows", contacts)


def check_merge(make: Make) -> None:
    """``merge`` is a join, and what is found from a summary is what is found from all reports."""
    strategy = make()
    for dice, contacts in _teams():
        dearer = [replace(r, cost=r.cost + 1.0) for r in contacts[:2]]
        a, b, c = (dice.sample(contacts, dice.randint(0, len(contacts))) for _ in range(3))
        b = [*b, *dearer]
        ab, bc = strategy.merge(a, b), strategy.merge(b, c)
        _demand(ab == strategy.merge(b, a), "merge is not commutative", contacts)
        _demand(strategy.merge(ab, c) == strategy.merge(a, bc), "merge is not associative", contacts)
        _demand(strategy.merge(ab, ab) == ab == strategy.merge(ab, ()), "merge is not idempotent", contacts)
        _demand(strategy.find(ab) == strategy.find([*a, *b]), "a summary is not enough to find the same", contacts)
        _demand({*ab} <= {*a, *b}, "merge invents reports", contacts)


def check_ties(make: Make) -> None:
    """Among equals there is always one, and the same for everybody."""
    strategy = make()
    for dice, contacts in _teams():
        equals = [replace(contacts[0], agent=r.agent) for r in contacts]
        found = strategy.find(equals)
        _demand(found.assigned_agent is not None, "nobody is assigned among equals", equals)
        dice.shuffle(equals)
        _demand(strategy.find(equals) == found, "equals are told apart by the order of their reports", equals)


def check_winners(make: Make) -> None:
    """Whoever is named has reported, and nobody is named twice; who is alone is assigned, of nobody none."""
    strategy = make()
    _demand(strategy.find([]).assigned_agent is None, "somebody is assigned though nobody reported")
    for _, contacts in _teams():
        found = strategy.find(contacts)
        names = [name for name in (found.assigned_agent, *found.standby) if name is not None]
        _demand(isinstance(found, Consensus), "find answers no Consensus", contacts)
        _demand({*names, *found.assigned} <= {r.agent for r in contacts}, "it names who did not report", contacts)
        _demand(len(set(names)) == len(names), "somebody is named twice", contacts)
        alone = contacts[0]
        _demand(strategy.find([alone]).assigned_agent == alone.agent, "who is alone is not assigned", [alone])


def check_hostile(make: Make) -> None:
    """Reports of nothing, less than nothing, or of yesterday neither win nor make a difference, nor an exception."""
    strategy = make()
    for dice, contacts in _teams():
        found = strategy.find(contacts)
        for change in HOSTILE:
            changes: dict[str, Any] = {"agent": "aaa", "cost": 0.0, **change}
            with_it = [*contacts, replace(contacts[0], **changes)]
            dice.shuffle(with_it)
            _demand(strategy.find(with_it) == found, f"a report with {str(change):.60} makes a difference", with_it)
            _demand(strategy.find([with_it[0]] if refusal(with_it[0]) else []).assigned_agent is None, "it wins")
            strategy.merge(with_it, with_it)


def check_improves(make: Make) -> None:
    """Only what is better by more than the hysteresis takes over, so that the task never goes to and fro."""
    strategy = make()
    for dice, contacts in _teams():
        a, b = contacts[0], replace(team(dice)[0], agent="other")
        for share in (0.0, 0.1, 0.5):
            both = [strategy.improves(a, b, share), strategy.improves(b, a, share)]
            _demand(all(isinstance(yes, bool) for yes in both), "improves answers neither yes nor no")
            _demand(both != [True, True], "each of two is better than the other", [a, b])
        _demand(not strategy.improves(a, replace(a, agent="other"), 0.0), "an equal one is better", [a])
        wins = [strategy.improves(a, b, share) for share in (0.0, 0.1, 0.3, 0.9)]
        _demand(wins == sorted(wins, reverse=True), "more hysteresis makes a change easier", [a, b])
        for change in HOSTILE:
            changes: dict[str, Any] = {"agent": "other", "cost": 0.0, **change}
            _demand(not strategy.improves(a, replace(a, **changes), 0.1), f"{str(change):.60} takes over", [a])


def check_hashing(make: Make) -> None:
    """It makes no difference how the process hashes names (PYTHONHASHSEED)."""
    for _, contacts in _teams():
        found = []
        for Salted.salt in (0, 1, 2):
            salted = [replace(r, agent=Salted(r.agent), choice=Salted(r.choice), task=Salted(r.task)) for r in contacts]
            found.append(make().find(salted))
        _demand(found[0] == found[1] == found[2], "the order of a set or dict of names shows", contacts)


def check_many(make: Make) -> None:
    """With 300 agents everything is as with three."""
    dice = random.Random("many")
    one = team(dice)[0]
    contacts = [replace(one, agent=f"agent-{number:03d}", cost=1000.0 * (1 + number)) for number in range(300)]
    strategy = make()
    found = strategy.find(contacts)
    _demand(found.assigned_agent in {r.agent for r in contacts}, "nobody is found among 300")
    dice.shuffle(contacts)
    _demand(strategy.find(contacts) == found, "among 300 the order shows")
    other = {r.agent: f"agent-{299 - number:03d}" for number, r in enumerate(sorted(contacts, key=_agent_of))}
    renamed = strategy.find([replace(r, agent=other[r.agent]) for r in contacts])
    _demand(renamed.assigned_agent == other[str(found.assigned_agent)], "who wins depends on how it is numbered")


def check_group(make: Make) -> None:
    """Several tasks at once: one answer each, nobody beyond its capacity, whatever the order."""
    strategy: Any = make()
    if not hasattr(strategy, "find_group"):
        return
    for dice, contacts in _teams():
        items = [Item(f"task-{number}", (dice.uniform(-9.0, 9.0), dice.uniform(-9.0, 9.0))) for number in range(5)]
        room = {r.agent: dice.randint(1, 2) for r in contacts}
        bids = [
            replace(r, task=item.task, cost=dice.choice([1.0, r.cost]), capacity=room[r.agent])
            for r in contacts
            for item in items
        ]
        found = strategy.find_group(bids, items)
        _demand([f.task for f in found] == [item.task for item in items], "not every task has one answer", bids)
        held = [f.assigned_agent for f in found if f.assigned_agent is not None]
        _demand(all(held.count(agent) <= room[agent] for agent in held), "somebody has more than it can take", bids)
        _demand(len(held) == min(len(items), sum(room.values())), "a task is left though somebody has room", bids)
        mixed, turned = [*bids, *bids[:3]], items[::-1]
        dice.shuffle(mixed)
        _demand(strategy.find_group(mixed, turned) == found, "the order of bids or tasks shows", bids)
        hostile: list[Any] = [replace(bids[0], **change) for change in HOSTILE if "agent" not in change]
        _demand(strategy.find_group([*bids, *hostile], items) == found, "an unlawful bid makes a difference", bids)


def check_reads(make: Make) -> None:
    """What it does not name in ``reads`` is not shown to it in a running team, and must make no difference."""
    strategy = make()
    hidden: dict[str, Any] = {name: getattr(_BARE, name) for name in READABLE if name not in reads_of(strategy)}
    for _, contacts in _teams():
        whole = strategy.find(contacts)
        shown = strategy.find([replace(report, **hidden) for report in contacts])
        same = [(f.assigned_agent, f.standby, f.value, f.choice) for f in (whole, shown)]
        _demand(same[0] == same[1], f"it goes by more than {', '.join(reads_of(strategy)) or 'the cost'}", contacts)


CHECKS: dict[str, Callable[[Make], None]] = {
    "name": check_name,
    "purity": check_purity,
    "order": check_order,
    "merge": check_merge,
    "ties": check_ties,
    "winners": check_winners,
    "hostile": check_hostile,
    "improves": check_improves,
    "hashing": check_hashing,
    "many": check_many,
    "group": check_group,
    "reads": check_reads,
}


def broken(make: Make) -> dict[str, str]:
    """Which rules a strategy breaks, and how; one that raises breaks the rule."""
    found = {}
    for name, check in CHECKS.items():
        try:
            check(make)
        except Exception as error:  # the strategy is foreign code
            found[name] = str(error) if isinstance(error, Breach) else f"{type(error).__name__}: {error}"
    return found


class Conformance:
    """Tests to be mixed into a test case that says ``make = ...``, the class of a strategy; one for each check."""

    make: Any


def _test_of(check: Callable[[Make], None]) -> Callable[[Conformance], None]:
    def test(self: Conformance) -> None:
        check(type(self).make)

    test.__doc__ = check.__doc__
    return test


for _name, _check in CHECKS.items():
    setattr(Conformance, f"test_{_name}", _test_of(_check))


def _agent_of(report: Report) -> str:
    return report.agent


def _teams() -> Iterator[tuple[random.Random, list[Report]]]:
    for number in range(TEAMS):
        dice = random.Random(f"conformance/{number}")
        yield dice, team(dice)


def _demand(is_so: bool, otherwise: str, contacts: Sequence[Report] = ()) -> None:
    if not is_so:
        told = "; ".join(f"{r.agent!s:.40}: {r.cost!r:.20}" for r in contacts[:6])
        raise Breach(f"{otherwise}{', e.g. ' + told if told else ''}")
