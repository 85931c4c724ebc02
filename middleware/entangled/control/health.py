"""State of a running node and quality of the paths to its peers, for diagnostics."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

from twisted.internet.defer import Deferred, DeferredList
from twisted.internet.interfaces import IReactorTime
from twisted.internet.task import deferLater

from middleware.entangled.background import Background
from middleware.entangled.contact import Contact
from middleware.entangled.control.link_quality import compute_quality
from middleware.entangled.errors import EntangledError
from middleware.entangled.network.network import is_relayed
from middleware.entangled.node import EntangledNode

PINGS = 10
"""The number of pings to each peer."""
PING_INTERVAL_S = 0.1
PING_TIMEOUT_S = 1.5
MAX_LINKS = 32
"""The maximum number of peers that are measured: 32 x 10 pings in a second are 50 kB in each direction."""
SLOW_INTERVAL_S = 1.0
"""Seconds between two pings to a peer, after the first ``PINGS`` pings."""
FEW_PEERS = 10
"""The number of peers up to which the interval is ``SLOW_INTERVAL_S``.  With more peers the interval grows, so that a
node sends at most 10 pings per second (1 kB in each direction), and at first 100 (10 kB)."""
IDLE_S = 12.0
"""Seconds after the last call of ``LinkMetrics.read`` until the measurement stops."""


def read_health(node: EntangledNode) -> Mapping[str, Any]:
    """Return the number of contacts, the store's usage and limits, and the nodes that reject this node."""
    usage = node.store.usage
    return {
        "id": node.identity.node_id.hex(),
        "address": str(node.contact.address),
        "contacts": len(node.overlay.contacts()),
        "rows": usage.rows,
        "max_rows": usage.max_rows,
        "bytes": usage.bytes,
        "max_bytes": usage.max_bytes,
        "trouble": node.store.write_error,
        "refusals": [[code, str(contact.address)] for contact, code in node.endpoint.refusals.values()],
    }


async def measure_links(node: EntangledNode, clock: IReactorTime) -> list[Mapping[str, Any]]:
    """Return the path to each peer with the durations of ``PINGS`` pings, None for a lost ping.

    All times are seconds; The field ``for`` is the time for which the path has been in use (None: the peer is
    unreachable).
    """
    contacts = sorted(node.overlay.contacts(), key=lambda contact: contact.node_id)[:MAX_LINKS]
    pings = [Deferred.fromCoroutine(_ping_repeatedly(node, clock, contact)) for contact in contacts]
    answers = await DeferredList(pings, consumeErrors=True)
    return [
        {**describe_path(node, clock, contact), "times": times}
        for contact, (ok, times) in zip(contacts, answers, strict=True)
        if ok
    ]


def describe_path(node: EntangledNode, clock: IReactorTime, contact: Contact) -> dict[str, Any]:
    """Return the path to a peer: ``way`` is a ``path_kind.PathKind``, ``by`` the id of the relay, or empty."""
    path = node.nat.paths.find_path(contact)
    return {
        "id": contact.node_id.hex(),
        "address": str(path.address or contact.address),
        "way": path.kind,
        "by": path.by.hex(),
        "for": None if path.since is None else round(clock.seconds() - path.since, 1),
        "relayed": is_relayed(path.address or contact.address),
    }


async def ping(node: EntangledNode, clock: IReactorTime, contact: Contact) -> float | None:
    """Ping a peer; return the round-trip time in seconds, None if it does not answer."""
    started_at = clock.seconds()
    try:
        await node.call(contact, "ping", b"", timeout=PING_TIMEOUT_S, changes=True)
    except EntangledError:
        return None
    return clock.seconds() - started_at


async def _ping_repeatedly(node: EntangledNode, clock: IReactorTime, contact: Contact) -> list[float | None]:
    await ping(node, clock, contact)  # opens a session if there is none
    pings = []
    for _ in range(PINGS):
        pings.append(Deferred.fromCoroutine(ping(node, clock, contact)))
        await deferLater(clock, PING_INTERVAL_S)
    return [seconds for _, seconds in await DeferredList(pings, consumeErrors=True)]


class LinkMetrics:
    """Measures the paths from ``node`` to its peers while ``read`` is called regularly.

    The first call returns immediately, without results; later calls return more results.  Each peer gets several pings
    in quick succession, and then one ping per second, until ``read`` has not been called for ``IDLE_S`` seconds.
    """

    def __init__(self, node: EntangledNode, clock: IReactorTime, background: Background) -> None:
        self._node = node
        self._clock = clock
        self._background = background
        self._times: dict[bytes, deque[float | None]] = {}
        self._ping_rounds = 0
        self._called_at = float("-inf")
        self._is_running = False

    def read(self) -> list[dict[str, Any]]:
        """Return the path to each peer with the current results, and continue to measure.

        Each entry has the fields of ``describe_path``, ``loss``, ``round_trip`` and ``jitter`` (None: unknown).
        """
        self._called_at = self._clock.seconds()
        if not self._is_running:
            self._is_running = True
            self._ping_rounds = 0
            self._times.clear()
            self._ping_peers()
        return [
            {**describe_path(self._node, self._clock, each), **self._compute_metrics(each)}
            for each in self._list_peers()
        ]

    def _compute_metrics(self, contact: Contact) -> dict[str, float | None]:
        times = self._times.get(contact.public)
        if not times:
            return {"loss": None, "round_trip": None, "jitter": None}
        found = compute_quality(list(times), False)
        return {"loss": round(found.loss, 3), "round_trip": found.round_trip, "jitter": found.jitter}

    def _list_peers(self) -> list[Contact]:
        return sorted(self._node.overlay.contacts(), key=lambda contact: contact.node_id)[:MAX_LINKS]

    def _ping_peers(self) -> None:
        if self._clock.seconds() - self._called_at > IDLE_S:
            self._is_running = False
            self._times.clear()
            return
        self._ping_rounds += 1
        peers = self._list_peers()
        present = {contact.public for contact in peers}
        self._times = {public: times for public, times in self._times.items() if public in present}
        for contact in peers:
            # The first ping opens the session and takes longer, so it is not counted.
            has_session = self._node.endpoint.has_session(contact)
            self._background.fork(self._record_ping(contact) if has_session else ping(self._node, self._clock, contact))
        pause = PING_INTERVAL_S if self._ping_rounds < PINGS else SLOW_INTERVAL_S
        self._background.later(pause * max(1.0, len(peers) / FEW_PEERS), self._ping_peers)

    async def _record_ping(self, contact: Contact) -> None:
        seconds = await ping(self._node, self._clock, contact)
        if self._is_running:
            self._times.setdefault(contact.public, deque(maxlen=PINGS)).append(seconds)
