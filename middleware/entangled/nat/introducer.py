"""Introduce two peers: send each the other's addresses, so that both send INITs at the same time (hole punching).

``IntroductionLimits`` limits the rate at which a peer may request introductions, and the rate at which it may cause
this node to send INITs to other nodes.
"""

from __future__ import annotations

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.bounded import put_bounded
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError, Refused
from middleware.entangled.identity import ID_BYTES
from middleware.entangled.nat.candidate import is_possible, pack_candidates, parse_candidates
from middleware.entangled.nat.known_peers import LIVE_S, MAX_KNOWN, KnownPeers
from middleware.entangled.nat.relay import Relay
from middleware.entangled.nat.relay_client import RelayClient
from middleware.entangled.network.network import Address, is_relayed
from middleware.entangled.token_bucket import TokenBucket
from middleware.entangled.wire.endpoint import Endpoint

USUAL_PORTS = 0
"""The number of the order of sending in which both peers send INITs from their usual ports.  In all other orders, they
use additional ports."""
REQUEST_TIMEOUT_S = 1.0
"""The timeout of a request in seconds."""
INTRODUCTIONS_PER_S = 20.0
"""The introductions per second that one peer may request; twice as many in one burst."""
ATTEMPTS_PER_S, ATTEMPT_BURST = 1.0, 60.0
"""The number of connection attempts, per second and in one burst, to nodes that do not answer, which one peer may cause
this node to make.  Successful attempts are not counted.  A malicious member that sends addresses of strangers can
therefore cause at most 0.2 MB/s of traffic from this node to these addresses, but a team that starts behind routers
still connects quickly."""


class IntroductionLimits:
    """The rate limit of each peer, and the introducer of each peer."""

    def __init__(self, clock: IReactorTime) -> None:
        self._clock = clock
        self._buckets: dict[tuple[str, bytes], TokenBucket] = {}
        self._introducers: dict[bytes, bytes] = {}

    def __len__(self) -> int:
        return len(self._buckets)

    def may_introduce(self, requester: bytes) -> bool:
        """Return whether that peer may request another introduction; if so, count this introduction."""
        return self._take_token("introduce", requester, INTRODUCTIONS_PER_S, 2 * INTRODUCTIONS_PER_S)

    def may_meet(self, introducer: bytes) -> bool:
        """Return whether that peer may cause another connection attempt by this node; if so, count this attempt."""
        return self._take_token("meet", introducer, ATTEMPTS_PER_S, ATTEMPT_BURST)

    def record_introducer(self, public: bytes, introducer: bytes) -> None:
        """Record the introducer of a peer."""
        put_bounded(self._introducers, public, introducer, MAX_KNOWN)

    def refund(self, public: bytes) -> None:
        """Remove an attempt from the count of the peer's introducer, because the peer has answered."""
        bucket = self._buckets.get(("meet", self._introducers.pop(public, b"")))
        if bucket is not None:
            bucket.refund()

    def _take_token(self, what: str, public: bytes, rate: float, at_once: float) -> bool:
        key = (what, public)
        bucket = self._buckets.pop(key, None) or TokenBucket(rate, at_once)
        put_bounded(self._buckets, key, bucket, MAX_KNOWN)
        return bucket.take(self._clock.seconds())


class Introducer:
    """Introduces peers to each other, within the ``limits``; ``relay`` forwards their datagrams if it has capacity."""

    def __init__(
        self,
        endpoint: Endpoint,
        known: KnownPeers,
        relays: RelayClient,
        relay: Relay,
        limits: IntroductionLimits,
        clock: IReactorTime,
    ) -> None:
        self._endpoint = endpoint
        self._known = known
        self._relays = relays
        self._relay = relay
        self._limits = limits
        self._clock = clock

    async def answer_introduce(
        self, peer: Contact, wanted: bytes, candidates: list[object], order: int
    ) -> list[object] | None:
        """Answer REACH.INTRODUCE: send the addresses of ``peer`` to the node with that id, and return its addresses.

        Returns None if the node is unknown.
        """
        if len(wanted) != ID_BYTES or not self._limits.may_introduce(peer.public):
            raise Refused("the introduction is rejected: the node id is invalid, or the rate limit is exceeded")
        session = self._known.find_session(wanted)
        if session is None or self._clock.seconds() - session.last_received_at > LIVE_S:
            return None
        theirs = [*_observed_address(peer, order != USUAL_PORTS), *parse_candidates(candidates)]
        try:
            answer = await self._endpoint.ask(
                session.contact,
                "reach.meet",
                peer.public,
                pack_candidates(theirs),
                order,
                timeout=REQUEST_TIMEOUT_S,
                changes=True,
            )
        except EntangledError:
            return None
        fields, was_fresh = answer if isinstance(answer, list) and len(answer) == 2 else ([], False)
        found = [*_observed_address(session.contact, was_fresh is True), *parse_candidates(fields)]
        is_direct = not (is_relayed(session.contact.address) or is_relayed(peer.address))
        relays = self._relays.find_contacts(wanted) if is_relayed(session.contact.address) else []
        return [pack_candidates(found), [contact.pack() for contact in relays], is_direct and self._relay.has_room]


def _observed_address(contact: Contact, is_fresh: bool) -> list[Address]:
    """Return the source address of a peer, unless the peer uses an additional port."""
    return [contact.address] if not is_fresh and is_possible(contact.address) else []
