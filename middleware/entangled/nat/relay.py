"""Relay datagrams between two peers that cannot reach each other, within rate limits.

A relay forwards only messages in a session, only to another peer with a session, and only over one hop: it does not
forward datagrams to a node that it reaches through another relay.  The content is encrypted between the two peers; the
relay can neither read nor change it.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.identity import ID_BYTES
from middleware.entangled.network.network import MAX_DATAGRAM_BYTES, Address, is_relayed
from middleware.entangled.token_bucket import TokenBucket
from middleware.entangled.wire.session import Session

RELAY_REQUEST = 0x03
RELAYED_DATAGRAM = 0x05
HEADER_BYTES = 1 + ID_BYTES
PAIR_RATE, PAIR_BURST = 8_000.0, 65_536.0
"""The bytes that one pair may send per second (64 kbit/s), and in one burst: enough for requests, but not for video."""
ALL_RATE, ALL_BURST = 128_000.0, 524_288.0
MAX_PAIRS = 256
ONE_SIDED_S = 120.0
"""The seconds for which one of two peers may send to the other although the other sends nothing back."""


@dataclass(slots=True)
class _Pair:
    """Two peers; ``last_received_at`` maps the id of each peer to the time of its latest datagram."""

    started_at: float
    bucket: TokenBucket = field(default_factory=lambda: TokenBucket(PAIR_RATE, PAIR_BURST))
    last_received_at: dict[bytes, float] = field(default_factory=dict)


class Relay:
    """Relays datagrams for other nodes.  ``find_session`` returns the direct session with the peer of a given id.

    ``counters`` counts the datagrams that were relayed (``carried``) and rejected by the limits (``uncarried``).
    """

    def __init__(
        self,
        find_session: Callable[[bytes], Session | None],
        send: Callable[[Session, bytes], None],
        clock: IReactorTime,
        counters: Counter[str],
    ) -> None:
        self._find_session = find_session
        self._send = send
        self._clock = clock
        self._counters = counters
        self._pairs: OrderedDict[tuple[bytes, bytes], _Pair] = OrderedDict()
        self._total_limit = TokenBucket(ALL_RATE, ALL_BURST)

    def __len__(self) -> int:
        return len(self._pairs)

    @property
    def has_room(self) -> bool:
        """Whether the limits allow another pair."""
        self._forget_idle()
        return len(self._pairs) < MAX_PAIRS

    def on_request(self, session: Session, plain: bytes, source: Address) -> None:
        """Forward a datagram of the peer of ``session``."""
        inner, to = plain[HEADER_BYTES:], plain[1:HEADER_BYTES]
        sender = session.contact.node_id
        if not inner or len(inner) > MAX_DATAGRAM_BYTES or is_relayed(session.contact.address) or to == sender:
            self._counters["malformed"] += 1
            return
        target = self._find_session(to)
        if target is None or not self._is_allowed(sender, to, len(inner)):
            self._counters["uncarried"] += 1
            return
        self._counters["carried"] += 1
        self._send(target, bytes([RELAYED_DATAGRAM]) + sender + inner)

    def _is_allowed(self, sender: bytes, to: bytes, size: int) -> bool:
        now = self._clock.seconds()
        key = (min(sender, to), max(sender, to))
        pair = self._pairs.get(key)
        if pair is None:
            if not self.has_room:
                return False
            pair = self._pairs[key] = _Pair(now)
        self._pairs.move_to_end(key)
        pair.last_received_at[sender] = now
        if now - pair.last_received_at.get(to, pair.started_at) > ONE_SIDED_S:
            return False
        return pair.bucket.take(now, size) and self._total_limit.take(now, size)

    def _forget_idle(self) -> None:
        before = self._clock.seconds() - ONE_SIDED_S
        while self._pairs:
            key, pair = next(iter(self._pairs.items()))
            if max(pair.last_received_at.values(), default=pair.started_at) > before:
                return
            del self._pairs[key]
