"""Conformance tests that every strategy must pass; third-party strategies can use them too.

::

    class MineTests(Conformance, SynchronousTestCase):
        make = Mine

Outside of a test case, ``broken(Mine)`` returns one line for each rule that the strategy breaks.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

from middleware.consensus.assignment import Item
from middleware.consensus.strategy import READABLE, Consensus, ConsensusAlgorithm, Report, find_read_fields, refusal

Factory = Callable[[], ConsensusAlgorithm]
TEAM_COUNT = 40
"""Number of random teams for each rule; every run uses the same teams."""
INVALID_CHANGES = (
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
"""Changes that make a report invalid; each such report would win if it were valid."""
_DEFAULT_REPORT = Report("", 0.0)


class Breach(AssertionError):
    """A strategy breaks a rule; the text contains the rule and the reports."""


class Salted(str):
    """A string with a different hash value, as in a process with a different ``PYTHONHASHSEED``."""

    salt = 0

    def __hash__(self) -> int:
        return hash((Salted.salt, str(self)))


def make_team(rng: random.Random, most: int = 9) -> list[Report]:
    """Create the reports of a random team, with ties and with every field that a strategy may read."""
    costs = [0.0, 1.0, 1.0, 2.5, rng.uniform(0.0, 50.0), rng.uniform(0.0, 1e6)]
    return [
        Report(
            f"agent-{number:03d}",
            rng.choice(costs),
            value=(rng.uniform(-9.0, 9.0), rng.uniform(-9.0, 9.0)),
            choice=rng.choice(["left", "left", "right"]),
            weight=rng.choice([1.0, 1.0, 2.0]),
            battery=rng.choice([1.0, 0.25]),
            load=float(rng.randrange(3)),
        )
        for number in rng.sample(range(500), rng.randint(1, most))
    ]


def check_name(make: Factory) -> None:
    """The strategy has a name and a version."""
    strategy = make()
    for label in ("name", "version"):
        text = getattr(strategy, label, None)
        _require(isinstance(text, str) and (label == "version" or bool(text)), f"{label} is {text!r}")


def check_purity(make: Factory) -> None:
    """The decision depends only on the reports, not on earlier calls, and ``find`` does not change the reports."""
    old = make()
    for rng, contacts in _make_teams():
        before = list(contacts)
        first = old.find(contacts)
        _require(contacts == before, "find modifies its arguments", contacts)
        old.find(make_team(rng))
        _require(old.find(contacts) == first, "a second call of find gives a different result", contacts)
        _require(make().find(contacts) == first, "a second instance gives a different result", contacts)


def check_order(make: Factory) -> None:
    """Neither the order of the reports nor their repetition affects the decision."""
    strategy = make()
    for rng, contacts in _make_teams():
        mixed = [*contacts, *contacts[: len(contacts) // 2]]
        rng.shuffle(mixed)
        _require(
            strategy.find(mixed) == strategy.find(contacts),
            "the order or repetition of the reports affects the result",
            contacts,
        )


def check_merge(make: Factory) -> None:
    """``merge`` is a join, and a summary leads to the same decision as all reports."""
    strategy = make()
    for rng, contacts in _make_teams():
        costlier = [replace(r, cost=r.cost + 1.0) for r in contacts[:2]]
        a, b, c = (rng.sample(contacts, rng.randint(0, len(contacts))) for _ in range(3))
        b = [*b, *costlier]
        ab, bc = strategy.merge(a, b), strategy.merge(b, c)
        _require(ab == strategy.merge(b, a), "merge is not commutative", contacts)
        _require(strategy.merge(ab, c) == strategy.merge(a, bc), "merge is not associative", contacts)
        _require(strategy.merge(ab, ab) == ab == strategy.merge(ab, ()), "merge is not idempotent", contacts)
        _require(
            strategy.find(ab) == strategy.find([*a, *b]),
            "find of a merged summary and find of all reports give different results",
            contacts,
        )
        _require({*ab} <= {*a, *b}, "merge returns reports that are not among its arguments", contacts)


def check_ties(make: Factory) -> None:
    """Among equal reports exactly one agent wins, the same at every node."""
    strategy = make()
    for rng, contacts in _make_teams():
        equals = [replace(contacts[0], agent=r.agent) for r in contacts]
        found = strategy.find(equals)
        _require(found.assigned_agent is not None, "no agent is assigned among equal reports", equals)
        rng.shuffle(equals)
        _require(strategy.find(equals) == found, "the order of equal reports affects the result", equals)


def check_winners(make: Factory) -> None:
    """Only agents that reported are in the decision, each once; a single reporting agent is assigned."""
    strategy = make()
    _require(strategy.find([]).assigned_agent is None, "an agent is assigned without any report")
    for _, contacts in _make_teams():
        found = strategy.find(contacts)
        names = [name for name in (found.assigned_agent, *found.standby) if name is not None]
        _require(isinstance(found, Consensus), "find does not return a Consensus", contacts)
        _require(
            {*names, *found.assigned} <= {r.agent for r in contacts},
            "find returns an agent that did not report",
            contacts,
        )
        _require(len(set(names)) == len(names), "find returns an agent twice", contacts)
        alone = contacts[0]
        _require(strategy.find([alone]).assigned_agent == alone.agent, "the only agent is not assigned", [alone])


def check_hostile(make: Factory) -> None:
    """Invalid, infinite, negative and stale reports neither win nor affect the decision nor raise an exception."""
    strategy = make()
    for rng, contacts in _make_teams():
        found = strategy.find(contacts)
        for change in INVALID_CHANGES:
            changes: dict[str, Any] = {"agent": "aaa", "cost": 0.0, **change}
            with_it = [*contacts, replace(contacts[0], **changes)]
            rng.shuffle(with_it)
            _require(
                strategy.find(with_it) == found, f"an invalid report with {str(change):.60} affects the result", with_it
            )
            _require(
                strategy.find([with_it[0]] if refusal(with_it[0]) else []).assigned_agent is None,
                "an invalid report wins",
            )
            strategy.merge(with_it, with_it)


def check_improves(make: Factory) -> None:
    """An agent takes over only if its offer is better by more than the hysteresis, so the task does not oscillate."""
    strategy = make()
    for rng, contacts in _make_teams():
        a, b = contacts[0], replace(make_team(rng)[0], agent="other")
        for share in (0.0, 0.1, 0.5):
            both = [strategy.improves(a, b, share), strategy.improves(b, a, share)]
            _require(all(isinstance(yes, bool) for yes in both), "improves does not return a bool")
            _require(both != [True, True], "improves is true in both directions", [a, b])
        _require(not strategy.improves(a, replace(a, agent="other"), 0.0), "improves is true for an equal report", [a])
        wins = [strategy.improves(a, b, share) for share in (0.0, 0.1, 0.3, 0.9)]
        _require(wins == sorted(wins, reverse=True), "improves becomes true with more hysteresis", [a, b])
        for change in INVALID_CHANGES:
            changes: dict[str, Any] = {"agent": "other", "cost": 0.0, **change}
            _require(
                not strategy.improves(a, replace(a, **changes), 0.1),
                f"an invalid report with {str(change):.60} takes over",
                [a],
            )


def check_hashing(make: Factory) -> None:
    """The hash seed of the process (``PYTHONHASHSEED``) does not affect the decision."""
    for _, contacts in _make_teams():
        found = []
        for Salted.salt in (0, 1, 2):
            salted = [replace(r, agent=Salted(r.agent), choice=Salted(r.choice), task=Salted(r.task)) for r in contacts]
            found.append(make().find(salted))
        _require(found[0] == found[1] == found[2], "the hash values of names affect the result", contacts)


def check_many(make: Factory) -> None:
    """The rules also hold with 300 agents."""
    rng = random.Random("many")
    one = make_team(rng)[0]
    contacts = [replace(one, agent=f"agent-{number:03d}", cost=1000.0 * (1 + number)) for number in range(300)]
    strategy = make()
    found = strategy.find(contacts)
    _require(found.assigned_agent in {r.agent for r in contacts}, "no agent is assigned among 300")
    rng.shuffle(contacts)
    _require(strategy.find(contacts) == found, "among 300 agents the order of the reports affects the result")
    other = {r.agent: f"agent-{299 - number:03d}" for number, r in enumerate(sorted(contacts, key=_get_agent))}
    renamed = strategy.find([replace(r, agent=other[r.agent]) for r in contacts])
    _require(
        renamed.assigned_agent == other[str(found.assigned_agent)], "the winner depends on the numbers of the agents"
    )


def check_group(make: Factory) -> None:
    """``find_group`` returns one decision per task, exceeds no capacity, and does not depend on the order."""
    strategy: Any = make()
    if not hasattr(strategy, "find_group"):
        return
    for rng, contacts in _make_teams():
        items = [Item(f"task-{number}", (rng.uniform(-9.0, 9.0), rng.uniform(-9.0, 9.0))) for number in range(5)]
        capacity_of = {r.agent: rng.randint(1, 2) for r in contacts}
        bids = [
            replace(r, task=item.task, cost=rng.choice([1.0, r.cost]), capacity=capacity_of[r.agent])
            for r in contacts
            for item in items
        ]
        found = strategy.find_group(bids, items)
        _require(
            [f.task for f in found] == [item.task for item in items],
            "find_group does not return one decision for each task",
            bids,
        )
        assigned = [f.assigned_agent for f in found if f.assigned_agent is not None]
        _require(
            all(assigned.count(agent) <= capacity_of[agent] for agent in assigned),
            "an agent has more tasks than its capacity",
            bids,
        )
        _require(
            len(assigned) == min(len(items), sum(capacity_of.values())),
            "a task has no agent, although an agent has capacity left",
            bids,
        )
        mixed, turned = [*bids, *bids[:3]], items[::-1]
        rng.shuffle(mixed)
        _require(strategy.find_group(mixed, turned) == found, "the order of the bids or tasks affects the result", bids)
        hostile: list[Any] = [replace(bids[0], **change) for change in INVALID_CHANGES if "agent" not in change]
        _require(strategy.find_group([*bids, *hostile], items) == found, "an invalid bid affects the result", bids)


def check_reads(make: Factory) -> None:
    """Fields that are not in ``reads`` do not affect the decision, because they are hidden in a running team."""
    strategy = make()
    hidden: dict[str, Any] = {
        name: getattr(_DEFAULT_REPORT, name) for name in READABLE if name not in find_read_fields(strategy)
    }
    for _, contacts in _make_teams():
        with_all_fields = strategy.find(contacts)
        with_visible_fields = strategy.find([replace(report, **hidden) for report in contacts])
        same = [(f.assigned_agent, f.standby, f.value, f.choice) for f in (with_all_fields, with_visible_fields)]
        _require(
            same[0] == same[1],
            f"find reads other fields than {', '.join(find_read_fields(strategy)) or 'the cost'}",
            contacts,
        )


CHECKS: dict[str, Callable[[Factory], None]] = {
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


def broken(make: Factory) -> dict[str, str]:
    """Return the rules that a strategy breaks, each with the reason; a rule is also broken if its test raises."""
    found = {}
    for name, check in CHECKS.items():
        try:
            check(make)
        except Exception as error:  # third-party code may raise anything
            found[name] = str(error) if isinstance(error, Breach) else f"{type(error).__name__}: {error}"
    return found


class Conformance:
    """Mixin for a test case, which sets ``make`` to the class of a strategy; it adds one test for each check."""

    make: Any


def _make_test(check: Callable[[Factory], None]) -> Callable[[Conformance], None]:
    def test(self: Conformance) -> None:
        check(type(self).make)

    test.__doc__ = check.__doc__
    return test


for _name, _check in CHECKS.items():
    setattr(Conformance, f"test_{_name}", _make_test(_check))


def _get_agent(report: Report) -> str:
    return report.agent


def _make_teams() -> Iterator[tuple[random.Random, list[Report]]]:
    for number in range(TEAM_COUNT):
        rng = random.Random(f"conformance/{number}")
        yield rng, make_team(rng)


def _require(is_so: bool, otherwise: str, contacts: Sequence[Report] = ()) -> None:
    if not is_so:
        examples = "; ".join(f"{r.agent!s:.40}: {r.cost!r:.20}" for r in contacts[:6])
        raise Breach(f"{otherwise}{', e.g. ' + examples if examples else ''}")
