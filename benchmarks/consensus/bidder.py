"""One agent's side of CBBA over a network that delays, repeats and reorders messages, but delivers them eventually.

Each agent publishes its own bids as statements with version numbers. A newer statement of an agent about a task
replaces the older one, and the highest valid bid for a task wins. The caller sends the result of ``drain`` to the
neighbours and passes received statements to ``receive``. Only changes are sent. A lack of messages does not prove
agreement: the lease decides which agent may act.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from middleware.consensus.strategy import MAX_NUMBER

Score = Callable[[tuple[str, ...], str], float]
"""The value of a task for an agent with a given bundle; the agent does not bid if the value is 0 or less."""


class Statement(NamedTuple):
    """An agent's bid for a task, or 0 after a withdrawal; ``version`` numbers the statements of the agent."""

    task: str
    agent: str
    version: int
    bid: float


class Bidder:
    """One agent's bids and its view of all other bids; ``score`` returns the value of a task for this agent."""

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
        self._sent_statements: dict[str, Statement | None] = dict.fromkeys(self._tasks)
        self._outgoing: dict[tuple[str, str], Statement] = {}
        self._received_statements: dict[str, dict[tuple[str, str], int]] = {}
        self._touched: set[str] = set()
        self._disowned: set[str] = set()
        self._count = 0
        self._rebuild_bundle()

    def find_winner(self, task: str) -> Statement | None:
        """Return the highest valid bid for a task in this agent's view, or None."""
        own = self._known[task].get(self.agent)
        rival = self._rival[task]
        if own is None or own.bid <= 0.0:
            return rival
        return own if rival is None or _beats(own.bid, self.agent, rival) else rival

    def receive(self, neighbour: str, statements: Sequence[Statement]) -> list[Statement]:
        """Process a neighbour's statements; return newer statements that the neighbour should have."""
        corrections = []
        is_moved = False
        heard = self._received_statements.setdefault(neighbour, {})
        for statement in statements:
            task, agent, version, bid = statement
            bids = self._known.get(task)
            if bids is None or not 0.0 <= bid <= MAX_NUMBER:
                continue
            if agent == self.agent:
                is_moved |= self._adopt_previous_run(statement)
                continue
            known = bids.get(agent)
            if known is not None and known.version > version:
                corrections.append(known)
                continue
            heard[task, agent] = version
            if known is not None and known.version == version:
                continue
            bids[agent] = statement
            if known is not None and known.bid > 0.0:
                self._outgoing[task, agent] = statement  # the newer statement replaces one that was to be forwarded
            is_moved |= self._update_rival(statement)
        if is_moved:
            self._rebuild_bundle()
        return corrections

    def drain(self) -> dict[str, tuple[Statement, ...]]:
        """Return the statements that each neighbour does not have yet, and mark them as sent.

        A call only every few rounds gives fewer and larger messages with the same content.
        """
        for task in sorted(self._touched):
            best = self.find_winner(task)
            if best is not None and best != self._sent_statements[task]:
                self._outgoing[task, best.agent] = self._sent_statements[task] = best
        news = sorted(self._outgoing.items())
        self._outgoing.clear()
        self._touched.clear()
        found = {}
        for neighbour in self.neighbours:
            heard = self._received_statements.get(neighbour, {})
            fresh = tuple(said for key, said in news if heard.get(key, 0) < said.version)
            if fresh:
                found[neighbour] = fresh
        return found

    @property
    def is_quiet(self) -> bool:
        """Whether there is nothing to send."""
        return not self._outgoing and not self._touched

    def _adopt_previous_run(self, statement: Statement) -> bool:
        """Continue the version numbers of a previous run of this agent, whose statements other agents remember."""
        own = self._known[statement.task].get(self.agent)
        if statement.version <= (own.version if own is not None else 0):
            return False
        self._count = max(self._count, statement.version)
        self._known[statement.task][self.agent] = statement._replace(bid=-1.0)
        self._disowned.add(statement.task)
        return True

    def _update_rival(self, statement: Statement) -> bool:
        """Recompute the best bid of the other agents for a task; return whether this agent's bundle can change."""
        task, before = statement.task, self._rival[statement.task]
        self._touched.add(task)
        if statement.bid > 0.0 and (before is None or _beats(statement.bid, statement.agent, before)):
            after: Statement | None = statement
        elif before is None or before.agent != statement.agent:
            return False  # the best bidder is unchanged
        else:
            others = [s for s in self._known[task].values() if s.agent != self.agent and s.bid > 0.0]
            after = min(others, key=lambda s: (-s.bid, s.agent), default=None)
        self._rival[task] = after
        if before is not None and (after is None or _beats(before.bid, before.agent, after)):
            return True  # a bid was withdrawn: this agent may get the task now
        own = self._known[task].get(self.agent)
        return task in self.bundle and own is not None and after is not None and not _beats(own.bid, self.agent, after)

    def _rebuild_bundle(self) -> None:
        """Rebuild the bundle, best task first, from tasks on which no other agent bids more.

        A bid is never higher than the previous one in the bundle (bid warping: Johnson, Choi, How 2012), so the agents
        converge even if a task is worth more in combination with another task.
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
                self._known[task][self.agent] = self._outgoing[task, self.agent] = stated
                self._touched.add(task)
        self._disowned.clear()
        self.bundle = tuple(bids)


def is_final(rounds: int, quiet: int, tasks: int, members: int) -> bool:
    """Return whether the result is final after ``rounds`` synchronous rounds, the last ``quiet`` without changes.

    Rounds without changes are not a proof, because distant agents may still change their bids. Without message loss,
    the result is final after as many rounds as the number of tasks times the diameter of the graph (Choi and others,
    theorem 1).
    """
    return rounds > tasks * max(1, members - 1)


def _beats(bid: float, agent: str, rival: Statement) -> bool:
    return bid > rival.bid or (bid == rival.bid and agent < rival.agent)
