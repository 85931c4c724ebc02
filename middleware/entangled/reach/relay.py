"""Relay: carries datagrams from one peer to another that cannot reach each other, as far as there is room for it.

Only what a peer sends in its session is carried, only to another peer with a session, and never over more than one
node: who is reached through others carries for nobody that way.  What is inside is sealed between the two; who carries
it can neither read nor change it.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.identity import ID_BYTES
from middleware.entangled.network.network import MAX_DATAGRAM, Address, is_relayed
from middleware.entangled.token_bucket import TokenBucket
from middleware.entangled.wire.session import Session

CARRY = 0x03
CARRIED = 0x05
HEAD = 1 + ID_BYTES
PAIR_RATE, PAIR_BURST = 8_000.0, 65_536.0
"""Bytes that one pair may send in a second for long (64 kbit/s), and at once: a call, a join, an order, no films."""
ALL_RATE, ALL_BURST = 128_000.0, 524_288.0
MAX_PAIRS = 256
ONE_SIDED_S = 120.0
"""Seconds for which one of two may send to the other without a word from it."""


@dataclass(slots=True)
class _Pair:
    """Two peers; ``heard`` has when each last sent, by its id."""

    begun_at: float
    bucket: TokenBucket = field(default_factory=lambda: TokenBucket(PAIR_RATE, PAIR_BURST))
    heard: dict[bytes, float] = field(default_factory=dict)


class Relay:
    """Carries for others.  ``session_of`` gives the session by which a peer is reached directly, by its id.

    ``counters`` counts what was carried, in datagrams (``carried``), and what was not, for want of room
    (``uncarried``).
    """

    def __init__(
        self,
        session_of: Callable[[bytes], Session | None],
        send: Callable[[Session, bytes], None],
        clock: IReactorTime,
        counters: Counter[str],
    ) -> None:
        self._session_of = session_of
        self._send = send
        self._clock = clock
        self._counters = counters
        self._pairs: OrderedDict[tuple[bytes, bytes], _Pair] = OrderedDict()
        self._all = TokenBucket(ALL_RATE, ALL_BURST)

    def __len__(self) -> int:
        return len(self._pairs)

    @property
    def has_room(self) -> bool:
        """Whether another pair may be carried for."""
        self._forget_idle()
        return len(self._pairs) < MAX_PAIRS

    def on_carry(self, session: Session, plain: bytes, source: Address) -> None:
        """Hand on what the peer of ``session`` wants carried."""
        inner, to = plain[HEAD:], plain[1:HEAD]
        sender = session.contact.node_id
        if not inner or len(inner) > MAX_DATAGRAM or is_relayed(session.contact.address) or to == sender:
            self._counters["malformed"] += 1
            return
        target = self._session_of(to)
        if target is None or not self._may(sender, to, len(inner)):
            self._counters["uncarried"] += 1
            return
        self._counters["carried"] += 1
        self._send(target, bytes([CARRIED]) + sender + inner)

    def _may(self, sender: bytes, to: bytes, size: int) -> bool:
        now = self._clock.seconds()
        key = (min(sender, to), max(sender, to))
        pair = self._pairs.get(key)
        if pair is None:
            if not self.has_room:
                return False
            pair = self._pairs[key] = _Pair(now)
        self._pairs.move_to_end(key)
        pair.heard[sender] = now
        if now - pair.heard.get(to, pair.begun_at) > ONE_SIDED_S:
            return False
        return pair.bucket.take(now, size) and self._all.take(now, size)

    def _forget_idle(self) -> None:
        before = self._clock.seconds() - ONE_SIDED_S
        while self._pairs:
            key, pair = next(iter(self._pairs.items()))
            if max(pair.heard.values(), default=pair.begun_at) > before:
                return
            del self._pairs[key]
