"""Discovery: how a node finds its team on the LAN when it was told no address, and halves of a team find each other.

A node calls WHO into the group of the LAN, often while it is alone and seldom in company; some of those who hear it
answer from their own port after a random moment, and whoever answers is greeted at its address, which proves that it
is of the team.  Who hears a call answers with a probability that falls with the number of members and callers that it
knows of, so that about ``ANSWERS`` come back however large the team is, also when all of it starts at one moment.
"""

from __future__ import annotations

import hashlib
import random
from collections import Counter, deque

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background
from middleware.entangled.bounded import keep
from middleware.entangled.errors import EntangledError
from middleware.entangled.kademlia.membership import Membership
from middleware.entangled.kademlia.overlay import Overlay
from middleware.entangled.network.multicast import Multicast
from middleware.entangled.network.network import Address
from middleware.entangled.wire.endpoint import Endpoint
from middleware.entangled.wire.greeting import HERE, WHO
from middleware.entangled.wire.hail import HAIL

ANSWERS = 4
"""Answers to one call, on the average, where more than so many could answer."""
MOMENT = 0.1
"""Seconds until an answer at most, and those before a node's first call: five times less."""
ALONE = (0.2, 0.3, 0.5, 1.0, 2.0, 5.0)
"""Seconds between the calls of a node that knows nobody; the last one stays."""
IN_COMPANY = 30.0
"""Seconds between two calls of all members of a team together: each waits so long for each that it knows."""
LONGEST = 900.0
LISTEN = 0.8
"""Seconds for which a node without known nodes listens before it takes itself for the first of its network."""
RECENT = 2.0
AGAIN = 4.0
"""Seconds before the same address is greeted again."""
AT_ONCE = 3
"""Addresses that are greeted at the same time; who answers first names the others of its network."""
MAX_PENDING = 64
"""Answers that are put off at the same time, and so in ``MOMENT``."""
MAX_HEARD = 256


class Discovery:
    """One node's place in the group of its LAN.

    ``counters`` counts the calls, those heard (of the team), answered and left to others, those that are not of the
    team (foreign), came before (repeated) or were too many (crowded), and the addresses that were greeted.
    """

    def __init__(
        self,
        group: Multicast,
        endpoint: Endpoint,
        overlay: Overlay,
        membership: Membership,
        clock: IReactorTime,
        rng: random.Random,
        chores: Background,
    ) -> None:
        self.counters: Counter[str] = Counter()
        self._group = group
        self._endpoint = endpoint
        self._overlay = overlay
        self._membership = membership
        self._clock = clock
        self._rng = rng
        self._chores = chores
        self._tries = 0
        self._due = 0.0
        self._called = b""
        self._not_again = lambda: None
        self._heard: dict[bytes, None] = {}
        self._callers: deque[float] = deque(maxlen=MAX_HEARD)
        self._pending = 0
        self._greeted_at: dict[Address, float] = {}
        self._greeting = 0
        self._waiting: list[Deferred[None]] = []

    def start(self) -> None:
        """Join the group and call."""
        self._group.listen(self._received, self._moved)
        # A team that gets its power from one switch does not call at one moment.
        self._not_again = self._chores.later(self._rng.random() * MOMENT / 5, self._turn)

    def stop(self) -> None:
        """Leave the group."""
        self._group.close()

    def first(self) -> Deferred[None]:
        """Fire when one of the team was found, or nobody was for ``LISTEN`` seconds."""
        found: Deferred[None] = Deferred()
        if self._overlay.contacts():
            found.callback(None)
        else:
            self._waiting.append(found)
            self._chores.later(LISTEN, self._waited)
        return found

    # -- calling ----------------------------------------------------------------------------------------------------

    def _turn(self) -> None:
        """Call if it is time; the next turn is soon enough for one that lost its whole team since."""
        company = len(self._overlay.contacts())
        now, wait = self._clock.seconds(), ALONE[-1]
        if company == 0:
            wait = ALONE[min(self._tries, len(ALONE) - 1)]
            self._tries += 1
            self._call()
        elif self._tries or now >= self._due:
            if not self._tries:  # else it has called just before it found them
                self._call()
            self._tries = 0
            self._due = now + min(LONGEST, IN_COMPANY * (company + 1)) * self._about()
        self._not_again = self._chores.later(wait * self._about(), self._turn)

    def _call(self) -> None:
        self.counters["calls"] += 1
        self._called = self._endpoint.greeter.call()
        self._group.send(self._called)

    def _moved(self) -> None:
        self._not_again()
        self._due, self._tries = 0.0, 0
        self._turn()  # calls, in company as well

    def _about(self) -> float:
        return 0.75 + self._rng.random() / 2

    def _answered(self, source: Address) -> None:
        """Greet who answered a call, unless it is known."""
        now, overlay = self._clock.seconds(), self._overlay
        # Who came to us first has told us nothing of the others yet.
        if (overlay.is_whole or overlay.is_large) and any(known.address == source for known in overlay.contacts()):
            return
        if self._greeting >= AT_ONCE or now - self._greeted_at.get(source, -AGAIN) < AGAIN:
            return
        if len(self._greeted_at) >= MAX_HEARD:
            self._greeted_at.clear()
        self._greeted_at[source] = now
        self._greeting += 1
        self.counters["greeted"] += 1
        self._chores.fork(self._meet(source))

    async def _meet(self, address: Address) -> None:
        try:
            if await self._membership.meet(address):
                self._waited()
        except EntangledError:
            # A port that was somebody's a moment ago, or somebody who only listens to the team's calls.
            self.counters["unmet"] += 1
        finally:
            self._greeting -= 1

    def _waited(self) -> None:
        waiting, self._waiting = self._waiting, []
        for found in waiting:
            found.callback(None)

    # -- being called -----------------------------------------------------------------------------------------------

    def _received(self, datagram: bytes, source: Address) -> None:
        kind = datagram[0] if datagram else 0
        if kind == HERE:
            self._answered(source)
        elif kind in (WHO, HAIL) and datagram != self._called:
            self._overheard(datagram, source)

    def _overheard(self, datagram: bytes, source: Address) -> None:
        digest = hashlib.blake2s(datagram, digest_size=8).digest()
        if digest in self._heard:  # it comes once by each interface that both share; or it is a recording
            self.counters["repeated"] += 1
            return
        if datagram[0] == WHO:
            if not self._endpoint.greeter.opens(datagram):
                self.counters["foreign"] += 1
                return
            self._callers.append(self._clock.seconds())
        self.counters["heard"] += 1
        keep(self._heard, digest, None, MAX_HEARD)
        if self._pending >= MAX_PENDING:
            self.counters["crowded"] += 1
            return
        self._pending += 1
        self._chores.later(self._rng.random() * MOMENT, self._answer, datagram, source)

    def _answer(self, datagram: bytes, source: Address) -> None:
        """Answer a call, or leave it to the others; by now those who called at the same moment were heard."""
        self._pending -= 1
        since = self._clock.seconds() - RECENT
        callers = sum(1 for moment in self._callers if moment > since)
        if self._rng.random() * max(callers, 1 + len(self._overlay.contacts())) < ANSWERS:
            self.counters["answered"] += 1
            self._endpoint.overhear(datagram, source)
        else:
            self.counters["left"] += 1
