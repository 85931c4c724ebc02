"""Health: what a running node says of itself and of the ways to its peers, for whoever looks what is wrong."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

from twisted.internet.defer import Deferred, DeferredList
from twisted.internet.interfaces import IReactorTime
from twisted.internet.task import deferLater

from middleware.entangled.background import Background
from middleware.entangled.contact import Contact
from middleware.entangled.control.link import link
from middleware.entangled.errors import EntangledError
from middleware.entangled.network.network import is_relayed
from middleware.entangled.node import EntangledNode

ASKED = 10
"""Questions to each peer."""
APART = 0.1
LIMIT = 1.5
MAX_LINKS = 32
"""Peers whose ways are measured: 32 x 10 questions in a second are 50 kB each way."""
PACE = 1.0
"""Seconds between two questions to a peer, after the first ``ASKED`` ones."""
FEW = 10
"""Peers up to which that holds; with more of them it goes slower, so that a node asks 10 questions a second at most,
and 100 at the beginning: 1 and 10 kB each way."""
IDLE = 12.0
"""Seconds since the last who wanted to know after which it ends."""


def health(node: EntangledNode) -> Mapping[str, Any]:
    """The node's contacts, what its store holds and may hold, and who does not let it in, and why."""
    usage = node.store.usage
    return {
        "id": node.identity.node_id.hex(),
        "address": str(node.contact.address),
        "contacts": len(node.overlay.contacts()),
        "rows": usage.rows,
        "max_rows": usage.max_rows,
        "bytes": usage.bytes,
        "max_bytes": usage.max_bytes,
        "trouble": node.store.trouble,
        "refusals": [[code, str(contact.address)] for contact, code in node.endpoint.refusals.values()],
    }


async def links(node: EntangledNode, clock: IReactorTime) -> list[Mapping[str, Any]]:
    """The way to each peer, and how long it took for each of ``ASKED`` small questions, None where it did not answer.

    All times are seconds; ``for`` says how long the peer is reached that way, None where it is not.
    """
    contacts = sorted(node.overlay.contacts(), key=lambda contact: contact.node_id)[:MAX_LINKS]
    asked = [Deferred.fromCoroutine(_times(node, clock, contact)) for contact in contacts]
    answers = await DeferredList(asked, consumeErrors=True)
    return [
        {**way(node, clock, contact), "times": times}
        for contact, (ok, times) in zip(contacts, answers, strict=True)
        if ok
    ]


def way(node: EntangledNode, clock: IReactorTime, contact: Contact) -> dict[str, Any]:
    """How a peer is reached: ``way`` is a ``passage.Kind``, ``by`` the id of who carries, or empty."""
    passage = node.reach.ways.passage(contact)
    return {
        "id": contact.node_id.hex(),
        "address": str(passage.address or contact.address),
        "way": passage.kind,
        "by": passage.by.hex(),
        "for": None if passage.since is None else round(clock.seconds() - passage.since, 1),
        "relayed": is_relayed(passage.address or contact.address),
    }


async def timed(node: EntangledNode, clock: IReactorTime, contact: Contact) -> float | None:
    """How long a peer takes for one small question, in seconds; None where it does not answer."""
    begun = clock.seconds()
    try:
        await node.call(contact, "ping", b"", timeout=LIMIT, changes=True)
    except EntangledError:
        return None
    return clock.seconds() - begun


async def _times(node: EntangledNode, clock: IReactorTime, contact: Contact) -> list[float | None]:
    await timed(node, clock, contact)  # opens the session, where there is none
    asked = []
    for _ in range(ASKED):
        asked.append(Deferred.fromCoroutine(timed(node, clock, contact)))
        await deferLater(clock, APART)
    return [seconds for _, seconds in await DeferredList(asked, consumeErrors=True)]


class Gauge:
    """Measures the ways from ``node`` to its peers, only while somebody wants to know.

    The first caller is answered at once, and gets more with each second.  Each peer is asked small questions: some in
    quick succession, then one a second, until nobody has asked for a while.
    """

    def __init__(self, node: EntangledNode, clock: IReactorTime, chores: Background) -> None:
        self._node = node
        self._clock = clock
        self._chores = chores
        self._times: dict[bytes, deque[float | None]] = {}
        self._turns = 0
        self._wanted_at = float("-inf")
        self._is_running = False

    def links(self) -> list[dict[str, Any]]:
        """The way to each peer and how good it is, as far as it is known by now; this also keeps it measuring.

        Each is what ``way`` says, and ``loss``, ``round_trip`` and ``jitter`` (None: not known).
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
        found = link(list(times), False)
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
            # The first question to a peer opens the session, and takes longer.
            is_met = self._node.endpoint.is_met(contact)
            self._chores.fork(self._time(contact) if is_met else timed(self._node, self._clock, contact))
        pause = APART if self._turns < ASKED else PACE
        self._chores.later(pause * max(1.0, len(peers) / FEW), self._turn)

    async def _time(self, contact: Contact) -> None:
        seconds = await timed(self._node, self._clock, contact)
        if self._is_running:
            self._times.setdefault(contact.public, deque(maxlen=ASKED)).append(seconds)
