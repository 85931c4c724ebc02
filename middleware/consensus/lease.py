"""Lease: who may act.  A majority of the task's council grants it, with a token that only grows.

``Acceptor`` is the council member's side and ``Lessee`` the claimant's.  Durations travel, never moments; a lessee
counts its deadline from when it *sent* the request, less a clock margin, so it ends before any acceptor would grant
another (PaxosLease, arXiv 1209.4187).  The token fences: a device refuses commands whose token is older than one it
has seen.

This is the plain form: tokens live in memory and a claim is one round.  A council member that was restarted has
forgotten what it granted, so it grants nothing for one ttl.  The prepare phase, tokens that survive a restart and
changes of the council have their place here.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IDelayedCall, IReactorTime

CLOCK_MARGIN = 0.02
"""Share by which two clocks of correct nodes may drift apart (1 % each)."""
TRIES_PER_TTL = 3
RENEWAL_RETRY = 0.1
RETRY = (0.02, 0.08)
NOBODY = ""


@dataclass(frozen=True)
class Grant:
    """An acceptor's answer: whether it grants, the highest token seen there, and seconds until the grant runs out."""

    granted: bool
    token: int
    remaining: float


@dataclass
class _Granted:
    holder: str
    token: int
    until: float


class Acceptor:
    """One council member since ``born_at``.  It grants at most one unexpired lease a task, and never an older token.

    It does not know whether the task exists: a lease on nothing hurts nobody and runs out.  A grant is only forgotten
    when it has run out, so the member of a full council refuses rather than grants twice.
    """

    MAX_TASKS = 10_000

    def __init__(self, born_at: float = -math.inf) -> None:
        self._born_at = born_at
        self._granted: dict[str, _Granted] = {}

    def claim(self, task_id: str, holder: str, token: int, ttl: float, now: float) -> Grant:
        """Grant, or say what stands against it.  ``holder`` renews with the token that it holds."""
        held = self._granted.get(task_id)
        if held is None:
            wait = max(self._born_at + ttl - now, self._wait_for_room(now))
            if wait > 0.0:
                return Grant(False, 0, wait)
            self._granted[task_id] = _Granted(holder, token, now + ttl)
            return Grant(True, token, ttl)
        mine = held.holder == holder
        if (not mine and held.until > now) or token < held.token or (token == held.token and not mine):
            return Grant(False, held.token, max(0.0, held.until - now))
        held.holder, held.token, held.until = holder, token, now + ttl
        return Grant(True, token, ttl)

    def release(self, task_id: str, holder: str, token: int, now: float) -> None:
        """End a lease early; the token stays, so nobody can use it again, not even a claim that was under way."""
        held = self._granted.get(task_id)
        if held is not None and held.holder == holder and held.token == token:
            held.holder, held.until = NOBODY, now

    def _wait_for_room(self, now: float) -> float:
        """Make room for one more task; the seconds until there will be some."""
        if len(self._granted) < self.MAX_TASKS:
            return 0.0
        oldest = min(self._granted, key=lambda t: self._granted[t].until)
        wait = self._granted[oldest].until - now
        if wait <= 0.0:
            del self._granted[oldest]
        return wait


@dataclass(frozen=True)
class Lease:
    """The right to act on a task until ``deadline`` (seconds of the lessee's own clock)."""

    task_id: str
    token: int
    deadline: float


Ask = Callable[[int, str, tuple[Any, ...]], Deferred[Any]]
"""Ask the n-th council member: (index, method, arguments)."""


class Lessee:
    """One agent's lease on one task: claim, renew, release.

    ``council_size`` members are asked through ``ask``; ``changed`` is called when the lease is won, renewed or lost.
    ``floor`` is the highest token that the agent's own device has obeyed, so that a new token is always higher.
    """

    def __init__(
        self,
        task_id: str,
        holder: str,
        ttl: float,
        council_size: int,
        ask: Ask,
        clock: IReactorTime,
        rng: random.Random,
        changed: Callable[[], None],
        floor: int = 0,
    ) -> None:
        self.task_id = task_id
        self.token = 0
        self._holder = holder
        self._ttl = ttl
        self._size = council_size
        self._ask = ask
        self._clock = clock
        self._rng = rng
        self._changed = changed
        self._highest = floor
        self._deadline = 0.0
        self._wanted = False
        self._round: _Round | None = None
        self._timer: IDelayedCall | None = None

    @property
    def lease(self) -> Lease | None:
        """The lease if it is held now."""
        if self.token and self._clock.seconds() < self._deadline:
            return Lease(self.task_id, self.token, self._deadline)
        return None

    def want(self) -> None:
        """Claim the lease and keep it, trying again until it is won."""
        if not self._wanted:
            self._wanted = True
            self._begin()

    def release(self) -> None:
        """Give the lease back (stop the device first), or stop claiming it."""
        self._wanted = False
        self._deadline = 0.0
        # What a round under way still brings is given back, never used: the members may have let go by then.
        self._round = None
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        if self.token:
            self._give_up(self.token)
        self.token = 0

    def _begin(self) -> None:
        """One claim or renewal at all members at once."""
        held = self.lease
        token = held.token if held is not None else self._highest + 1
        self._highest = max(self._highest, token)
        round_ = self._round = _Round(token, self._clock.seconds())
        for member in range(self._size):
            asked = self._ask(member, "lease.claim", (self.task_id, token, self._ttl))
            asked.addBoth(self._answered, round_, member)

    def _answered(self, answer: object, round_: _Round, member: int) -> None:
        """Count the answer of one member, or its silence (a Failure)."""
        grant = grant_of(answer) or Grant(False, 0, 0.0)
        self._highest = max(self._highest, grant.token)
        (round_.grants if grant.granted else round_.refusals).append(grant)
        if self._round is round_:
            needed = self._size // 2 + 1
            if len(round_.grants) >= needed:
                self._round = None
                self._won(round_)
            elif self._size - len(round_.refusals) < needed:
                self._round = None
                self._not_won(round_)
        elif grant.granted and round_.token != self.token:
            self._tell_release(member, round_.token)

    def _won(self, won: _Round) -> None:
        self.token = won.token
        self._deadline = won.sent + self._ttl * (1.0 - CLOCK_MARGIN)
        self._again(self._ttl / TRIES_PER_TTL)
        self._changed()

    def _not_won(self, lost: _Round) -> None:
        if self.lease is not None:
            # A renewal that failed this time: there is time for another before the deadline.
            return self._again(RENEWAL_RETRY)
        was_held = self.token != 0
        self.token = 0
        # What a minority granted must not keep a healthier claimant waiting.
        self._give_up(lost.token)
        remaining = min((g.remaining for g in lost.refusals if g.remaining > 0), default=0.0)
        self._again(min(remaining, self._ttl / TRIES_PER_TTL) + self._rng.uniform(*RETRY))
        if was_held:
            self._changed()

    def _give_up(self, token: int) -> None:
        for member in range(self._size):
            self._tell_release(member, token)

    def _tell_release(self, member: int, token: int) -> None:
        self._ask(member, "lease.release", (self.task_id, token)).addErrback(lambda _: None)

    def _again(self, delay: float) -> None:
        self._timer = self._clock.callLater(delay, self._begin)


@dataclass(eq=False)
class _Round:
    """One claim or renewal under way, and what has come of it; ``sent`` is when it was asked."""

    token: int
    sent: float
    grants: list[Grant] = field(default_factory=list)
    refusals: list[Grant] = field(default_factory=list)


def grant_of(answer: object) -> Grant | None:
    """The grant in an acceptor's answer, or None where it is none."""
    if not isinstance(answer, list) or len(answer) != 3:
        return None
    granted, token, remaining = answer
    lawful = isinstance(granted, bool) and type(token) is int and 0 <= token < 2**62 and isinstance(remaining, float)
    return Grant(granted, token, max(0.0, remaining)) if lawful else None
