"""Discover nodes of the team on the LAN without a configured address, and merge separate parts of a team.

A node multicasts DISCOVERY to the LAN, often as long as it has no contacts and rarely afterwards.  Some receivers reply
from their own port after a random delay.  The node then sends a discovery request to the source address of each reply,
and the answer proves that the replying node is a member.  A receiver replies with a probability that decreases with the
number of members and senders that it knows.  Therefore about ``TARGET_REPLIES`` replies are sent in a team of any size,
even if all nodes start at the same moment.
"""

from __future__ import annotations

import hashlib
import random
from collections import Counter, deque

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background
from middleware.entangled.bounded import put_bounded
from middleware.entangled.errors import EntangledError
from middleware.entangled.kademlia.membership import Membership
from middleware.entangled.kademlia.overlay import Overlay
from middleware.entangled.network.multicast import Multicast
from middleware.entangled.network.network import Address
from middleware.entangled.wire.discovery import DISCOVERY, DISCOVERY_REPLY
from middleware.entangled.wire.endpoint import Endpoint
from middleware.entangled.wire.probe import PROBE

TARGET_REPLIES = 4
"""The mean number of replies to one DISCOVERY, if more nodes could reply."""
MAX_REPLY_DELAY_S = 0.1
"""The maximum delay of a reply in seconds; the first DISCOVERY of a node is delayed by up to a fifth of it."""
ALONE_INTERVALS_S = (0.2, 0.3, 0.5, 1.0, 2.0, 5.0)
"""The seconds between the multicasts of a node without contacts; the last interval repeats."""
SHARED_INTERVAL_S = 30.0
"""The mean seconds between two multicasts of the whole team: each node waits this time multiplied by the number of
members."""
MAX_INTERVAL_S = 900.0
LISTEN_S = 0.8
"""The seconds after which a node without known nodes and without replies considers itself the first of its network."""
RECENT_S = 2.0
RETRY_INTERVAL_S = 4.0
"""The seconds before a discovery request to the same address is repeated."""
MAX_PARALLEL = 3
"""The maximum number of simultaneous discovery requests.  A few are enough, because the first node that answers also
sends the contacts of its network."""
MAX_PENDING = 64
"""The maximum number of delayed replies, and therefore of replies within ``MAX_REPLY_DELAY_S``."""
MAX_RECORDED = 256


class LanDiscovery:
    """One node's discovery on its LAN.

    ``counters`` counts the multicasts that were sent (calls), received from the team (heard), answered, and not
    answered (left).  It also counts datagrams of other teams (foreign), duplicates (repeated) and surplus datagrams
    (crowded), and the addresses to which a discovery request was sent (contacted).
    """

    def __init__(
        self,
        group: Multicast,
        endpoint: Endpoint,
        overlay: Overlay,
        membership: Membership,
        clock: IReactorTime,
        rng: random.Random,
        background: Background,
    ) -> None:
        self.counters: Counter[str] = Counter()
        self._group = group
        self._endpoint = endpoint
        self._overlay = overlay
        self._membership = membership
        self._clock = clock
        self._rng = rng
        self._background = background
        self._tries = 0
        self._due_at = 0.0
        self._own_multicast = b""
        self._cancel_multicast = lambda: None
        self._seen_digests: dict[bytes, None] = {}
        self._multicast_times: deque[float] = deque(maxlen=MAX_RECORDED)
        self._pending = 0
        self._contacted_at: dict[Address, float] = {}
        self._contacting = 0
        self._waiting: list[Deferred[None]] = []

    def start(self) -> None:
        """Join the multicast group and send the first DISCOVERY."""
        self._group.listen(self._on_datagram, self._on_moved)
        # The delay prevents nodes that are switched on together from multicasting at the same moment.
        self._cancel_multicast = self._background.later(
            self._rng.random() * MAX_REPLY_DELAY_S / 5, self._multicast_if_due
        )

    def stop(self) -> None:
        """Leave the multicast group."""
        self._group.close()

    def wait_for_first(self) -> Deferred[None]:
        """Return a Deferred that fires when a node of the team was found, or after ``LISTEN_S`` seconds."""
        found: Deferred[None] = Deferred()
        if self._overlay.contacts():
            found.callback(None)
        else:
            self._waiting.append(found)
            self._background.later(LISTEN_S, self._fire_waiting)
        return found

    # -- sending ----------------------------------------------------------------------------------------------------

    def _multicast_if_due(self) -> None:
        """Multicast if a multicast is due; the interval depends on whether this node currently has contacts."""
        company = len(self._overlay.contacts())
        now, wait = self._clock.seconds(), ALONE_INTERVALS_S[-1]
        if company == 0:
            wait = ALONE_INTERVALS_S[min(self._tries, len(ALONE_INTERVALS_S) - 1)]
            self._tries += 1
            self._multicast()
        elif self._tries or now >= self._due_at:
            if not self._tries:  # otherwise this node sent a multicast just before it found its contacts
                self._multicast()
            self._tries = 0
            self._due_at = now + min(MAX_INTERVAL_S, SHARED_INTERVAL_S * (company + 1)) * self._draw_factor()
        self._cancel_multicast = self._background.later(wait * self._draw_factor(), self._multicast_if_due)

    def _multicast(self) -> None:
        self.counters["calls"] += 1
        self._own_multicast = self._endpoint.discoverer.make_multicast()
        self._group.send(self._own_multicast)

    def _on_moved(self) -> None:
        self._cancel_multicast()
        self._due_at, self._tries = 0.0, 0
        self._multicast_if_due()  # sends a multicast even if this node has contacts

    def _draw_factor(self) -> float:
        return 0.75 + self._rng.random() / 2

    def _on_reply(self, source: Address) -> None:
        """Send a discovery request to the source of a reply, unless it is a known contact."""
        now, overlay = self._clock.seconds(), self._overlay
        # Possibly the first contact has not told this node about the other members yet.
        if (overlay.has_all_members or overlay.is_large) and any(
            known.address == source for known in overlay.contacts()
        ):
            return
        if (
            self._contacting >= MAX_PARALLEL
            or now - self._contacted_at.get(source, -RETRY_INTERVAL_S) < RETRY_INTERVAL_S
        ):
            return
        if len(self._contacted_at) >= MAX_RECORDED:
            self._contacted_at.clear()
        self._contacted_at[source] = now
        self._contacting += 1
        self.counters["greeted"] += 1
        self._background.fork(self._contact(source))

    async def _contact(self, address: Address) -> None:
        try:
            if await self._membership.contact_address(address):
                self._fire_waiting()
        except EntangledError:
            # The node may have closed the port, or may only listen to the multicasts of the team.
            self.counters["unmet"] += 1
        finally:
            self._contacting -= 1

    def _fire_waiting(self) -> None:
        waiting, self._waiting = self._waiting, []
        for found in waiting:
            found.callback(None)

    # -- receiving --------------------------------------------------------------------------------------------------

    def _on_datagram(self, datagram: bytes, source: Address) -> None:
        kind = datagram[0] if datagram else 0
        if kind == DISCOVERY_REPLY:
            self._on_reply(source)
        elif kind in (DISCOVERY, PROBE) and datagram != self._own_multicast:
            self._on_request(datagram, source)

    def _on_request(self, datagram: bytes, source: Address) -> None:
        digest = hashlib.blake2s(datagram, digest_size=8).digest()
        if digest in self._seen_digests:  # a duplicate from another interface of the same LAN, or a replay
            self.counters["repeated"] += 1
            return
        if datagram[0] == DISCOVERY:
            if not self._endpoint.discoverer.is_of_team(datagram):
                self.counters["foreign"] += 1
                return
            self._multicast_times.append(self._clock.seconds())
        self.counters["heard"] += 1
        put_bounded(self._seen_digests, digest, None, MAX_RECORDED)
        if self._pending >= MAX_PENDING:
            self.counters["crowded"] += 1
            return
        self._pending += 1
        self._background.later(self._rng.random() * MAX_REPLY_DELAY_S, self._answer, datagram, source)

    def _answer(self, datagram: bytes, source: Address) -> None:
        """Reply to a DISCOVERY with a probability that falls with the number of nodes that can reply or also ask."""
        self._pending -= 1
        since = self._clock.seconds() - RECENT_S
        callers = sum(1 for moment in self._multicast_times if moment > since)
        if self._rng.random() * max(callers, 1 + len(self._overlay.contacts())) < TARGET_REPLIES:
            self.counters["answered"] += 1
            self._endpoint.process_datagram(datagram, source)
        else:
            self.counters["left"] += 1
