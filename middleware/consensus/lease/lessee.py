"""Lessee: one agent's lease on one task: claim it, keep it, give it back; and stand by for it.

A claim has two phases: a majority promises (and tells the highest token), a majority grants.  A renewal needs the
second one only.  The deadline is counted from when the granted question was *sent*, less a margin for clocks that drift
and the time in which the robot comes to rest, so it ends before any member would grant another (consensus rule 5).

``clock`` has to go on while the machine is suspended, where there is such a clock (rule 7).
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IDelayedCall, IReactorTime
from twisted.internet.task import deferLater

from middleware.consensus.lease.council import Council
from middleware.consensus.lease.lease_codec import AHEAD
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError
from middleware.entangled.quorum.ballot import NONE, Ballot, majority
from middleware.entangled.quorum.register import Kind
from middleware.entangled.quorum.round import PAUSE, Round

CLOCK_MARGIN = 0.02
"""Share by which the clocks of two correct nodes may drift apart: 2 rho, with rho = 1 %."""
RENEWALS = 3
"""How often a lease is renewed, and a stand-by asks, in each ttl."""
RETRY = 0.1
JITTER = (0.0, 0.02)
BACK_OFF = (0.02, 0.08)
"""Seconds after which a claim is tried again that another one was faster than."""
SOON = 1.5
"""Periods of asking within which a lease that runs out is claimed rather than looked at once more."""
FRESH = 0.3
"""Seconds for which the news of a release is believed against members that have not heard it."""
EARLY = 0.8
"""Share of the time before the end of a lease in which its successor may be promised (``AHEAD``), in which it is asked
for: a guess that is a little late still is in time."""
LEAD = 0.1
"""Seconds before a lease ends at which its successor is asked for: time for another try, and what comes too early waits
at the members (``patience``)."""
STAGGER = 0.2
"""Seconds by which each rank of those that stand by waits longer than the one before it."""
TICK = 0.05
"""A timer that fires later than this counts as a possible pause."""


@dataclass(frozen=True)
class Lease:
    """The right to act on a task until ``deadline`` (seconds of the lessee's own clock)."""

    task_id: str
    token: int
    deadline: float


class Lessee:
    """One agent's claim on the task of ``council``; ``changed`` is called when the lease is won, renewed or lost.

    ``stop_time`` is how long the robot takes to come to rest, in seconds.
    """

    def __init__(
        self,
        council: Council,
        clock: IReactorTime,
        rng: random.Random,
        changed: Callable[[], None],
        stop_time: float = 0.0,
    ) -> None:
        self.task_id = council.task_id
        self.council = council
        self.token = 0
        self.is_over = False
        self.pauses = 0
        self._clock = clock
        self._rng = rng
        self._changed = changed
        self._stop_time = stop_time
        self._deadline = 0.0
        self._rests_at = -math.inf
        self._ballot = NONE
        self._claimed = NONE
        self._rank = 0
        self._is_wanted = False
        self._free_at = -math.inf
        self._only_looks = False
        self._must_prepare = False
        self._is_promised = False
        self._is_outbid = False
        self._ends_at = -math.inf
        self._round: Round | None = None
        self._timer: IDelayedCall | None = None
        self._due_at = 0.0

    @property
    def lease(self) -> Lease | None:
        """The lease if it is held now."""
        if self.token and self._clock.seconds() < self._deadline:
            return Lease(self.task_id, self.token, self._deadline)
        return None

    def want(self) -> None:
        """Claim the lease and keep it, trying again until it is won."""
        self._move_up(0)
        if not self._is_wanted and not self.is_over:
            self._is_wanted = True
            self._claim()

    def stand_by(self, rank: int = 1) -> None:
        """Claim the lease when it is given back or has run out, the lower ranks first; until then listen and ask.

        Who holds the lease or wants it already only takes the rank.
        """
        self._move_up(max(1, rank))
        if not self._is_wanted and not self.is_over:
            self._is_wanted = self._only_looks = True
            self._again(self._rank * self.council.ttl / RENEWALS)

    def suspect(self) -> None:
        """The holder may be gone: ask now how long its lease runs, and be ready when it ends.  It shortens no lease."""
        if self._only_looks and self._is_wanted and not (self._is_asking or self._is_freed or self.lease is not None):
            self._look()

    def freed(self, token: int, rest: float = 0.0) -> None:
        """Somebody says that the lease with that token was given back; its robot moves for ``rest`` more seconds.

        The first in line asks for it at once, so that only the grant is left to ask for when that robot stands still.
        """
        self.council.note_token(token)
        if self._is_wanted and self.lease is None:
            is_news = not self._is_freed
            self._free_at = self._ends_at = self._clock.seconds() + rest
            if is_news:
                self.council.leap()
                if self._is_looking:
                    self._cancel()
                if not self._is_asking:
                    self._only_looks = False
                    self._again(self._turn())

    def outrank(self, token: int) -> None:
        """A device has obeyed ``token``: from now on nothing is claimed that is not higher, and nothing lower used."""
        self.council.token = max(self.council.token, token)
        if 0 < self.token < token:
            self._lose()
            self._claim()

    def release(self, heirs: Sequence[Contact] = (), rest: float = 0.0) -> Deferred[object]:
        """Give the lease back (stop the device first), or stop claiming it; fires when the council knows.

        The council is told how long the robot takes to come to rest, and grants nothing before: ``rest`` seconds until
        it stops, where it can't be told to, and those that it takes to stop.  Its members tell those that stand by;
        ``heirs`` are told from here, and so half a round trip earlier.
        """
        told: Deferred[object] = succeed(None)
        if self.lease is not None:
            # With the margin from the beginning: what is left of it is said again when a later claim is let go of.
            moves = (rest + self._stop_time) * (1.0 + CLOCK_MARGIN)
            self._rests_at = min(self._rests_at, self._clock.seconds() + moves)
        self._is_wanted = False
        self._cancel()
        if self._ballot != NONE:
            told = self._let_go(max(self._ballot, self._claimed), heirs)  # which ends the older one, too
        else:
            self._let_go_of_minority()
        self.token, self._deadline, self._ballot, self._claimed = 0, 0.0, NONE, NONE
        return told

    def move(self, members: Sequence[Contact]) -> Deferred[None]:
        """Have ``members`` be the council (stop the device first).

        A lease that is held goes back with it, and is kept for this agent until it has claimed it again there.  Fails
        as ``Council.change`` does; then the lease is claimed again where it was.
        """
        return Deferred.fromCoroutine(self._move(members))

    def end(self, token: int) -> Deferred[bytes]:
        """Have no lease granted any more (stop the device first): the task was done under ``token``.

        Where this agent holds a later one by now, that one counts.  Fires with the proof, signed by a
        majority of the council; fails as ``Council.close`` does.
        """
        return self.council.close(max(token, self.token)).addCallback(lambda _: self.council.ending)

    async def _move(self, members: Sequence[Contact]) -> None:
        self._cancel()
        if self.lease is not None:
            self.token, self._deadline = 0, 0.0
            moves = self._stop_time * (1.0 + CLOCK_MARGIN)
            self._rests_at = self._clock.seconds() + moves
            await deferLater(self._clock, moves)
        try:
            await self.council.change(members, keep=True)
        finally:
            if self._is_wanted and not self._is_asking:
                self._claim()

    # -- claiming ---------------------------------------------------------------------------------------------------

    def _claim(self) -> None:
        """Ask for promises; while a lease is held it stays in force meanwhile."""
        self._cancel()
        self._only_looks = False
        self._claimed = ballot = self.council.next_ballot()
        kinds = (Kind.GRANTED, Kind.SEALED)
        question = ballot.counter, self.council.ttl
        self._round = asked = self.council.round("lease.prepare", *question, kinds=kinds, short=self._short)
        asked.outcome.addCallback(self._promised, ballot, self.council.configuration)

    def _promised(self, asked: Round, ballot: Ballot, configuration: int) -> None:
        self.council.hear(asked)
        if self._round is not asked or self._has_ended(asked):
            return
        if self.council.configuration != configuration:
            return self._claim()
        if not asked.tally.is_won:
            return self._failed(asked)
        asked.close()
        if asked.tally.to_complete is not None:
            self._round = None
            finishing = Deferred.fromCoroutine(self.council.finish(ballot, asked))
            finishing.addErrback(lambda failure: failure.trap(EntangledError))
            finishing.addBoth(lambda _: self._go_on())
            return
        wait = asked.free_in() - LEAD if self.lease is None else 0.0
        if wait > 0.0:
            # The lease is about to run out, or the robot of who gave it back to stand still.
            self._is_promised = True
            self._timer = self._clock.callLater(wait, lambda: self._propose(ballot, self._next_token()))
        else:
            self._propose(ballot, self._next_token())

    def _next_token(self) -> int:
        """The token to claim: the one that is held while nobody was granted a higher one, else above all seen."""
        if self.lease is not None and self.token >= self.council.token:
            return self.token
        self.council.token += 1
        return self.council.token

    def _propose(self, ballot: Ballot, token: int) -> None:
        self._is_promised = False
        question = ballot.counter, token, self.council.ttl
        self._round = asked = self.council.round("lease.propose", *question, short=self._short)
        asked.outcome.addCallback(self._granted, ballot, token)

    def _granted(self, asked: Round, ballot: Ballot, token: int) -> None:
        self.council.hear(asked)
        if self._round is not asked or self._has_ended(asked):
            return
        # Who may not grant anything yet needs no other ballot later.
        self._must_prepare = any(reply.kind not in (Kind.GRANTED, Kind.QUIET) for reply in asked.tally.replies.values())
        deadline = self._deadline_of(asked) if asked.tally.is_won else 0.0
        if deadline <= self._clock.seconds():
            return self._failed(asked)
        self._ballot, self.token, self._deadline = ballot, token, deadline
        self._rests_at = deadline + self._stop_time
        self._again(self._poll_period())
        self._changed()

    def _deadline_of(self, won: Round) -> float:
        """Until when the robot must stand still again, on our clock."""
        return won.sent_at + self.council.ttl * (1.0 - CLOCK_MARGIN) - self._stop_time

    def _failed(self, asked: Round) -> None:
        asked.close()
        self._round = None
        if self.lease is not None:
            # There is time for another renewal before the deadline; a member that has promised a higher ballot
            # meanwhile needs a new one.
            self._must_prepare = any(reply.kind is Kind.OUTBID for reply in asked.tally.replies.values())
            return self._again(min(RETRY, self._deadline - self._clock.seconds()))
        was_held = self.token != 0
        self._let_go_of_minority()
        if was_held:
            self._let_go(self._ballot)
            self._lose()
        self._wait(asked)

    def _wait(self, asked: Round) -> None:
        """Claim when the lease may be free; look again in a third of a ttl at any rate, for a push may be lost."""
        is_outbid = any(reply.kind is Kind.OUTBID for reply in asked.tally.replies.values())
        free_in = asked.free_in()
        if is_outbid and free_in == math.inf:
            free_in = 0.0  # the others were not heard; with a higher ballot they are
        self._ends_at, self._is_outbid = self._clock.seconds() + free_in, is_outbid
        self._line_up(self._rng.uniform(*(BACK_OFF if is_outbid else JITTER)))

    def _line_up(self, pause: float) -> None:
        """Claim ``pause`` seconds after its turn has come, or look whether it has where that is long, or not known."""
        wait = self._turn() if self._is_freed else self._claims_in()
        # A healthy holder renews well before: what runs out that soon is claimed in time, without a look before.
        self._only_looks = wait > SOON * self._poll_period()
        self._again((self._poll_period() if self._only_looks else wait) + pause)

    def _look(self) -> None:
        """Ask whether the lease is free, and be promised nothing."""
        self._cancel()
        self._round = asked = self.council.round("lease.prepare", 0, self.council.ttl, short=0.0)
        asked.outcome.addCallback(self._looked, self.council.configuration)

    def _looked(self, asked: Round, configuration: int) -> None:
        self.council.hear(asked)
        if self._round is not asked or self._has_ended(asked):
            return
        asked.close()
        if self.council.configuration != configuration:
            # Only the members of now know who stands by, and tell it of a release.
            return self._look()
        if asked.tally.is_won and not self._stagger():
            self._claim()
        else:
            self._wait(asked)

    def _poll_period(self) -> float:
        return self.council.ttl / RENEWALS

    def _move_up(self, rank: int) -> None:
        """Take a place in the line; a claim that is due is due as much sooner or later."""
        before, self._rank = self._stagger(), rank
        waits = self._is_wanted and self.lease is None and not (self._only_looks or self._is_asking or self._is_freed)
        if waits and self._stagger() != before:
            self._line_up(self._rng.uniform(*JITTER))

    def _claims_in(self) -> float:
        """Seconds until it claims what runs out: the first in line is promised it before, and so has time for it."""
        is_first = not (self._stagger() or self._is_outbid)
        lead = EARLY * AHEAD * self.council.ttl if is_first else 0.0
        return max(0.0, self._ends_at + self._stagger() - lead - self._clock.seconds())

    def _stagger(self) -> float:
        return STAGGER * max(0, self._rank - 1)

    def _turn(self) -> float:
        """Seconds until it claims what was given back: the first in line while the robot still moves, then by rank."""
        wait = self._stagger()
        return wait and max(0.0, self._free_at - self._clock.seconds()) + wait

    # -- keeping ----------------------------------------------------------------------------------------------------

    def _due(self) -> None:
        """Renew, or ask again; a timer that is late may mean that this process or machine stood still."""
        self._timer = None
        self.pauses += self._clock.seconds() - self._due_at > TICK
        if self.lease is not None and not self._must_prepare:
            self._cancel()
            self._propose(self._ballot, self.token)
            return
        if self.token and self.lease is None:
            self._lose()
        if self._only_looks and not self._is_freed and self.lease is None:
            self._look()
        else:
            self._claim()

    def _lose(self) -> None:
        """It is over before it was given back."""
        self.token, self._deadline, self._ballot = 0, 0.0, NONE
        self._changed()

    def _has_ended(self, asked: Round) -> bool:
        """Whether a majority says that the task has ended: then nobody may act, not even whoever could for a while."""
        over = [reply for reply in asked.tally.replies.values() if reply.kind is Kind.OVER]
        if len(over) >= majority(len(self.council.members)):
            self.is_over, self._is_wanted = True, False
            self._cancel()
            self._lose()
        return self.is_over

    # -- inside -----------------------------------------------------------------------------------------------------

    @property
    def _is_freed(self) -> bool:
        """Whether the lease was given back just now: the news may be here before it is at every member."""
        return self._clock.seconds() < self._free_at + FRESH

    @property
    def _short(self) -> float:
        """Seconds for which a lease that is in the way is waited for: one that was given back does not last."""
        return math.inf if self._is_freed else PAUSE

    @property
    def _is_asking(self) -> bool:
        return self._is_promised or (self._round is not None and self._round.is_open)

    @property
    def _is_looking(self) -> bool:
        return self._only_looks and self._is_asking

    def _go_on(self) -> None:
        if self._is_wanted and not self._is_asking:
            self._again(self._rng.uniform(*BACK_OFF))

    def _let_go(self, ballot: Ballot, heirs: Sequence[Contact] = ()) -> Deferred[object]:
        """Tell the council, and for how long the robot may still move (it was told to stop at the deadline at most)."""
        rest = max(0.0, self._rests_at - self._clock.seconds())
        return self.council.let_go(ballot, heirs, rest * (1.0 + CLOCK_MARGIN))

    def _let_go_of_minority(self) -> None:
        """What a minority granted must not keep a healthier claimant waiting."""
        if self._claimed not in (self._ballot, NONE):
            self._let_go(self._claimed)

    def _cancel(self) -> None:
        """What a round under way still brings is not used any more."""
        if self._round is not None:
            self._round.close()
            self._round = None
        self._is_promised = False
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._timer = None

    def _again(self, delay: float) -> None:
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._due_at = self._clock.seconds() + delay
        self._timer = self._clock.callLater(delay, self._due)
