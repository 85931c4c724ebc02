"""Discover nodes of the team on the LAN without a configured address, and merge separate parts of a team.

A node multicasts WHO to the LAN, often while it has no contacts and rarely afterwards; some receivers reply from their
own port after a random delay, and the node then sends a discovery request to each reply's address, which proves its
membership.  A receiver replies with a probability that decreases with the number of members and senders that it knows,
so that about ``ANSWERS`` replies are sent in a team of any size, even if all nodes start at the same moment.
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
"""The mean number of replies to one WHO, if more nodes could reply."""
MOMENT = 0.1
"""The maximum delay of a reply in seconds; the first WHO of a node is delayed by up to a fifth of it."""
ALONE = (0.2, 0.3, 0.5, 1.0, 2.0, 5.0)
"""The seconds between the multicasts of a node without contacts; the last one repeats."""
IN_COMPANY = 30.0
"""The mean seconds between two multicasts of all members together: each node waits this long per member."""
LONGEST = 900.0
LISTEN = 0.8
"""The seconds after which a node without known nodes and without replies considers itself the first of its network."""
RECENT = 2.0
AGAIN = 4.0
"""The seconds before a discovery request to the same address is repeated."""
AT_ONCE = 3
"""The number of simultaneous discovery requests; the first node to answer names the others of its network."""
MAX_PENDING = 64
"""The number of delayed replies, and so of replies within ``MOMENT``."""
MAX_HEARD = 256


class Discovery:
    """One node's discovery on its LAN.

    ``counters`` counts the multicasts sent (calls), received from the team (heard), answered and not answered (left);
    the datagrams of other teams (foreign), duplicates (repeated) and surplus ones (crowded); and the addresses that got
    a discovery request (greeted).
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
        self._cancel_turn = lambda: None
        self._heard: dict[bytes, None] = {}
        self._callers: deque[float] = deque(maxlen=MAX_HEARD)
        self._pending = 0
        self._greeted_at: dict[Address, float] = {}
        self._greeting = 0
        self._waiting: list[Deferred[None]] = []

    def start(self) -> None:
        """Join the multicast group and send the first WHO."""
        self._group.listen(self._received, self._moved)
        # The nodes of a team that are switched on together do not multicast at the same moment.
        self._cancel_turn = self._chores.later(self._rng.random() * MOMENT / 5, self._turn)

    def stop(self) -> None:
        """Leave the multicast group."""
        self._group.close()

    def first(self) -> Deferred[None]:
        """Return a Deferred that fires when a node of the team was found, or after ``LISTEN`` seconds."""
        found: Deferred[None] = Deferred()
        if self._overlay.contacts():
            found.callback(None)
        else:
            self._waiting.append(found)
            self._chores.later(LISTEN, self._fire_waiting)
        return found

    # -- sending ----------------------------------------------------------------------------------------------------

    def _turn(self) -> None:
        """Multicast if it is due; the interval also suits a node that lost all its contacts meanwhile."""
        company = len(self._overlay.contacts())
        now, wait = self._clock.seconds(), ALONE[-1]
        if company == 0:
            wait = ALONE[min(self._tries, len(ALONE) - 1)]
            self._tries += 1
            self._call()
        elif self._tries or now >= self._due:
            if not self._tries:  # otherwise it multicast just before it found them
                self._call()
            self._tries = 0
            self._due = now + min(LONGEST, IN_COMPANY * (company + 1)) * self._draw_factor()
        self._cancel_turn = self._chores.later(wait * self._draw_factor(), self._turn)

    def _call(self) -> None:
        self.counters["calls"] += 1
        self._called = self._endpoint.greeter.call()
        self._group.send(self._called)

    def _moved(self) -> None:
        self._cancel_turn()
        self._due, self._tries = 0.0, 0
        self._turn()  # multicasts, even with contacts

    def _draw_factor(self) -> float:
        return 0.75 + self._rng.random() / 2

    def _on_reply(self, source: Address) -> None:
        """Send a discovery request to the source of a reply, unless it is a known contact."""
        now, overlay = self._clock.seconds(), self._overlay
        # The first contact may not have named the other members yet.
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
                self._fire_waiting()
        except EntangledError:
            # The node may have left the port, or it only listens to the multicasts of the team.
            self.counters["unmet"] += 1
        finally:
            self._greeting -= 1

    def _fire_waiting(self) -> None:
        waiting, self._waiting = self._waiting, []
        for found in waiting:
            found.callback(None)

    # -- receiving --------------------------------------------------------------------------------------------------

    def _received(self, datagram: bytes, source: Address) -> None:
        kind = datagram[0] if datagram else 0
        if kind == HERE:
            self._on_reply(source)
        elif kind in (WHO, HAIL) and datagram != self._called:
            self._on_request(datagram, source)

    def _on_request(self, datagram: bytes, source: Address) -> None:
        digest = hashlib.blake2s(datagram, digest_size=8).digest()
        if digest in self._heard:  # a duplicate from another interface of the same LAN, or a replay
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
        """Reply to a WHO, or leave it to other nodes; simultaneous senders are counted by now."""
        self._pending -= 1
        since = self._clock.seconds() - RECENT
        callers = sum(1 for moment in self._callers if moment > since)
        if self._rng.random() * max(callers, 1 + len(self._overlay.contacts())) < ANSWERS:
            self.counters["answered"] += 1
            self._endpoint.overhear(datagram, source)
        else:
            self.counters["left"] += 1
