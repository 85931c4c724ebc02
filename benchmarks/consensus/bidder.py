"""Bidder: one agent's side of CBBA over a network that delays, repeats and reorders, but delivers in the end.

Each agent states its own bids, numbered; a newer statement of an agent about a task replaces its older ones, and the
highest standing bid for a task wins.  Statements are values: what ``drain`` gives is sent to the neighbours, what comes
in is given to ``hear``.  Only changes travel.  Nothing is concluded from silence: who may act is decided by the lease.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from middleware.consensus.strategy import MAX_NUMBER

Score = Callable[[tuple[str, ...], str], float]
"""What a task is worth to an agent that has a bundle already; 0 or less: it does not want it."""


class Statement(NamedTuple):
    """What an agent says of a task: its bid, or 0 where it bids no more; ``version`` numbers what it ever said."""

    task: str
    agent: str
    version: int
    bid: float


class Bidder:
    """What one agent bids and knows of the bids of all others; ``score`` says what tasks are worth to it."""

    def __init__(
        self, agent: str, tasks: Iterable[str], score: Score, capacity: int = 1, neighbours: Iterable[str] = ()
    ) -> None:
        self.agent = agent
        self.neighbours = sorted(neighbours)
        self.bundle: tuple[str, ...] = ()
        self._tasks = sorted(tasks)
        self._score = score
        self._capacity = capacity
        self._known: dict[str, dict[str, Statement]] = {task: {} for task in self._tasks}
        self._rival: dict[str, Statement | None] = dict.fromkeys(self._tasks)
        self._told: dict[str, Statement | None] = dict.fromkeys(self._tasks)
        self._out: dict[tuple[str, str], Statement] = {}
        self._heard: dict[str, dict[tuple[str, str], int]] = {}
        self._touched: set[str] = set()
        self._disowned: set[str] = set()
        self._count = 0
        self._choose()

    def winner(self, task: str) -> Statement | None:
        """The highest bid for a task that stands as far as is known here, or None."""
        own = self._known[task].get(self.agent)
        rival = self._rival[task]
        if own is None or own.bid <= 0.0:
            return rival
        return own if rival is None or _beats(own.bid, self.agent, rival) else rival

    def hear(self, neighbour: str, statements: Sequence[Statement]) -> list[Statement]:
        """Take in what a neighbour says; gives what that neighbour should know instead of what it said."""
        corrections = []
        is_moved = False
        heard = self._heard.setdefault(neighbour, {})
        for said in statements:
            task, agent, version, bid = said
            bids = self._known.get(task)
            if bids is None or not 0.0 <= bid <= MAX_NUMBER:
                continue
            if agent == self.agent:
                is_moved |= self._remembered(said)
                continue
            known = bids.get(agent)
            if known is not None and known.version > version:
                corrections.append(known)
                continue
            heard[task, agent] = version
            if known is not None and known.version == version:
                continue
            bids[agent] = said
            if known is not None and known.bid > 0.0:
                self._out[task, agent] = said  # it replaces what was passed on
            is_moved |= self._looked_again(said)
        if is_moved:
            self._choose()
        return corrections

    def drain(self) -> dict[str, tuple[Statement, ...]]:
        """What each neighbour does not know from here yet, nor said itself; it is then taken as told.

        Draining every few message times instead of at once makes fewer and fuller messages of the same news.
        """
        for task in sorted(self._touched):
            best = self.winner(task)
            if best is not None and best != self._told[task]:
                self._out[task, best.agent] = self._told[task] = best
        news = sorted(self._out.items())
        self._out.clear()
        self._touched.clear()
        found = {}
        for neighbour in self.neighbours:
            heard = self._heard.get(neighbour, {})
            fresh = tuple(said for key, said in news if heard.get(key, 0) < said.version)
            if fresh:
                found[neighbour] = fresh
        return found

    @property
    def is_quiet(self) -> bool:
        """Whether there is nothing to drain."""
        return not self._out and not self._touched

    def _remembered(self, said: Statement) -> bool:
        """The others know what this agent said in a life before: what it says now must count for more."""
        own = self._known[said.task].get(self.agent)
        if said.version <= (own.version if own is not None else 0):
            return False
        self._count = max(self._count, said.version)
        self._known[said.task][self.agent] = said._replace(bid=-1.0)
        self._disowned.add(said.task)
        return True

    def _looked_again(self, said: Statement) -> bool:
        """Find the best of the others' bids for that task again; whether the own bundle may be another now."""
        task, before = said.task, self._rival[said.task]
        self._touched.add(task)
        if said.bid > 0.0 and (before is None or _beats(said.bid, said.agent, before)):
            after: Statement | None = said
        elif before is None or before.agent != said.agent:
            return False  # the best is who it was
        else:
            others = [s for s in self._known[task].values() if s.agent != self.agent and s.bid > 0.0]
            after = min(others, key=lambda s: (-s.bid, s.agent), default=None)
        self._rival[task] = after
        if before is not None and (after is None or _beats(before.bid, before.agent, after)):
            return True  # a bid was taken back: this task may be had now
        own = self._known[task].get(self.agent)
        return task in self.bundle and own is not None and after is not None and not _beats(own.bid, self.agent, after)

    def _choose(self) -> None:
        """Fill the bundle anew, best task first, with what the others do not hold by a higher bid.

        A bid is never higher than the one before it in the bundle (bid warping: Johnson, Choi, How 2012), so that the
        agents also come to rest where a task is worth more beside another.
        """
        bids: dict[str, float] = {}
        ceiling = float("inf")
        while len(bids) < self._capacity:
            bundle = tuple(bids)
            best: tuple[float, str] | None = None
            for task in self._tasks:
                worth = self._score(bundle, task) if task not in bids else 0.0
                if worth > 0.0 and (best is None or worth > best[0]):
                    rival = self._rival[task]
                    if rival is None or _beats(min(worth, ceiling), self.agent, rival):
                        best = (worth, task)
            if best is None:
                break
            ceiling = bids[best[1]] = min(best[0], ceiling)
        for task in sorted({*self.bundle, *bids, *self._disowned}):
            own = self._known[task].get(self.agent)
            bid = bids.get(task, 0.0)
            if own is None or own.bid != bid:
                self._count += 1
                stated = Statement(task, self.agent, self._count, bid)
                self._known[task][self.agent] = self._out[task, self.agent] = stated
                self._touched.add(task)
        self._disowned.clear()
        self.bundle = tuple(bids)


def is_over(rounds: int, quiet: int, tasks: int, members: int) -> bool:
    """Whether nothing can change any more after so many ``rounds`` in step, the last ``quiet`` of them without news.

    Silence proves nothing: far away others may still change their minds.  What does is that each task is settled
    within as many rounds as the longest way has hops (Choi and others, theorem 1), if no message is lost.
    """
    return rounds > tasks * max(1, members - 1)


def _beats(bid: float, agent: str, rival: Statement) -> bool:
    return bid > rival.bid or (bid == rival.bid and agent < rival.agent)
