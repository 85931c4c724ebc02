"""Gauge: how good the ways from one node to its peers are, measured only while somebody wants to know.

Who asks first is answered at once, and gets more with each second.  Each peer is asked small questions: some in quick
succession, then one a second, until nobody has asked for a while.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.contact import Contact
from middleware.entangled.control.health import APART, ASKED, MAX_LINKS, timed, way
from middleware.entangled.control.link import Link, link
from middleware.entangled.node import EntangledNode

PACE = 1.0
"""Seconds between two questions to a peer, after the first ``ASKED`` ones."""
FEW = 10
"""Peers up to which that holds; with more of them it goes slower, so that a node asks 10 questions a second at most,
and 100 at the beginning: 1 and 10 kB each way."""
IDLE = 12.0
"""Seconds since the last who wanted to know after which it ends."""


class Gauge:
    """Times the peers of ``node``; ``fork`` runs what nobody waits for, and ``later`` is a timer that ends with it."""

    def __init__(
        self,
        node: EntangledNode,
        clock: IReactorTime,
        fork: Callable[[Any], None],
        later: Callable[..., Callable[[], None]],
    ) -> None:
        self._node = node
        self._clock = clock
        self._fork = fork
        self._later = later
        self._times: dict[bytes, deque[float | None]] = {}
        self._turns = 0
        self._wanted_at = float("-inf")
        self._is_running = False

    def links(self) -> list[dict[str, Any]]:
        """The way to each peer and how good it is, as far as it is known by now; this also keeps it measuring.

        Each is what ``health.way`` says, and ``loss``, ``round_trip`` and ``jitter`` (None: not known).
        """
        self._wanted_at = self._clock.seconds()
        if not self._is_running:
            self._is_running = True
            self._turns = 0
            self._times.clear()
            self._turn()
        return [{**way(self._node, self._clock, each), **self._figures(each)} for each in self._peers()]

    def _figures(self, contact: Contact) -> dict[str, float | None]:
        times = self._times.get(contact.public)
        if not times:
            return {"loss": None, "round_trip": None, "jitter": None}
        found: Link = link(list(times), False)
        return {"loss": round(found.loss, 3), "round_trip": found.round_trip, "jitter": found.jitter}

    def _peers(self) -> list[Contact]:
        return sorted(self._node.overlay.contacts(), key=lambda contact: contact.node_id)[:MAX_LINKS]

    def _turn(self) -> None:
        if self._clock.seconds() - self._wanted_at > IDLE:
            self._is_running = False
            self._times.clear()
            return
        self._turns += 1
        peers = self._peers()
        here = {contact.public for contact in peers}
        self._times = {public: times for public, times in self._times.items() if public in here}
        for contact in peers:
            if self._node.endpoint.is_met(contact):
                self._fork(self._time(contact))
            else:
                self._fork(timed(self._node, self._clock, contact))  # opens the session
        pause = APART if self._turns < ASKED else PACE
        self._later(pause * max(1.0, len(peers) / FEW), self._turn)

    async def _time(self, contact: Contact) -> None:
        seconds = await timed(self._node, self._clock, contact)
        if self._is_running:
            self._times.setdefault(contact.public, deque(maxlen=ASKED)).append(seconds)
