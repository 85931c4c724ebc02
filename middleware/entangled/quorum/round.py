"""A round: one question to every member of a quorum, and what a majority answers."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IDelayedCall, IReactorTime
from twisted.python.failure import Failure

from middleware.entangled.quorum.ballot import NONE, majority
from middleware.entangled.quorum.register import Kind, Reply

TRIES = 3
"""How often a member is asked at least: a majority is enough, but a member that missed an extension may promise to
another."""
PAUSE = 0.1
"""Seconds between two tries with a member that has not answered."""
NEWS = 0.03
"""Seconds after which a member is asked again that has not heard of a release yet."""
LEAST = 0.005
"""Seconds that pass at least until a member that is about to be free is asked again."""

Decode = Callable[[int, object], "Sequence[Reply | None] | None"]
"""Makes the replies of a member, one for each tally, of what it sent: (place, answer); None where it is no answer."""


class Tally:
    """The answers of a quorum of ``size`` members about one register; those of ``kinds`` agree."""

    def __init__(self, size: int, kinds: tuple[Kind, ...] = (Kind.GRANTED,)) -> None:
        self.replies: dict[int, Reply] = {}
        self.kinds = kinds
        self.size = size
        self._lost: set[int] = set()
        self.needed = majority(size)  # Q1

    def add(self, place: int, reply: Reply | None) -> None:
        """Count the answer of one member, which counts once (Q1); None for a member that cannot be heard."""
        if reply is None:
            self._lost.add(place)
        else:
            self.replies[place] = reply

    @property
    def agreed(self) -> list[int]:
        """The places of the members that agree."""
        return [place for place, reply in self.replies.items() if reply.kind in self.kinds]

    @property
    def is_won(self) -> bool:
        """Whether a majority agrees."""
        return len(self.agreed) >= self.needed > 0

    @property
    def is_lost(self) -> bool:
        """Whether no majority can agree any more."""
        return self.size - len(self._lost | self.replies.keys()) + len(self.agreed) < self.needed

    @property
    def chosen(self) -> Any:
        """The value that is decided: a majority accepted it under one ballot; None where none is known to be."""
        accepted = Counter(reply.accepted for reply in self.replies.values() if reply.accepted != NONE)
        ballot, count = max(accepted.items(), key=lambda item: item[1], default=(NONE, 0))
        if count < self.needed:  # A3
            return None
        return next(reply.value for reply in self.replies.values() if reply.accepted == ballot)

    @property
    def to_complete(self) -> Any:
        """The value that has to be proposed, of the highest ballot accepted among those that agree; or None."""
        accepted = [reply for place in self.agreed if (reply := self.replies[place]).accepted != NONE]
        return max(accepted, key=lambda reply: reply.accepted).value if accepted else None  # A2

    @property
    def is_decided(self) -> bool:
        """Whether no other answer can turn it."""
        return self.is_won or self.is_lost or self.chosen is not None


class Round:
    """``outcome`` fires with the round as soon as each of its ``tallies`` is decided.

    ``ask`` asks the member of a place.  A member where another's lease ends within ``short`` seconds is asked again
    then, or soon where that is long.  ``outcome`` also fires, undecided, when all answered or ``patience`` seconds have
    passed, and soon after a majority has answered.  A silent member is asked every ``PAUSE`` seconds until the
    round is decided, and at least ``TRIES`` times; or, where it is ``single``, once: then the transport asks again, and
    its failure is the answer.
    """

    def __init__(
        self,
        tallies: Sequence[Tally],
        ask: Callable[[int], Deferred[Any]],
        decode: Decode,
        clock: IReactorTime,
        patience: float = math.inf,
        short: float = PAUSE,
        single: bool = False,
    ) -> None:
        self.tallies = tallies
        self.outcome: Deferred[Round] = Deferred()
        self.began_at = clock.seconds()
        self._ask = ask
        self._decode = decode
        self._clock = clock
        self._patience = patience
        self._short = short
        self._single = single
        self._sent: dict[int, float] = {}
        self._heard: dict[int, tuple[float, float, float]] = {}
        self._tries = 0
        self._is_closed = False
        self._timer: IDelayedCall | None = None
        self._end: IDelayedCall | None = None if math.isinf(patience) else clock.callLater(patience, self._ended)
        self._try()

    @property
    def tally(self) -> Tally:
        """The only tally, where there is one."""
        return self.tallies[0]

    @property
    def is_open(self) -> bool:
        """Whether it still waits for what decides it."""
        return not self.outcome.called and not self._is_closed

    @property
    def answered(self) -> list[int]:
        """The places of the members that have answered."""
        return list(self._heard)

    @property
    def silent(self) -> list[int]:
        """The places that have not answered, though they were asked as often as a question is put."""
        return [place for place in range(self.tally.size) if place not in self._heard and self._tries >= TRIES]

    @property
    def sent_at(self) -> float:
        """The moment from which a majority counts its grants at the earliest: the question was sent by then (L5)."""
        moments = sorted((self._sent[place] for place in self.tally.agreed), reverse=True)
        return moments[self.tally.needed - 1]

    def close(self) -> None:
        """Ask nobody any more and wait for nothing."""
        self._is_closed = True
        for timer in (self._timer, self._end):
            if timer is not None and timer.active():
                timer.cancel()

    def free_in(self) -> float:
        """Seconds until a majority may be free to agree, as far as its members told.

        A member counted somewhere between question and answer: half way is the guess.
        """
        free_at = {p: (sent + heard) / 2 + left for p, (sent, heard, left) in self._heard.items()}
        # Of a silent member nothing is known; where all are silent, nothing is known against asking at once.
        unknown = math.inf if self.tally.replies else -math.inf
        waits = sorted(free_at.get(place, unknown) for place in range(self.tally.size))
        return max(0.0, waits[self.tally.needed - 1] - self._clock.seconds()) if waits else 0.0

    def _try(self) -> None:
        self._tries += 1
        if not self._single and (self._tries < TRIES or not self.outcome.called):
            self._timer = self._clock.callLater(PAUSE, self._try)
        for place in range(self.tally.size):
            self._ask_one(place)
        if not self.tally.size:
            self._ended()

    def _ask_one(self, place: int) -> None:
        if place not in self._sent and not self._is_closed:
            self._ask(place).addBoth(self._answered, place, self._clock.seconds())

    def _answered(self, answer: object, place: int, sent: float) -> None:
        """Take in the answer of one member; one that comes late, or twice, counts for nothing."""
        if self._is_closed or place in self._sent:
            return
        replies = None if isinstance(answer, Failure) else self._decode(place, answer)
        if replies is None:
            if not self._single:
                return
            replies = [None] * len(self.tallies)
        reply = replies[0]
        if reply is not None:
            self._heard[place] = sent, self._clock.seconds(), reply.remaining
            if reply.kind is Kind.HELD and reply.remaining < self._short:
                pause = reply.remaining if reply.remaining < PAUSE else NEWS
                self._clock.callLater(max(LEAST, pause), self._ask_one, place)
                return
        self._sent[place] = sent
        for tally, each in zip(self.tallies, replies, strict=True):
            tally.add(place, each)
        if len(self._sent) == self.tally.size:
            self.close()
        if self._is_closed or all(tally.is_decided for tally in self.tallies):
            self._decided()
        elif len(self._sent) == self.tally.needed and not self._single and not self.outcome.called:
            # The rest decides it; a member that is down must not hold up a proposer that another was faster than.
            if self._end is not None and self._end.active():
                self._end.cancel()
            self._end = self._clock.callLater(min(PAUSE, self._patience), self._ended)

    def _ended(self) -> None:
        self.close()
        self._decided()

    def _decided(self) -> None:
        if not self.outcome.called:
            self.outcome.callback(self)
