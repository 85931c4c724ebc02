"""Round: one question to every member of a council, tried again where no answer comes, and what came of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IDelayedCall, IReactorTime

from middleware.commitment.ballot import HELD, Reply, quorum, reply_of
from middleware.entangled.kademlia.contact import Contact

TRIES = 3
"""How often a member is asked at least: a majority is enough, but who missed a renewal may promise to another."""
PAUSE = 0.1
"""Seconds between two tries with a member that has not answered (consensus rule 6)."""
NEWS = 0.03
"""Seconds after which a member is asked again that has not heard of a release yet."""
LEAST = 0.005
"""Seconds that pass at least until a member that is about to be free is asked again."""

Ask = Callable[[Contact, str, tuple[Any, ...]], Deferred[Any]]
"""Ask a council member: (member, method, arguments)."""


class Round:
    """``outcome`` fires with the round as soon as it is decided whether a majority answers with one of ``kinds``.

    A member where another's lease ends within ``short`` seconds is asked again then, or soon where that is long.
    An answer that is not genuine is none.  It also fires, undecided, when everybody answered or ``patience`` seconds
    have passed, and soon after a majority has answered.  A member that has not answered is asked every 100 ms until it
    is decided, and at least three times in all.
    """

    def __init__(
        self,
        members: Sequence[Contact],
        ask: Ask,
        clock: IReactorTime,
        method: str,
        arguments: tuple[Any, ...],
        kinds: tuple[str, ...],
        patience: float,
        short: float = PAUSE,
        is_genuine: Callable[[int, Reply], bool] = lambda place, reply: True,
    ) -> None:
        self.replies: dict[int, Reply] = {}
        self.outcome: Deferred[Round] = Deferred()
        self._members = members
        self._ask = ask
        self._clock = clock
        self._question = (method, arguments)
        self.kinds = kinds
        self._needed = quorum(len(members))
        self._patience = patience
        self._short = short
        self._is_genuine = is_genuine
        self._sent: dict[int, float] = {}
        self._heard: dict[int, tuple[float, float, float]] = {}
        self.began_at = clock.seconds()
        self._tries = 0
        self._is_closed = False
        self._timer: IDelayedCall | None = None
        self._end: IDelayedCall | None = clock.callLater(patience, self._ended)
        self._try()

    @property
    def is_open(self) -> bool:
        """Whether it still waits for what decides it."""
        return not self.outcome.called and not self._is_closed

    @property
    def is_won(self) -> bool:
        """Whether a majority has said yes."""
        return len(self.yes) >= self._needed > 0

    @property
    def yes(self) -> list[int]:
        """The places of those that said yes."""
        return [place for place, reply in self.replies.items() if reply.kind in self.kinds]

    @property
    def answered(self) -> list[Contact]:
        """The members that have answered."""
        return [self._members[place] for place in self._heard]

    @property
    def silent(self) -> list[Contact]:
        """The members that have not answered, though they were asked as often as a question is put."""
        asked = self._members if self._tries >= TRIES else ()
        return [member for place, member in enumerate(asked) if place not in self._heard]

    @property
    def sent_at(self) -> float:
        """The moment from which a majority counts its grants at the earliest: the question was sent by then."""
        moments = sorted((self._sent[place] for place in self.yes), reverse=True)
        return moments[self._needed - 1]

    def close(self) -> None:
        """Ask nobody any more and wait for nothing."""
        self._is_closed = True
        for timer in (self._timer, self._end):
            if timer is not None and timer.active():
                timer.cancel()

    def free_in(self, share: float = 0.5) -> float:
        """Seconds until a majority may be free to say yes, as far as its members told.

        A member counted somewhere between question and answer: after ``share`` of the time is the guess.
        """
        free_at = {p: sent + share * (heard - sent) + left for p, (sent, heard, left) in self._heard.items()}
        # Of who did not answer nothing is known; where nobody answered, nothing is known against asking at once.
        unknown = math.inf if self.replies else -math.inf
        waits = sorted(free_at.get(place, unknown) for place in range(len(self._members)))
        return max(0.0, waits[self._needed - 1] - self._clock.seconds()) if waits else 0.0

    def _try(self) -> None:
        self._tries += 1
        if self._tries < TRIES or not self.outcome.called:
            self._timer = self._clock.callLater(PAUSE, self._try)
        for place in range(len(self._members)):
            self._ask_one(place)
        if not self._members:
            self._ended()

    def _ask_one(self, place: int) -> None:
        if place not in self.replies and not self._is_closed:
            asked = self._ask(self._members[place], *self._question)
            asked.addBoth(self._answered, place, self._clock.seconds())

    def _answered(self, answer: object, place: int, sent: float) -> None:
        """Take in the answer of one member; its silence (a Failure) and what is no answer count for nothing."""
        reply = reply_of(answer)
        if self._is_closed or reply is None or place in self.replies or not self._is_genuine(place, reply):
            return
        self._heard[place] = sent, self._clock.seconds(), reply.remaining
        if reply.kind == HELD and reply.remaining < self._short:
            pause = reply.remaining if reply.remaining < PAUSE else NEWS
            self._clock.callLater(max(LEAST, pause), self._ask_one, place)
            return
        self.replies[place], self._sent[place] = reply, sent
        if len(self.replies) == len(self._members):
            self.close()
        no = len(self.replies) - len(self.yes)
        if self.is_won or len(self._members) - no < self._needed or self._is_closed:
            self._decided()
        elif len(self.replies) == self._needed and not self.outcome.called:
            # The rest decides it; whoever is down must not hold up a claimant whom another one was faster than.
            if self._end is not None and self._end.active():
                self._end.cancel()
            self._end = self._clock.callLater(min(PAUSE, self._patience), self._ended)

    def _ended(self) -> None:
        self.close()
        self._decided()

    def _decided(self) -> None:
        if not self.outcome.called:
            self.outcome.callback(self)
