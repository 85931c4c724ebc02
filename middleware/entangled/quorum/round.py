"""A round: one request to all members of a quorum, and the replies of a majority."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IDelayedCall, IReactorTime
from twisted.python.failure import Failure

from middleware.entangled.quorum.ballot import NO_BALLOT, majority
from middleware.entangled.quorum.register import Reply, ReplyKind

MIN_TRIES = 3
"""The minimum number of requests to a silent member.  A majority would be enough for the round, but a member that
missed a renewal may promise to another proposer."""
RETRY_INTERVAL_S = 0.1
"""Seconds between two requests to a member that has not answered."""
NEWS_INTERVAL_S = 0.03
"""Seconds before the next request to a member that has not received a release yet."""
MIN_PAUSE_S = 0.005
"""Minimum seconds before the next request to a member with a lease about to expire."""

Decode = Callable[[int, object], "Sequence[Reply | None] | None"]
"""Called with a member's place (its index) and answer; returns one reply per tally, or None if the answer is
invalid."""


class Tally:
    """The replies of a quorum of ``size`` members about one register; replies of these ``kinds`` agree to the request.

    The *place* of a member is its index in the list of members.
    """

    def __init__(self, size: int, kinds: tuple[ReplyKind, ...] = (ReplyKind.GRANTED,)) -> None:
        self.replies: dict[int, Reply] = {}
        self.kinds = kinds
        self.size = size
        self._unreachable: set[int] = set()
        self.needed = majority(size)  # Q1: two majorities share a member

    def add(self, place: int, reply: Reply | None) -> None:
        """Add the reply of one member, None if it is unreachable; each member is counted once (Q1)."""
        if reply is None:
            self._unreachable.add(place)
        else:
            self.replies[place] = reply

    @property
    def agreeing_places(self) -> list[int]:
        """The places of the agreeing members."""
        return [place for place, reply in self.replies.items() if reply.kind in self.kinds]

    @property
    def is_won(self) -> bool:
        """Whether a majority agrees."""
        return len(self.agreeing_places) >= self.needed > 0

    @property
    def is_lost(self) -> bool:
        """Whether a majority can no longer agree."""
        return self.size - len(self._unreachable | self.replies.keys()) + len(self.agreeing_places) < self.needed

    @property
    def chosen_value(self) -> Any:
        """The value that a majority accepted under one ballot; None if there is none."""
        accepted = Counter(reply.accepted for reply in self.replies.values() if reply.accepted != NO_BALLOT)
        ballot, count = max(accepted.items(), key=lambda item: item[1], default=(NO_BALLOT, 0))
        if count < self.needed:  # A3: a majority chooses the value
            return None
        return next(reply.value for reply in self.replies.values() if reply.accepted == ballot)

    @property
    def value_to_complete(self) -> Any:
        """The value that must be proposed: accepted under the highest ballot among agreeing members; or None."""
        accepted = [reply for place in self.agreeing_places if (reply := self.replies[place]).accepted != NO_BALLOT]
        return max(accepted, key=lambda reply: reply.accepted).value if accepted else None  # A2: the highest

    @property
    def is_decided(self) -> bool:
        """Whether no further reply can change the result."""
        return self.is_won or self.is_lost or self.chosen_value is not None


class Round:
    """One request to all members; ``outcome`` fires with this round as soon as each of its ``tallies`` is decided.

    ``ask`` sends the request to the member at a place.  If a member replies that another proposer's lease ends within
    ``short`` seconds, the request is repeated at the end of that lease, or earlier if the end is far off.  ``outcome``
    also fires, undecided, when all members have answered, after ``timeout_s`` seconds, and shortly after a majority has
    answered.  A silent member is asked every ``RETRY_INTERVAL_S`` seconds until the round is decided, and at least
    ``MIN_TRIES`` times.  With ``single`` the round sends each member one request, which the transport retransmits; a
    failed request is treated as the member's answer.
    """

    def __init__(
        self,
        tallies: Sequence[Tally],
        ask: Callable[[int], Deferred[Any]],
        decode: Decode,
        clock: IReactorTime,
        timeout_s: float = math.inf,
        short: float = RETRY_INTERVAL_S,
        single: bool = False,
    ) -> None:
        self.tallies = tallies
        self.outcome: Deferred[Round] = Deferred()
        self.began_at = clock.seconds()
        self._ask = ask
        self._decode = decode
        self._clock = clock
        self._patience = timeout_s
        self._short_s = short
        self._single = single
        self._sent_times: dict[int, float] = {}
        self._answer_times: dict[int, tuple[float, float, float]] = {}
        self._attempts = 0
        self._is_closed = False
        self._timer: IDelayedCall | None = None
        self._end_timer: IDelayedCall | None = (
            None if math.isinf(timeout_s) else clock.callLater(timeout_s, self._finish)
        )
        self._send_requests()

    @property
    def tally(self) -> Tally:
        """The first tally, the only one of most rounds."""
        return self.tallies[0]

    @property
    def is_open(self) -> bool:
        """Whether the round still waits for replies."""
        return not self.outcome.called and not self._is_closed

    @property
    def answered_places(self) -> list[int]:
        """The places of the members that have answered."""
        return list(self._answer_times)

    @property
    def silent_places(self) -> list[int]:
        """The places of the members that have not answered after ``MIN_TRIES`` requests."""
        return [
            place for place in range(self.tally.size) if place not in self._answer_times and self._attempts >= MIN_TRIES
        ]

    @property
    def sent_at(self) -> float:
        """The time when the request to a majority was sent; the grants of this majority do not start earlier (L5)."""
        times = sorted((self._sent_times[place] for place in self.tally.agreeing_places), reverse=True)
        return times[self.tally.needed - 1]

    def close(self) -> None:
        """Stop all requests and timers."""
        self._is_closed = True
        for timer in (self._timer, self._end_timer):
            if timer is not None and timer.active():
                timer.cancel()

    def estimate_wait(self) -> float:
        """Return the estimated seconds until a majority may be free to agree.

        A member is assumed to have replied half way between the request and the arrival of the reply.
        """
        free_at = {p: (sent + received) / 2 + left for p, (sent, received, left) in self._answer_times.items()}
        # Silent members are not counted as free, unless all members are silent: then ask again immediately.
        unknown = math.inf if self.tally.replies else -math.inf
        waits = sorted(free_at.get(place, unknown) for place in range(self.tally.size))
        return max(0.0, waits[self.tally.needed - 1] - self._clock.seconds()) if waits else 0.0

    def _send_requests(self) -> None:
        self._attempts += 1
        if not self._single and (self._attempts < MIN_TRIES or not self.outcome.called):
            self._timer = self._clock.callLater(RETRY_INTERVAL_S, self._send_requests)
        for place in range(self.tally.size):
            self._send_request(place)
        if not self.tally.size:
            self._finish()

    def _send_request(self, place: int) -> None:
        if place not in self._sent_times and not self._is_closed:
            self._ask(place).addBoth(self._handle_answer, place, self._clock.seconds())

    def _handle_answer(self, answer: object, place: int, sent: float) -> None:
        """Process the answer of one member; ignore a late or repeated one."""
        if self._is_closed or place in self._sent_times:
            return
        replies = None if isinstance(answer, Failure) else self._decode(place, answer)
        if replies is None:
            if not self._single:
                return
            replies = [None] * len(self.tallies)
        reply = replies[0]
        if reply is not None:
            self._answer_times[place] = sent, self._clock.seconds(), reply.remaining
            if reply.kind is ReplyKind.HELD and reply.remaining < self._short_s:
                pause = reply.remaining if reply.remaining < RETRY_INTERVAL_S else NEWS_INTERVAL_S
                self._clock.callLater(max(MIN_PAUSE_S, pause), self._send_request, place)
                return
        self._sent_times[place] = sent
        for tally, each in zip(self.tallies, replies, strict=True):
            tally.add(place, each)
        if len(self._sent_times) == self.tally.size:
            self.close()
        if self._is_closed or all(tally.is_decided for tally in self.tallies):
            self._fire_outcome()
        elif len(self._sent_times) == self.tally.needed and not self._single and not self.outcome.called:
            # The answers of the other members decide; a member that is down must not delay a proposer that lost.
            if self._end_timer is not None and self._end_timer.active():
                self._end_timer.cancel()
            self._end_timer = self._clock.callLater(min(RETRY_INTERVAL_S, self._patience), self._finish)

    def _finish(self) -> None:
        self.close()
        self._fire_outcome()

    def _fire_outcome(self) -> None:
        if not self.outcome.called:
            self.outcome.callback(self)
