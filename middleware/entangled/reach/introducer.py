"""Introducer: the third, who tells each of two peers where it sees the other, so that they knock at the same time.

``Allowance`` says how often a peer may have this node introduce it, and make it knock at others.
"""

from __future__ import annotations

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.bounded import keep
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError, Refused
from middleware.entangled.identity import ID_BYTES
from middleware.entangled.network.network import Address, is_relayed
from middleware.entangled.reach.candidate import is_possible, packed, unpacked
from middleware.entangled.reach.carrier import Carriers
from middleware.entangled.reach.known import LIVELY_S, MAX_KNOWN, Known
from middleware.entangled.reach.relay import Relay
from middleware.entangled.token_bucket import TokenBucket
from middleware.entangled.wire.endpoint import Endpoint

USUAL = 0
"""The order in which two knock at their usual ports; in all others they do so at fresh ones."""
ASKED_S = 1.0
"""Seconds for which an answer is waited for."""
INTRODUCTIONS = 20.0
"""Times in a second, and at once twice as often, that one peer may have this node introduce it."""
MEETS, MEETS_AT_ONCE = 1.0, 60.0
"""Times in a second, and at once, that one peer may make this node knock where nobody answers.  Who is met does not
count; so a member that names addresses of strangers gets 0.2 MB/s sent there by this node, and a team that starts
behind routers none the less meets in a moment."""


class Allowance:
    """What is left to each peer, and who introduced whom."""

    def __init__(self, clock: IReactorTime) -> None:
        self._clock = clock
        self._buckets: dict[tuple[str, bytes], TokenBucket] = {}
        self._introducers: dict[bytes, bytes] = {}

    def __len__(self) -> int:
        return len(self._buckets)

    def may_introduce(self, asker: bytes) -> bool:
        """Whether that peer may have this node introduce it once more; then this is counted."""
        return self._may("introduce", asker, INTRODUCTIONS, 2 * INTRODUCTIONS)

    def may_meet(self, introducer: bytes) -> bool:
        """Whether that peer may make this node knock once more; then this is counted."""
        return self._may("meet", introducer, MEETS, MEETS_AT_ONCE)

    def introduced(self, public: bytes, introducer: bytes) -> None:
        """Take note of who makes this node knock at a peer."""
        keep(self._introducers, public, introducer, MAX_KNOWN)

    def met(self, public: bytes) -> None:
        """Give back to who introduced a peer what this cost: it has answered."""
        bucket = self._buckets.get(("meet", self._introducers.pop(public, b"")))
        if bucket is not None:
            bucket.give()

    def _may(self, what: str, public: bytes, rate: float, at_once: float) -> bool:
        key = (what, public)
        bucket = self._buckets.pop(key, None) or TokenBucket(rate, at_once)
        keep(self._buckets, key, bucket, MAX_KNOWN)
        return bucket.take(self._clock.seconds())


class Introducer:
    """Introduces peers to each other, as often as the ``allowance`` says; ``relay`` would carry for them."""

    def __init__(
        self,
        endpoint: Endpoint,
        known: Known,
        carriers: Carriers,
        relay: Relay,
        allowance: Allowance,
        clock: IReactorTime,
    ) -> None:
        self._endpoint = endpoint
        self._known = known
        self._carriers = carriers
        self._relay = relay
        self._allowance = allowance
        self._clock = clock

    async def answer_introduce(
        self, peer: Contact, wanted: bytes, candidates: list[object], order: int
    ) -> list[object] | None:
        """REACH.INTRODUCE: tell the node of that id where ``peer`` is, and ``peer`` where it is; nil: not known."""
        if len(wanted) != ID_BYTES or not self._allowance.may_introduce(peer.public):
            raise Refused("no introduction: that is no id, or too many are wanted")
        session = self._known.session(wanted)
        if session is None or self._clock.seconds() - session.heard_at > LIVELY_S:
            return None
        theirs = [*_as_seen(peer, order != USUAL), *unpacked(candidates)]
        try:
            answer = await self._endpoint.ask(
                session.contact, "reach.meet", peer.public, packed(theirs), order, timeout=ASKED_S, changes=True
            )
        except EntangledError:
            return None
        fields, was_fresh = answer if isinstance(answer, list) and len(answer) == 2 else ([], False)
        found = [*_as_seen(session.contact, was_fresh is True), *unpacked(fields)]
        is_direct = not (is_relayed(session.contact.address) or is_relayed(peer.address))
        carriers = self._carriers.contacts(wanted) if is_relayed(session.contact.address) else []
        return [packed(found), [contact.packed() for contact in carriers], is_direct and self._relay.has_room]


def _as_seen(contact: Contact, is_fresh: bool) -> list[Address]:
    """Where this node sees a peer, which is no help where the peer uses a fresh port."""
    return [contact.address] if not is_fresh and is_possible(contact.address) else []
