"""Invariants of execution, for leases and devices: E1, E2, E3, E5, E8 and E9."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from sim.team.event import (
    ActiveTasks,
    Answered,
    Asked,
    Assumptions,
    CommandExpected,
    CommandReceived,
    CommandSent,
    Died,
    Event,
    LeaseHeld,
    LeaseWon,
    MajorityReachable,
    RobotStopped,
    Unanswered,
)

KINDS = (
    Asked,
    Answered,
    Unanswered,
    Assumptions,
    Died,
    LeaseWon,
    LeaseHeld,
    CommandSent,
    CommandReceived,
    RobotStopped,
    MajorityReachable,
    CommandExpected,
    ActiveTasks,
)
"""The events that these invariants use."""
ROUGH = 0.06
"""E1: tolerance, as a share of the TTL, for durations measured by a device whose clock has an error of 5 %."""
BOUNDED = 0.01
"""Maximum clock drift for which E2 and E5 must hold; E1 must hold for any drift."""
EPSILON_S = 1e-6


def e1(events: Iterable[Event]) -> Iterator[str]:
    """Fenced effects: tokens of leases and accepted commands never decrease; no command is accepted after its lease.

    If members lose their stores, the tokens of leases may decrease, but not the tokens of accepted commands.
    """
    granted: dict[str, int] = {}
    taken: dict[str, int] = {}
    ttl, forgot = 0.0, False
    for event in events:
        match event:
            case Assumptions():
                ttl = event.ttl
            case Died(forgets=True):
                forgot = True
            case LeaseWon(_, task, place, token):
                highest = granted.get(task, 0)
                if token <= highest and not forgot:
                    yield f"token {token} of {task} is granted to {place} after {highest}"
                granted[task] = max(highest, token)
            case CommandReceived(at, task, _, token, True, _, truly):
                if token < taken.get(task, 0):
                    yield f"the device of {task} takes token {token} after {taken[task]}"
                if at > truly + ROUGH * ttl:
                    yield f"the device of {task} takes a command {at - truly:.2f} s after its lease ended"
                taken[task] = token


def e2(events: Iterable[Event]) -> Iterator[str]:
    """One lease: when an agent wins or renews a task's lease, no other agent holds it and no other robot moves.

    Whether another agent holds the lease is determined by that agent's clock; robots of other tasks may move. It is
    enough to check at these times, because if two leases overlap, the overlap begins when one of them is won or
    renewed.
    """
    still: dict[tuple[str, int], float] = {}
    is_bounded, stop_time = True, 0.0
    for event in events:
        match event:
            case Assumptions():
                is_bounded, stop_time = event.drift <= BOUNDED, event.stop_time
            case CommandReceived(_, task, place, _, True, until, _):
                still[task, place] = until + stop_time
            case RobotStopped(_, task, place, rest_at):
                still[task, place] = min(still.get((task, place), 0.0), rest_at)
            case LeaseHeld(at, task, place, others) if is_bounded:
                for other in others:
                    yield f"{place} and {other} hold {task} at {at:.2f}"
                for (moving, other), until in still.items():
                    if moving == task and other != place and until > at + EPSILON_S:
                        yield f"the robot of {other} moves for {task} at {at:.2f}, {place} holds it"


def e3(events: Iterable[Event]) -> Iterator[str]:
    """Takeover: if only an agent fails, a command with a higher token is accepted in time."""
    waited: list[CommandExpected] = []
    for event in events:
        if isinstance(event, CommandExpected):
            waited.append(event)
        elif isinstance(event, CommandReceived) and event.is_accepted and waited:
            heard = [one for one in waited if one.task == event.task and event.token > one.above]
            for one in heard:
                waited.remove(one)
                if event.at - one.since > one.within:
                    yield f"{one.why}, another agent acts {event.at - one.since:.2f} s later"
    for one in waited:
        yield f"{one.why}, no other agent acts"


def e5(events: Iterable[Event]) -> Iterator[str]:
    """No ghost at the device: when the end of a task is acknowledged, it is recorded, and its device obeys no agent.

    An agent that ends another agent's task waits by its own clock until that agent's lease has ended. With unbounded
    clock drift a device may therefore obey longer, by the difference of a fast and a slow clock over one TTL.
    """
    closing: dict[int, str] = {}
    over: dict[str, float] = {}
    tolerance = 0.0
    for event in events:
        match event:
            case Assumptions():
                tolerance = 2.0 * event.drift * event.ttl if event.drift > BOUNDED else 0.0
            case Asked(_, number, _, "close", str(task)):
                closing[number] = task
            case Answered(at, number) if number in closing:
                over.setdefault(closing.pop(number), at)
            case Unanswered(_, number, why) if number in closing:
                yield f"the end of {closing.pop(number)} is not recorded: {why}"
            case CommandReceived(at, task, place, _, True) if task in over and at > over[task] + tolerance:
                yield f"the device of {task} obeys {place} at {at:.2f}, the task ended at {over[task]:.2f}"
    for task in closing.values():
        yield f"the end of {task} is never acknowledged"


def e8(events: Iterable[Event]) -> Iterator[str]:
    """No zombie: no agent sends a command under an expired lease, or has two tasks or leases at the same time."""
    terms = Assumptions(0.0, 0.0, 0.0, 0.0, 0.0)
    for event in events:
        match event:
            case Assumptions():
                terms = event
            case CommandSent(at, task, place, ends, truly):
                is_late = terms.drift <= BOUNDED and at > max(ends, truly) + EPSILON_S
                if is_late or at > truly + ROUGH * terms.ttl:
                    yield f"{place} commands for {task} at {at:.2f}, its lease ended at {truly:.2f}"
            case ActiveTasks(_, place, acting, holding) if len(acting) > 1 or len(holding) > 1:
                yield f"dog{place} acts on {list(acting)} and holds the leases of {list(holding)}"


def e9(events: Iterable[Event]) -> Iterator[str]:
    """Minority: an agent that cannot reach a majority wins no lease, and stops by the end of its lease."""
    cut: dict[tuple[str, int], float] = {}
    terms = Assumptions(0.0, 0.0, 0.0, 0.0, 0.0)
    for event in events:
        match event:
            case Assumptions():
                terms = event
            case MajorityReachable(at, task, place, is_reached):
                if is_reached:
                    cut.pop((task, place), None)
                else:
                    cut.setdefault((task, place), at)
            case LeaseWon(at, task, place) if (task, place) in cut:
                since = cut[task, place]
                if at > since + terms.ttl / 3 + terms.max_delay + 0.1:
                    yield f"{place} wins {task} at {at:.2f}, cut from the majority since {since:.2f}"
            case CommandReceived(at, task, place, _, True) if (task, place) in cut:
                since = cut[task, place]
                if at > since + terms.ttl * 1.1 + terms.max_delay:
                    yield f"{place} acts on {task} at {at:.2f}, cut from the majority since {since:.2f}"
