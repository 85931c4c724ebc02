"""The lease client of one agent for one task: it claims, renews and releases the lease, and waits for it as a standby.

A claim has two phases: a majority promises and reports the highest token, then a majority grants.  A renewal needs the
second phase only.  The deadline is computed from the time at which the granted request was *sent*, minus a margin for
clock drift and the time that the robot needs to stop, so it is before any member grants another lease (consensus rule
5).

The states and transitions of the client are in ``client_states``; this module performs the actions.  ``clock`` must
continue while the machine is suspended, if the system has such a clock (rule 7).
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from twisted.internet.defer import Deferred, succeed
from twisted.internet.interfaces import IDelayedCall, IReactorTime
from twisted.internet.task import deferLater

from middleware.consensus.lease.client_states import ACTIVE, Action, Event, State, next_step
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
"""Number of renewals, or polls of a standby, per TTL."""
RETRY = 0.1
JITTER = (0.0, 0.02)
BACK_OFF = (0.02, 0.08)
"""Seconds before a claim is retried after another agent was faster."""
SOON = 1.5
"""Poll periods before its end from which a lease is claimed instead of polled again."""
FRESH = 0.3
"""Seconds for which a release notification outweighs members that have not received it yet."""
EARLY = 0.8
"""Share of the promise window before the end of a lease (``AHEAD``) in which the first standby asks for promises.

Below 1, so that a slightly wrong estimate is still in time.
"""
LEAD = 0.1
"""Seconds before the end of a lease at which the next one is proposed: time for a retry.

Members delay early proposals (``desk.in_time``).
"""
STAGGER = 0.2
"""Seconds by which each standby rank waits longer than the previous one."""
TICK = 0.05
"""Seconds by which a timer must be late to count as a possible suspension."""


@dataclass(frozen=True)
class Lease:
    """The right to act on a task until ``deadline`` (seconds on the lease client's clock)."""

    task_id: str
    token: int
    deadline: float


@dataclass
class _Held:
    """The lease that was granted last: its token (0: none), deadline and ballot."""

    token: int = 0
    deadline: float = 0.0
    ballot: Ballot = NONE


@dataclass
class _Standby:
    """The client's ``rank`` among the standbys, and its knowledge of another agent's lease.

    ``freed_at`` is the time at which the robot of an agent that released the lease stands still, ``ends_at`` the
    estimated end of the lease, and ``is_outbid`` says whether a higher ballot was promised in the last round.
    """

    rank: int = 0
    freed_at: float = -math.inf
    ends_at: float = -math.inf
    is_outbid: bool = False


class Lessee:
    """The lease client of one agent for the task of ``council``.

    :param clock: a clock that continues while the machine is suspended
    :param rng: the source of random pauses
    :param changed: called when the lease is granted, renewed or lost
    :param stop_time: the time in seconds that the robot needs to stop
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
        self.pauses = 0
        self.state = State.IDLE
        self._steps = 0
        self._clock = clock
        self._rng = rng
        self._changed = changed
        self._stop_time = stop_time
        self._held = _Held()
        self._claimed = NONE
        self._robot_stops_at = -math.inf
        self._standby = _Standby()
        self._round: Round | None = None
        self._timer: IDelayedCall | None = None
        self._due_at = 0.0

    @property
    def token(self) -> int:
        """The token of the current or last lease; 0 for none."""
        return self._held.token

    @property
    def is_over(self) -> bool:
        """Whether a majority reported that the task has ended."""
        return self.state is State.OVER

    @property
    def lease(self) -> Lease | None:
        """The lease while it is held, otherwise None."""
        if self.token and self._clock.seconds() < self._held.deadline:
            return Lease(self.task_id, self.token, self._held.deadline)
        return None

    # -- calls of the agent -----------------------------------------------------------------------------------------

    def want(self) -> None:
        """Claim the lease and keep it; a claim is retried until it is granted."""
        self._set_rank(0)
        self._handle(Event.WANT)

    def stand_by(self, rank: int = 1) -> None:
        """Claim the lease after it was released or has expired, lower ranks first; until then poll it.

        A client that holds or claims the lease only records the rank.
        """
        self._set_rank(max(1, rank))
        self._handle(Event.STAND_BY)

    def suspect(self) -> None:
        """Poll the end of the lease now, because the holder may have failed.  It shortens no lease."""
        if not self._is_freed and self.lease is None:
            self._handle(Event.SUSPECT)

    def freed(self, token: int, rest: float = 0.0) -> None:
        """Process the notification that the lease with ``token`` was released.

        Its robot moves for ``rest`` more seconds.  The first standby asks for promises at once, so that only the grant
        remains when that robot stands still.
        """
        self.council.note_token(token)
        if self.state in ACTIVE and self.lease is None:
            is_new = not self._is_freed
            self._standby.freed_at = self._standby.ends_at = self._clock.seconds() + rest
            if is_new:
                self._handle(Event.FREED)

    def outrank(self, token: int) -> None:
        """Record that a device has obeyed ``token``: claims are higher from now on, and a lower lease is lost."""
        self.council.token = max(self.council.token, token)
        if 0 < self.token < token:
            self._handle(Event.OUTRANK)

    def release(self, standbys: Sequence[Contact] = (), rest: float = 0.0) -> Deferred[object]:
        """Release the lease (stop the device first), or stop claiming it; fires when the members know.

        The members grant no lease until the robot has stopped: after its stop time, plus ``rest`` seconds for an
        unreachable robot.  The members notify the standbys; this client notifies ``standbys`` directly, half
        a round trip earlier.
        """
        done: Deferred[object] = succeed(None)
        if self.lease is not None:
            # Apply the margin once: a later release of another claim uses the remaining time.
            moves = (rest + self._stop_time) * (1.0 + CLOCK_MARGIN)
            self._robot_stops_at = min(self._robot_stops_at, self._clock.seconds() + moves)
        self._handle(Event.RELEASE)
        if self._held.ballot != NONE:
            # The higher ballot also ends the older one.
            done = self._release_ballot(max(self._held.ballot, self._claimed), standbys)
        else:
            self._release_minority()
        self._held, self._claimed = _Held(), NONE
        return done

    def move(self, members: Sequence[Contact]) -> Deferred[None]:
        """Change the quorum members to ``members`` (stop the device first).

        A held lease is released with the change, and reserved for this client until it has claimed it again from the
        new members.  Fails as ``Council.change`` does; then the lease is claimed again from the old members.
        """
        return Deferred.fromCoroutine(self._move(members))

    def end(self, token: int) -> Deferred[bytes]:
        """Close the task, which was done under ``token`` (stop the device first); no more leases are granted.

        If this client holds a later token by now, that one is used.  Fires with the proof, signed by a majority of the
        members; fails as ``Council.close`` does.
        """
        return self.council.close(max(token, self.token)).addCallback(lambda _: self.council.ending)

    async def _move(self, members: Sequence[Contact]) -> None:
        self._handle(Event.MOVE)
        if self.lease is not None:
            self._held.token, self._held.deadline = 0, 0.0
            moves = self._stop_time * (1.0 + CLOCK_MARGIN)
            self._robot_stops_at = self._clock.seconds() + moves
            await deferLater(self._clock, moves)
        try:
            await self.council.change(members, keep=True)
        except Exception:  # not GeneratorExit: the coroutine of a stopped node is garbage-collected
            self._handle(Event.MOVED)
            raise
        self._handle(Event.MOVED)

    def _set_rank(self, rank: int) -> None:
        """Set the rank among the standbys; a scheduled claim moves accordingly."""
        before, self._standby.rank = self._stagger(), rank
        if self._stagger() != before and self.lease is None and not self._is_freed:
            self._handle(Event.RANK)

    # -- transitions ------------------------------------------------------------------------------------------------

    def _handle(self, event: Event, round_: Round | None = None, delay: float = 0.0) -> None:
        """Go to the next state and perform the actions.

        :param asked: the round whose result the event is
        :param delay: seconds, for an event that sets the timer
        """
        self.state, actions = next_step(self.state, event)
        self._steps = step = self._steps + 1
        for action in actions:
            if self._steps == step:  # otherwise the listener has caused another transition, which replaces this one
                self._perform(action, round_, delay)

    def _perform(self, action: Action, round_: Round | None, delay: float) -> None:
        match action:
            case Action.CANCEL:
                self._cancel()
            case Action.LOOK:
                self._look()
            case Action.PREPARE:
                self._prepare()
            case Action.PROPOSE:
                self._propose(self._claimed, self._next_token())
            case Action.RENEW:
                self._cancel()
                self._propose(self._held.ballot, self.token)
            case Action.COMPLETE:
                assert round_ is not None
                completing = Deferred.fromCoroutine(self.council.finish(self._claimed, round_))
                completing.addErrback(lambda failure: failure.trap(EntangledError))
                completing.addBoth(lambda _: self._handle(Event.COMPLETED))
            case Action.LEAP:
                self.council.leap()
            case Action.LOSE:
                self._lose()
            case Action.DROP:
                was_held = self.token != 0
                self._release_minority()
                if was_held:
                    self._release_ballot(self._held.ballot)
                    self._lose()
            case Action.NOTIFY:
                self._changed()
            case Action.LINE_UP if round_ is not None:
                self._estimate_end(round_)
            case Action.LINE_UP:
                self._schedule_claim(self._rng.uniform(*JITTER))
            case Action.AFTER_RANK:
                self._set_timer(self._standby.rank * self._poll_period)
            case Action.AFTER_POLL | Action.AFTER_WAIT | Action.AFTER_PREVIOUS:
                self._set_timer(delay)
            case Action.AFTER_TURN:
                self._set_timer(self._released_delay())
            case Action.AFTER_RENEWAL:
                self._set_timer(self._poll_period)
            case Action.AFTER_RETRY:
                self._set_timer(min(RETRY, self._held.deadline - self._clock.seconds()))
            case Action.AFTER_BACK_OFF:
                self._set_timer(self._rng.uniform(*BACK_OFF))

    # -- rounds -----------------------------------------------------------------------------------------------------

    def _look(self) -> None:
        """Poll whether the lease is free, without a promise."""
        self._cancel()
        self._round = round_ = self.council.round("lease.prepare", 0, self.council.ttl, short=0.0)
        round_.outcome.addCallback(self._on_look, self.council.configuration)

    def _on_look(self, round_: Round, configuration: int) -> None:
        if not self._is_current(round_):
            return
        round_.close()
        if self.council.configuration != configuration:
            # Only members of the newest council know the standbys, and notify them of a release.
            self._handle(Event.RECONFIGURED)
        else:
            is_free = round_.tally.is_won and not self._stagger()
            self._handle(Event.FREE if is_free else Event.TAKEN, round_)

    def _prepare(self) -> None:
        """Ask for promises; a held lease stays valid meanwhile."""
        self._cancel()
        self._claimed = ballot = self.council.next_ballot()
        kinds = (Kind.GRANTED, Kind.SEALED)
        question = ballot.counter, self.council.ttl
        self._round = round_ = self.council.round("lease.prepare", *question, kinds=kinds, short=self._short)
        round_.outcome.addCallback(self._on_promises, self.council.configuration)

    def _on_promises(self, round_: Round, configuration: int) -> None:
        if not self._is_current(round_):
            return
        if self.council.configuration != configuration:
            return self._handle(Event.RECONFIGURED)
        if not round_.tally.is_won:
            return self._on_failure(round_)
        round_.close()
        wait = round_.free_in() - LEAD if self.lease is None else 0.0
        if round_.tally.to_complete is not None:
            self._handle(Event.UNFINISHED, round_)
        elif wait > 0.0:
            # The lease is about to expire, or the robot of its last holder to stop.
            self._handle(Event.EARLY_PROMISES, delay=wait)
        else:
            self._handle(Event.PROMISES)

    def _next_token(self) -> int:
        """Return the token to claim: the own one if no higher one was granted, else one above all known."""
        if self.lease is not None and self.token >= self.council.token:
            return self.token
        self.council.token += 1
        return self.council.token

    def _propose(self, ballot: Ballot, token: int) -> None:
        question = ballot.counter, token, self.council.ttl
        self._round = round_ = self.council.round("lease.propose", *question, short=self._short)
        round_.outcome.addCallback(self._on_grants, ballot, token)

    def _on_grants(self, round_: Round, ballot: Ballot, token: int) -> None:
        if not self._is_current(round_):
            return
        deadline = self._deadline_of(round_) if round_.tally.is_won else 0.0
        if deadline <= self._clock.seconds():
            return self._on_failure(round_)
        self._held = _Held(token, deadline, ballot)
        # The device's clock may be slower than this client's.
        self._robot_stops_at = deadline + self._stop_time + self.council.ttl * CLOCK_MARGIN
        # A member that may not grant anything yet does not need another ballot.
        others = [reply for reply in round_.tally.replies.values() if reply.kind not in (Kind.GRANTED, Kind.QUIET)]
        self._handle(Event.PARTIAL_GRANTS if others else Event.GRANTS)

    def _deadline_of(self, won: Round) -> float:
        """Return the time, on the own clock, by which the robot must stand still."""
        return won.sent_at + self.council.ttl * (1.0 - CLOCK_MARGIN) - self._stop_time

    def _is_current(self, round_: Round) -> bool:
        """Process a round; return whether it is the newest one and the task has not ended."""
        self.council.hear(round_)
        if self._round is not round_:
            return False
        over = [reply for reply in round_.tally.replies.values() if reply.kind is Kind.OVER]
        if len(over) >= majority(len(self.council.members)):
            self._handle(Event.ENDED)
        return not self.is_over

    def _on_failure(self, round_: Round) -> None:
        round_.close()
        if self.lease is None:
            self._handle(Event.REJECTED, round_)
        else:
            # A member that has promised a higher ballot needs a new one; there is time for it before the deadline.
            is_outbid = any(reply.kind is Kind.OUTBID for reply in round_.tally.replies.values())
            self._handle(Event.OUTBID if is_outbid else Event.KEPT)

    # -- times ------------------------------------------------------------------------------------------------------

    def _estimate_end(self, round_: Round) -> None:
        """Estimate the end of the lease from a failed round, and set the timer."""
        is_outbid = any(reply.kind is Kind.OUTBID for reply in round_.tally.replies.values())
        free_in = round_.free_in()
        if is_outbid and free_in == math.inf:
            free_in = 0.0  # the other members did not answer; under a higher ballot they may
        self._standby.ends_at, self._standby.is_outbid = self._clock.seconds() + free_in, is_outbid
        self._schedule_claim(self._rng.uniform(*(BACK_OFF if is_outbid else JITTER)))

    def _schedule_claim(self, pause: float) -> None:
        """Set the timer for the claim; if that is late or unknown, for a poll, because a notification may be lost."""
        wait = self._released_delay() if self._is_freed else self._expiry_delay()
        # A healthy holder renews well before the end: a lease that expires this soon is claimed without a poll.
        is_far = wait > SOON * self._poll_period
        self._handle(Event.FAR if is_far else Event.NEAR, delay=(self._poll_period if is_far else wait) + pause)

    @property
    def _poll_period(self) -> float:
        return self.council.ttl / RENEWALS

    def _expiry_delay(self) -> float:
        """Return the seconds until an expiring lease is claimed; the first standby gets its promises before."""
        is_first = not (self._stagger() or self._standby.is_outbid)
        lead = EARLY * AHEAD * self.council.ttl if is_first else 0.0
        return max(0.0, self._standby.ends_at + self._stagger() - lead - self._clock.seconds())

    def _stagger(self) -> float:
        return STAGGER * max(0, self._standby.rank - 1)

    def _released_delay(self) -> float:
        """Return the seconds until a released lease is claimed; the first standby claims at once."""
        wait = self._stagger()
        return wait and max(0.0, self._standby.freed_at - self._clock.seconds()) + wait

    @property
    def _is_freed(self) -> bool:
        """Whether the lease was released so recently that some members may not know it."""
        return self._clock.seconds() < self._standby.freed_at + FRESH

    @property
    def _short(self) -> float:
        """The longest remaining lease in seconds that a round waits for; a released one ends soon."""
        return math.inf if self._is_freed else PAUSE

    def _on_timer(self) -> None:
        """Handle the timer; a late one may mean that this process or machine was suspended."""
        self._timer = None
        self.pauses += self._clock.seconds() - self._due_at > TICK
        if self.state is State.PROMISED:
            self._handle(Event.DUE)
        elif self.token and self.lease is None:
            self._handle(Event.EXPIRED)
        elif self._is_freed and self.lease is None:
            self._handle(Event.DUE_FREED)
        else:
            self._handle(Event.DUE)

    def _set_timer(self, delay: float) -> None:
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._due_at = self._clock.seconds() + delay
        self._timer = self._clock.callLater(delay, self._on_timer)

    def _cancel(self) -> None:
        """Cancel the round under way and the timer."""
        if self._round is not None:
            self._round.close()
            self._round = None
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._timer = None

    # -- release ----------------------------------------------------------------------------------------------------

    def _lose(self) -> None:
        """Forget a lease that was not released, and notify the listener."""
        self._held = _Held()
        self._changed()

    def _release_ballot(self, ballot: Ballot, standbys: Sequence[Contact] = ()) -> Deferred[object]:
        """Release ``ballot`` at the members, with the time for which the robot may still move."""
        rest = max(0.0, self._robot_stops_at - self._clock.seconds())
        return self.council.let_go(ballot, standbys, rest * (1.0 + CLOCK_MARGIN))

    def _release_minority(self) -> None:
        """Release a claim that only a minority granted, so that it delays no other agent."""
        if self._claimed not in (self._held.ballot, NONE):
            self._release_ballot(self._claimed)
