"""Guard: what stands between a strategy that somebody wrote and the agents that ask it.

A strategy that raises, does not answer in time, or answers what cannot be has no opinion; then the nearest acts, and
the answer says so.  None of this is needed for safety, which rests on leases; it keeps the team at work.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace

from twisted.logger import Logger

from middleware.consensus.item import Item, capacities, listed
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import (
    MAX_NAME,
    MAX_NUMBER,
    Consensus,
    ConsensusAlgorithm,
    Report,
    reads_of,
    refusal,
    standing,
)
from middleware.errors import SwarmError

REMEMBERED = 64
STRIKES = 3
"""A strategy that is lost so often within ``SPAN`` questions is asked no more, since each costs up to the deadline."""
SPAN = 10_000
"""Questions after which a loss is forgotten: about four minutes of a task.  A busy machine is late now and then."""


class NoOpinion(SwarmError):
    """What a strategy answered cannot be used; the text says why."""


class Lost(NoOpinion):
    """A strategy gave no answer, and what it ran in had to be ended: it was late, said too much, or died."""


class Guard:
    """A strategy that cannot fail, around one that can; the nearest acts where it has no opinion.

    ``twice`` asks everything a second time in another order, for strategies that nobody here has tested.
    """

    log = Logger()

    def __init__(self, strategy: ConsensusAlgorithm, twice: bool = False) -> None:
        self.strategy = strategy
        self.name = str(getattr(strategy, "name", type(strategy).__name__))[:MAX_NAME]
        self.version = str(getattr(strategy, "version", ""))[:MAX_NAME]
        self.reads = reads_of(strategy)
        self.why_not = ""
        self._fallback = Nearest()
        self._twice = twice
        self._asked = 0
        self._losses: list[int] = []
        self._answers: OrderedDict[tuple[Report, ...], Consensus] = OrderedDict()

    def find(self, contacts: Sequence[Report]) -> Consensus:
        """The consensus point of the lawful reports; the reason says where it is the fallback's."""
        lawful = _lawful(contacts)
        try:
            self._may_be_asked()
            found = checked(self.strategy.find(lawful), lawful)
            known = self._answers.setdefault(lawful, found)
            if known != found or (self._twice and checked(self.strategy.find(lawful[::-1]), lawful) != found):
                raise NoOpinion("it gives two answers to equal reports")
            while len(self._answers) > REMEMBERED:
                self._answers.popitem(last=False)
        except Exception as error:  # the strategy is foreign code
            why = self._failed(error)
            instead = self._fallback.find(lawful)
            said = f"{self.name} has no opinion ({why}); {self._fallback.name}: {instead.reason}"
            return replace(instead, strategy=self._fallback.name, reason=said)
        return replace(found, strategy=self.name)

    def find_group(self, contacts: Sequence[Report], items: Sequence[Item]) -> tuple[Consensus, ...]:
        """One consensus point for each item; of a strategy for one task, or of the fallback, one after the other."""
        lawful = _lawful(contacts)
        whole = getattr(self.strategy, "find_group", None)
        if whole is None:
            return one_by_one(self.find, lawful, items)
        try:
            self._may_be_asked()
            found = checked_group(whole(lawful, items), lawful, items)
        except NotImplementedError:
            return one_by_one(self.find, lawful, items)
        except Exception as error:  # the strategy is foreign code
            said = f"{self.name} has no opinion ({self._failed(error)}); {self._fallback.name}: "
            found = one_by_one(self._fallback.find, lawful, items)
            return tuple(replace(p, strategy=self._fallback.name, reason=said + p.reason) for p in found)
        return tuple(replace(point, strategy=self.name) for point in found)

    def improves(self, current: Report, offer: Report, hysteresis: float) -> bool:
        """Whether ``offer`` should take over; the fallback says so where the strategy has no opinion."""
        if refusal(offer):
            return False
        try:
            self._may_be_asked()
            answer = self.strategy.improves(current, offer, hysteresis)
            if not isinstance(answer, bool):
                raise NoOpinion(f"improves answers {type(answer).__name__}, not yes or no")
        except Exception as error:  # the strategy is foreign code
            self._failed(error)
            return self._fallback.improves(current, offer, hysteresis)
        return answer

    def merge(self, a: Sequence[Report], b: Sequence[Report]) -> tuple[Report, ...]:
        """A summary of both, of lawful reports that are in one of them; the fallback's where it is not."""
        lawful = _lawful((*a, *b))
        try:
            self._may_be_asked()
            merged = self.strategy.merge(lawful, ())
            if not isinstance(merged, tuple) or len(merged) > len(lawful) or not set(merged) <= set(lawful):
                raise NoOpinion("merge invents reports")
        except Exception as error:  # the strategy is foreign code
            self._failed(error)
            return self._fallback.merge(lawful, ())
        return merged

    def stop(self) -> None:
        """Let go of what the strategy runs in, if anything; one that ran in something has no opinion from then on."""
        stop = getattr(self.strategy, "stop", None)
        if stop is not None:
            stop()

    def _may_be_asked(self) -> None:
        if len(self._losses) >= STRIKES:
            raise NoOpinion(f"it gave no answer {STRIKES} times and is asked no more")
        self._asked += 1

    def _failed(self, error: Exception) -> str:
        """Count and log it; gives it in one line.  The same again is not logged again."""
        if isinstance(error, Lost):
            self._losses = [*(each for each in self._losses if self._asked - each < SPAN), self._asked]
        text = str(error) if isinstance(error, NoOpinion) else f"{type(error).__name__}: {error}"
        why = (text.strip().splitlines() or ["it says nothing"])[-1][:MAX_NAME]  # of a trace, what was raised
        if why != self.why_not:
            self.why_not = why
            self.log.failure("strategy {name} has no opinion: {why}", name=self.name, why=why)
        return why


def checked(found: Consensus, contacts: Sequence[Report]) -> Consensus:
    """``found`` if it can be the consensus point of ``contacts``; raises ``NoOpinion`` where it cannot."""
    if not isinstance(found, Consensus):
        raise NoOpinion(f"find answers {type(found).__name__}, not Consensus")
    agents = {report.agent for report in contacts}
    named = () if found.assigned_agent is None else (found.assigned_agent,)
    for group in (found.standby, found.assigned, found.value):
        if not isinstance(group, tuple) or len(group) > max(8, len(agents)):
            raise NoOpinion("it names more than there are")
    for agent in (*named, *found.standby, *found.assigned):
        if agent not in agents:
            raise NoOpinion(f"it names {agent!r:.60}, who did not report")
    if len({*named, *found.standby}) < len(named) + len(found.standby):
        raise NoOpinion("it names somebody twice")
    for text in (found.digest, found.task, found.choice, found.strategy, found.reason):
        if not isinstance(text, str) or len(text) > 2 * MAX_NAME:
            raise NoOpinion("its texts are too long")
    if not all(type(n) in (int, float) and -MAX_NUMBER <= n <= MAX_NUMBER for n in found.value):
        raise NoOpinion("its value is no place")
    return found


def checked_group(
    found: Sequence[Consensus], contacts: Sequence[Report], items: Sequence[Item]
) -> tuple[Consensus, ...]:
    """``found`` if it has one possible point for each item and gives nobody too much; raises ``NoOpinion`` else."""
    if not isinstance(found, tuple) or not all(isinstance(point, Consensus) for point in found):
        raise NoOpinion("find_group answers no tuple of Consensus")
    if [point.task for point in found] != [item.task for item in listed(items)]:
        raise NoOpinion("it does not give one answer for each task")
    wanted = {"", *(item.task for item in items)}
    room = capacities(report for report in standing(contacts) if report.task in wanted)
    for point in found:
        checked(point, [report for report in contacts if report.task in (point.task, "")])
        for agent in {*point.assigned, *filter(None, (point.assigned_agent,))}:
            room[agent] = room.get(agent, 0) - 1
    if tired := sorted(agent for agent, left in room.items() if left < 0):
        raise NoOpinion(f"it gives {tired[0]!r:.60} more than it takes")
    return found


def one_by_one(
    find: Callable[[Sequence[Report]], Consensus], contacts: Sequence[Report], items: Sequence[Item]
) -> tuple[Consensus, ...]:
    """The tasks by name, each decided by itself; who has enough to do is left out."""
    counted = standing(contacts)
    room = capacities(counted)
    points = []
    for item in listed(items):
        free = [replace(r, task=item.task) for r in counted if r.task in (item.task, "") and room[r.agent] > 0]
        point = replace(find(free), task=item.task, epoch=counted[0].epoch if counted else 0)
        if point.assigned_agent is not None:
            room[point.assigned_agent] -= 1
        points.append(point)
    return tuple(points)


def _lawful(contacts: Sequence[Report]) -> tuple[Report, ...]:
    """The reports that count, in an order that does not depend on the given one."""
    return tuple(sorted((r for r in contacts if not refusal(r)), key=_order))


def _order(report: Report) -> tuple[object, ...]:
    return (report.task, report.agent, report.epoch, report.sequence, report.cost, repr(report))
