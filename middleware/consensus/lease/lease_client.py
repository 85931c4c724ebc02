"""The lease client of one agent for one task: it claims, renews and releases the lease, or is a standby.

A claim has two phases: a majority promises and reports the highest token, then a majority grants the lease.  A renewal
needs only the second phase.  The deadline is the ttl after the granted request was *sent*, less a margin for clock
drift and the time that the robot needs to stop.  So the robot is at rest before any member grants the lease to another
agent.

The states and transitions of the client are in ``client_states``; this module performs the actions.  ``clock`` should
be one that continues while the machine is suspended, if the system has such a clock.
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
from middleware.consensus.lease.lease_codec import EARLY_PROMISE_SHARE
from middleware.consensus.lease.lease_proposer import LeaseProposer
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError
from middleware.entangled.quorum.ballot import NO_BALLOT, Ballot, majority
from middleware.entangled.quorum.register import ReplyKind
from middleware.entangled.quorum.round import RETRY_INTERVAL_S, Round

CLOCK_MARGIN = 0.02
"""Maximum relative drift between the clocks of two correct nodes, each of which drifts by at most 1 %."""
RENEWALS_PER_TTL = 3
"""Number of renewals by a holder per ttl, and number of requests by a standby per ttl."""
RETRY_S = 0.1
JITTER_S = (0.0, 0.02)
BACK_OFF_S = (0.02, 0.08)
"""Minimum and maximum seconds before the next attempt after the claim of another agent was faster."""
SOON_PERIODS = 1.5
"""A lease that ends within this number of poll periods is claimed at its end without another poll."""
RELEASE_SPREAD_S = 0.3
"""Seconds after a notification of a release for which some members may not know of the release yet."""
FIRST_STANDBY_SHARE = 0.8
"""Share of the time for early promises (``EARLY_PROMISE_SHARE``) that remains when the first standby requests promises.
It is below 1, so that members accept the request even if the estimated end of the lease is slightly wrong."""
GRANT_LEAD_S = 0.1
"""Seconds before the end of a lease at which the next grant is requested, so that there is time for a retry.  Members
delay their reply to an early request."""
STAGGER_S = 0.2
"""Additional seconds that each standby waits, compared with the standby of the next lower rank."""
LATE_TIMER_S = 0.05
"""If a timer is late by at least this number of seconds, the process may have been suspended."""


@dataclass(frozen=True)
class Lease:
    """The right to act on a task until ``deadline`` (seconds of the client's clock)."""

    task_id: str
    token: int
    deadline: float


@dataclass
class _HeldLease:
    """The last granted lease: its token (0: none), deadline and ballot."""

    token: int = 0
    deadline: float = 0.0
    ballot: Ballot = NO_BALLOT


@dataclass
class _Standby:
    """The client's ``rank`` among the standbys, and its estimates about the lease of another agent.

    If an agent released the lease, ``freed_at`` is the time from which its robot is at rest.  ``ends_at`` is the
    estimated end of the lease.  ``is_outbid`` is true if, in the last round, a member replied that it had promised a
    higher ballot.
    """

    rank: int = 0
    freed_at: float = -math.inf
    ends_at: float = -math.inf
    is_outbid: bool = False


class LeaseClient:
    """The claim of one agent to the task of ``proposer``.

    :param clock: a clock that continues while the machine is suspended
    :param rng: the source of random pauses
    :param changed: called when the lease is granted, renewed or lost
    :param stop_time: the time in seconds that the robot needs to stop
    """

    def __init__(
        self,
        proposer: LeaseProposer,
        clock: IReactorTime,
        rng: random.Random,
        on_change: Callable[[], None],
        stop_time: float = 0.0,
    ) -> None:
        self.task_id = proposer.task_id
        self.proposer = proposer
        self.late_timer_count = 0
        self.state = State.IDLE
        self._step_count = 0
        self._clock = clock
        self._rng = rng
        self._on_change = on_change
        self._stop_time = stop_time
        self._held = _HeldLease()
        self._claimed_ballot = NO_BALLOT
        self._at_rest_at = -math.inf
        self._standby = _Standby()
        self._round: Round | None = None
        self._timer: IDelayedCall | None = None
        self._due_at = 0.0

    @property
    def token(self) -> int:
        """The token of the current or last lease, 0 for none."""
        return self._held.token

    @property
    def is_over(self) -> bool:
        """Whether a majority has replied that the task has ended."""
        return self.state is State.OVER

    @property
    def lease(self) -> Lease | None:
        """The lease, or None if it is not held."""
        if self.token and self._clock.seconds() < self._held.deadline:
            return Lease(self.task_id, self.token, self._held.deadline)
        return None

    # -- calls of the agent -----------------------------------------------------------------------------------------

    def claim(self) -> None:
        """Claim the lease, retry until it is granted, and renew it."""
        self._set_rank(0)
        self._handle(Event.WANT)

    def stand_by(self, rank: int = 1) -> None:
        """Claim the lease when it is released or expires, lower ranks first; until then poll the council.

        If the client holds or claims the lease, only its rank changes.
        """
        self._set_rank(max(1, rank))
        self._handle(Event.STAND_BY)

    def suspect_holder(self) -> None:
        """Poll the council now, because the holder may have failed; this does not shorten the lease."""
        if not self._is_recently_released and self.lease is None:
            self._handle(Event.SUSPECT)

    def on_released(self, token: int, rest: float = 0.0) -> None:
        """Handle a notification that the lease with ``token`` was released.

        The robot of the former holder may move for ``rest`` more seconds.  The first standby requests promises
        immediately, so that only the grant remains to be requested when that robot is at rest.
        """
        self.proposer.note_token(token)
        if self.state in ACTIVE and self.lease is None:
            is_new = not self._is_recently_released
            self._standby.freed_at = self._standby.ends_at = self._clock.seconds() + rest
            if is_new:
                self._handle(Event.FREED)

    def on_higher_token(self, token: int) -> None:
        """Handle a token that a device has obeyed.

        Later claims use higher tokens, and a lease with a lower token is lost.
        """
        self.proposer.token = max(self.proposer.token, token)
        if 0 < self.token < token:
            self._handle(Event.OUTRANK)

    def release(self, heirs: Sequence[Contact] = (), rest: float = 0.0) -> Deferred[object]:
        """Release the lease, or stop claiming it; fire when the council has been notified.

        Stop the device first.  The council grants the next lease only when the robot is at rest: it waits for the
        robot's stop time, plus ``rest`` seconds if the robot cannot be stopped now.  The members notify the standbys;
        this client also notifies the standbys ``heirs`` directly, which is half a round trip faster.
        """
        done: Deferred[object] = succeed(None)
        if self.lease is not None:
            # The margin for clock drift is included, because a later release of another claim sends the remaining time
            # again.
            moving_s = (rest + self._stop_time) * (1.0 + CLOCK_MARGIN)
            self._at_rest_at = min(self._at_rest_at, self._clock.seconds() + moving_s)
        self._handle(Event.RELEASE)
        if self._held.ballot != NO_BALLOT:
            done = self._send_release(
                max(self._held.ballot, self._claimed_ballot), heirs
            )  # which also releases the lower ballot
        else:
            self._release_minority()
        self._held, self._claimed_ballot = _HeldLease(), NO_BALLOT
        return done

    def change_council(self, members: Sequence[Contact]) -> Deferred[None]:
        """Change the council to ``members``; stop the device first.

        If this client holds the lease, the lease is released and reserved for this client, which claims it again at the
        new council.  Fails as ``LeaseProposer.change_members`` does; then the lease is claimed again at the old
        council.
        """
        return Deferred.fromCoroutine(self._change_council(members))

    def close_task(self, token: int) -> Deferred[bytes]:
        """Close the task, which ended under ``token``, so that no more leases are granted; stop the device first.

        If the client has a higher token, that token is used.  Fires with the proof of the end, signed by a majority of
        the council; fails as ``LeaseProposer.close`` does.
        """
        return self.proposer.close(max(token, self.token)).addCallback(lambda _: self.proposer.end_proof)

    async def _change_council(self, members: Sequence[Contact]) -> None:
        self._handle(Event.MOVE)
        if self.lease is not None:
            self._held.token, self._held.deadline = 0, 0.0
            moving_s = self._stop_time * (1.0 + CLOCK_MARGIN)
            self._at_rest_at = self._clock.seconds() + moving_s
            await deferLater(self._clock, moving_s)
        try:
            await self.proposer.change_members(members, keep=True)
        except Exception:  # not BaseException: GeneratorExit is raised when the coroutine is garbage-collected
            self._handle(Event.MOVED)
            raise
        self._handle(Event.MOVED)

    def _set_rank(self, rank: int) -> None:
        """Set the rank among the standbys, and adjust the time of a scheduled claim."""
        before, self._standby.rank = self._compute_stagger(), rank
        if self._compute_stagger() != before and self.lease is None and not self._is_recently_released:
            self._handle(Event.RANK)

    # -- transitions ------------------------------------------------------------------------------------------------

    def _handle(self, event: Event, round_: Round | None = None, delay: float = 0.0) -> None:
        """Go to the next state and perform the actions.

        :param round_: the round that led to the event, if any
        :param delay: seconds until the timer fires, for actions that set it to a given delay
        """
        self.state, actions = next_step(self.state, event)
        self._step_count = step = self._step_count + 1
        for action in actions:
            if self._step_count == step:  # otherwise the callback has caused another transition
                self._perform(action, round_, delay)

    def _perform(self, action: Action, round_: Round | None, delay: float) -> None:
        match action:
            case Action.CANCEL:
                self._cancel()
            case Action.LOOK:
                self._poll()
            case Action.PREPARE:
                self._prepare()
            case Action.PROPOSE:
                self._propose(self._claimed_ballot, self._choose_token())
            case Action.RENEW:
                self._cancel()
                self._propose(self._held.ballot, self.token)
            case Action.COMPLETE:
                assert round_ is not None
                completing = Deferred.fromCoroutine(self.proposer.complete_change(self._claimed_ballot, round_))
                completing.addErrback(lambda failure: failure.trap(EntangledError))
                completing.addBoth(lambda _: self._handle(Event.COMPLETED))
            case Action.LEAP:
                self.proposer.skip_ballots()
            case Action.LOSE:
                self._forget_lease()
            case Action.DROP:
                was_held = self.token != 0
                self._release_minority()
                if was_held:
                    self._send_release(self._held.ballot)
                    self._forget_lease()
            case Action.NOTIFY:
                self._on_change()
            case Action.LINE_UP if round_ is not None:
                self._schedule_from(round_)
            case Action.LINE_UP:
                self._schedule_claim(self._rng.uniform(*JITTER_S))
            case Action.AFTER_RANK:
                self._set_timer(self._standby.rank * self._poll_period)
            case Action.AFTER_POLL | Action.AFTER_WAIT | Action.AFTER_PREVIOUS:
                self._set_timer(delay)
            case Action.AFTER_TURN:
                self._set_timer(self._compute_turn_delay())
            case Action.AFTER_RENEWAL:
                self._set_timer(self._poll_period)
            case Action.AFTER_RETRY:
                self._set_timer(min(RETRY_S, self._held.deadline - self._clock.seconds()))
            case Action.AFTER_BACK_OFF:
                self._set_timer(self._rng.uniform(*BACK_OFF_S))

    # -- rounds -----------------------------------------------------------------------------------------------------

    def _poll(self) -> None:
        """Ask the council whether the lease is free, without requesting promises."""
        self._cancel()
        self._round = round_ = self.proposer.start_round("lease.prepare", 0, self.proposer.ttl, short=0.0)
        round_.outcome.addCallback(self._handle_poll, self.proposer.configuration)

    def _handle_poll(self, round_: Round, configuration: int) -> None:
        if not self._is_current_round(round_):
            return
        round_.close()
        if self.proposer.configuration != configuration:
            # Poll again, because only members of the newest council notify standbys of a release.
            self._handle(Event.RECONFIGURED)
        else:
            is_free = round_.tally.is_won and not self._compute_stagger()
            self._handle(Event.FREE if is_free else Event.TAKEN, round_)

    def _prepare(self) -> None:
        """Request promises; if the client holds the lease, it remains valid."""
        self._cancel()
        self._claimed_ballot = ballot = self.proposer.next_ballot()
        kinds = (ReplyKind.GRANTED, ReplyKind.SEALED)
        arguments = ballot.counter, self.proposer.ttl
        self._round = round_ = self.proposer.start_round(
            "lease.prepare", *arguments, kinds=kinds, short=self._max_wait_s
        )
        round_.outcome.addCallback(self._handle_promises, self.proposer.configuration)

    def _handle_promises(self, round_: Round, configuration: int) -> None:
        if not self._is_current_round(round_):
            return
        if self.proposer.configuration != configuration:
            return self._handle(Event.RECONFIGURED)
        if not round_.tally.is_won:
            return self._handle_failure(round_)
        round_.close()
        wait = round_.estimate_wait() - GRANT_LEAD_S if self.lease is None else 0.0
        if round_.tally.value_to_complete is not None:
            self._handle(Event.UNFINISHED, round_)
        elif wait > 0.0:
            # The previous lease is about to expire, or the robot of its former holder is about to stop.
            self._handle(Event.EARLY_PROMISES, delay=wait)
        else:
            self._handle(Event.PROMISES)

    def _choose_token(self) -> int:
        """Return the token to claim: the held token if no higher one was granted, otherwise a new highest token."""
        if self.lease is not None and self.token >= self.proposer.token:
            return self.token
        self.proposer.token += 1
        return self.proposer.token

    def _propose(self, ballot: Ballot, token: int) -> None:
        arguments = ballot.counter, token, self.proposer.ttl
        self._round = round_ = self.proposer.start_round("lease.propose", *arguments, short=self._max_wait_s)
        round_.outcome.addCallback(self._handle_grants, ballot, token)

    def _handle_grants(self, round_: Round, ballot: Ballot, token: int) -> None:
        if not self._is_current_round(round_):
            return
        deadline = self._compute_deadline(round_) if round_.tally.is_won else 0.0
        if deadline <= self._clock.seconds():
            return self._handle_failure(round_)
        self._held = _HeldLease(token, deadline, ballot)
        # The device measures the time until the deadline by its own clock, which may be slower than this client's.
        self._at_rest_at = deadline + self._stop_time + self.proposer.ttl * CLOCK_MARGIN
        # A member that may not grant leases yet does not require a new ballot.
        others = [
            reply for reply in round_.tally.replies.values() if reply.kind not in (ReplyKind.GRANTED, ReplyKind.QUIET)
        ]
        self._handle(Event.PARTIAL_GRANTS if others else Event.GRANTS)

    def _compute_deadline(self, won: Round) -> float:
        """Return the time, on this client's clock, by which the robot must be at rest."""
        return won.sent_at + self.proposer.ttl * (1.0 - CLOCK_MARGIN) - self._stop_time

    def _is_current_round(self, round_: Round) -> bool:
        """Learn from the replies of a round; return whether it is the newest round and the task has not ended."""
        self.proposer.learn_from(round_)
        if self._round is not round_:
            return False
        over = [reply for reply in round_.tally.replies.values() if reply.kind is ReplyKind.OVER]
        if len(over) >= majority(len(self.proposer.members)):
            self._handle(Event.ENDED)
        return not self.is_over

    def _handle_failure(self, round_: Round) -> None:
        round_.close()
        if self.lease is None:
            self._handle(Event.REJECTED, round_)
        else:
            # If a member has promised a higher ballot, the lease can be renewed with a new ballot before the deadline.
            is_outbid = any(reply.kind is ReplyKind.OUTBID for reply in round_.tally.replies.values())
            self._handle(Event.OUTBID if is_outbid else Event.KEPT)

    # -- times ------------------------------------------------------------------------------------------------------

    def _schedule_from(self, round_: Round) -> None:
        """Estimate the end of the lease from a round that failed, and set the timer."""
        is_outbid = any(reply.kind is ReplyKind.OUTBID for reply in round_.tally.replies.values())
        free_in = round_.estimate_wait()
        if is_outbid and free_in == math.inf:
            free_in = 0.0  # members that did not answer may answer a request with a higher ballot
        self._standby.ends_at, self._standby.is_outbid = self._clock.seconds() + free_in, is_outbid
        self._schedule_claim(self._rng.uniform(*(BACK_OFF_S if is_outbid else JITTER_S)))

    def _schedule_claim(self, pause: float) -> None:
        """Set the timer for the claim, or for a poll.

        If the time of the claim is far off or unknown, the client polls first, because a notification may be lost.
        """
        wait = self._compute_turn_delay() if self._is_recently_released else self._compute_claim_delay()
        # A holder without faults renews its lease well before the end. So if a lease is about to end, its holder has
        # probably failed, and the lease is claimed without a poll.
        is_far = wait > SOON_PERIODS * self._poll_period
        self._handle(Event.FAR if is_far else Event.NEAR, delay=(self._poll_period if is_far else wait) + pause)

    @property
    def _poll_period(self) -> float:
        return self.proposer.ttl / RENEWALS_PER_TTL

    def _compute_claim_delay(self) -> float:
        """Return the seconds until the claim of an expiring lease; the first standby claims before its end."""
        is_first = not (self._compute_stagger() or self._standby.is_outbid)
        lead = FIRST_STANDBY_SHARE * EARLY_PROMISE_SHARE * self.proposer.ttl if is_first else 0.0
        return max(0.0, self._standby.ends_at + self._compute_stagger() - lead - self._clock.seconds())

    def _compute_stagger(self) -> float:
        return STAGGER_S * max(0, self._standby.rank - 1)

    def _compute_turn_delay(self) -> float:
        """Return the seconds until the claim of a released lease; 0 for the first standby."""
        wait = self._compute_stagger()
        return wait and max(0.0, self._standby.freed_at - self._clock.seconds()) + wait

    @property
    def _is_recently_released(self) -> bool:
        """Whether the lease was released so recently that some members may not know of it."""
        return self._clock.seconds() < self._standby.freed_at + RELEASE_SPREAD_S

    @property
    def _max_wait_s(self) -> float:
        """Maximum remaining seconds of a lease whose end a round waits for; unlimited after a release."""
        return math.inf if self._is_recently_released else RETRY_INTERVAL_S

    def _handle_timer(self) -> None:
        """Handle the timer; if it is late, this process or machine may have been suspended."""
        self._timer = None
        self.late_timer_count += self._clock.seconds() - self._due_at > LATE_TIMER_S
        if self.state is State.PROMISED:
            self._handle(Event.DUE)
        elif self.token and self.lease is None:
            self._handle(Event.EXPIRED)
        elif self._is_recently_released and self.lease is None:
            self._handle(Event.DUE_FREED)
        else:
            self._handle(Event.DUE)

    def _set_timer(self, delay: float) -> None:
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._due_at = self._clock.seconds() + delay
        self._timer = self._clock.callLater(delay, self._handle_timer)

    def _cancel(self) -> None:
        """Cancel the running round and the timer."""
        if self._round is not None:
            self._round.close()
            self._round = None
        if self._timer is not None and self._timer.active():
            self._timer.cancel()
        self._timer = None

    # -- giving back ------------------------------------------------------------------------------------------------

    def _forget_lease(self) -> None:
        """Forget a lease that was not released, and notify the listener."""
        self._held = _HeldLease()
        self._on_change()

    def _send_release(self, ballot: Ballot, heirs: Sequence[Contact] = ()) -> Deferred[object]:
        """Release ``ballot`` at the council, and state the time for which the robot may still move."""
        rest = max(0.0, self._at_rest_at - self._clock.seconds())
        return self.proposer.release(ballot, heirs, rest * (1.0 + CLOCK_MARGIN))

    def _release_minority(self) -> None:
        """Release a claim that only a minority granted, so that it does not delay the claims of other agents."""
        if self._claimed_ballot not in (self._held.ballot, NO_BALLOT):
            self._send_release(self._claimed_ballot)
