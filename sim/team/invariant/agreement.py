"""Invariants of execution, for tasks and decisions: E4, E5, E6 and E7."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator

from sim.team.event import ActiveTasks, Asked, Born, Decided, Event, FaultFree, OpenTask, OutcomeExpired, OutcomeStored

KINDS = Asked, Born, FaultFree, ActiveTasks, OutcomeStored, OutcomeExpired, OpenTask, Decided
"""The events that these invariants use."""
RECENT = 1.0
"""E7: within this many seconds after a decision, an agent must not use an older report of the same participant."""


def e4(events: Iterable[Event]) -> Iterator[str]:
    """No lost task: each submitted task ends, all agents learn of its end, and no agent starts the task again."""
    submitted: dict[Hashable, None] = {}
    over: set[Hashable] = set()
    states: dict[str, dict[int, str]] = {}
    for event in events:
        match event:
            case Asked(_, _, _, "submit", task):
                submitted[task] = None
            case OutcomeExpired(_, task):
                over.add(task)
            case ActiveTasks(_, _, acting):
                for task in acting:
                    if task in over:
                        yield f"{task} is over and is begun again"
            case OpenTask(_, task, place, state, is_docketed):
                if state:
                    states.setdefault(task, {})[place] = state
                if is_docketed:
                    yield f"dog{place} does not know that {task} is over"
    for task in submitted:
        if task not in over:
            yield f"{task} has no outcome: {states.get(str(task), {})}"


def e5(events: Iterable[Event]) -> Iterator[str]:
    """No ghost among agents: without faults no agent continues a task when it must have learned of the task's end."""
    within: float | None = None
    ended: dict[str, OutcomeStored] = {}
    for event in events:
        match event:
            case FaultFree():
                within = event.within
            case OutcomeStored():
                ended[event.task] = event
            case ActiveTasks(at, _, acting) if within is not None:
                for task in acting:
                    if task in ended and at > ended[task].at + within:
                        yield f"{task} is executed although it ended {ended[task].outcome}"


def e6(events: Iterable[Event]) -> Iterator[str]:
    """No flapping: a holder gives up the task only for a bid that is better by the hysteresis."""
    for event in events:
        if not isinstance(event, Decided) or event.assigned is None or event.holder in (None, event.assigned):
            continue
        costs = {report.agent: report.cost for report in event.reports}
        mine, held = costs.get(event.assigned), costs.get(event.holder or "")
        if mine is None or held is None or not mine < held * (1.0 - event.hysteresis):
            yield f"{held} gives way to {mine}"


def e7(events: Iterable[Event]) -> Iterator[str]:
    """Agreement: equal reports lead to equal decisions, and no agent uses an older report after a newer one."""
    agreed: dict[Hashable, str] = {}
    used: dict[tuple[int, str], tuple[float, dict[str, tuple[int, int]]]] = {}
    for event in events:
        if isinstance(event, Born):
            used = {key: known for key, known in used.items() if key[0] != event.place}
        elif isinstance(event, Decided):
            me, *others = event.reports
            before, known = used.get((event.place, event.group), (event.at, {}))
            used[event.place, event.group] = event.at, {one.agent: (one.epoch, one.serial) for one in others}
            for other in others:
                if event.at - before < RECENT and (other.epoch, other.serial) < known.get(other.agent, (0, 0)):
                    yield f"{me.name} uses a report of {other.name} that is older than a report that it has used"
            if event.assigned is not None and agreed.setdefault(event.basis, event.assigned) != event.assigned:
                yield f"from the same reports {me.name} selects a different agent from the others"
