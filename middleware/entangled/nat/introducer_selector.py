"""Select the peers to ask for an introduction to another peer."""

from __future__ import annotations

import random
from collections.abc import Callable, Collection, Iterable

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.bounded import put_bounded
from middleware.entangled.contact import Contact
from middleware.entangled.nat.external_address import ExternalAddresses
from middleware.entangled.nat.known_peers import LIVE_S, MAX_KNOWN
from middleware.entangled.nat.relay_client import RelayClient
from middleware.entangled.network.network import Address, is_relayed
from middleware.entangled.wire.peer import Peers

MAX_INTRODUCERS = 3
"""The number of peers that are asked at the same time for an introduction."""
MAX_NAMERS = 3
"""The number of peers that are remembered for each node because they sent its contact."""


class IntroducerSelector:
    """Selects the peers that may introduce this node, and remembers which peers sent each contact.

    ``contacts`` returns the known contacts; ``bootstrap_addresses`` are the addresses of nodes that are asked first.
    ``rng`` is called on first use and returns the random generator.
    """

    def __init__(
        self,
        own_id: bytes,
        peers: Peers,
        contacts: Callable[[], Iterable[Contact]],
        external: ExternalAddresses,
        relays: RelayClient,
        clock: IReactorTime,
        rng: Callable[[], random.Random],
    ) -> None:
        self.bootstrap_addresses: set[Address] = set()
        self._own_id = own_id
        self._peers = peers
        self._contacts = contacts
        self._external = external
        self._relays = relays
        self._clock = clock
        self._rng = rng
        self._namers: dict[bytes, dict[bytes, None]] = {}

    def __len__(self) -> int:
        return len(self._namers)

    def record_namer(self, contact: Contact, by: Contact) -> None:
        """Remember that the peer ``by`` sent ``contact`` to this node, and may therefore know a path to it."""
        if not self._external.is_far(contact.address):
            return
        namers = self._namers.pop(contact.node_id, None) or {}
        put_bounded(namers, by.public, None, MAX_NAMERS)
        put_bounded(self._namers, contact.node_id, namers, MAX_KNOWN)

    def select(self, wanted: bytes, hinted: Collection[Contact], asked: Collection[bytes]) -> list[Contact]:
        """Return the peers to ask about the node with the id ``wanted``, except those in ``asked``.

        The peers in ``hinted`` are first, followed by the peers that sent the node's contact or relay to it, by
        bootstrap nodes, and by other peers.
        """
        now = self._clock.seconds()
        first = [*hinted]
        for public in [*self._namers.get(wanted, ()), *self._relays.relay_keys(wanted)]:
            first += [session.contact] if (session := self._peers.find_session(public)) is not None else []
        known = list(self._contacts())
        self._rng().shuffle(known)
        known.sort(key=lambda contact: (is_relayed(contact.address), contact.address not in self.bootstrap_addresses))
        found: dict[bytes, Contact] = {}
        for contact in [*first, *known]:
            if contact.public in asked or contact.node_id in (wanted, self._own_id):
                continue
            session = self._peers.find_session(contact.public)
            if session is not None and now - session.last_received_at < LIVE_S:
                found.setdefault(contact.public, session.contact)
            elif contact in hinted:
                found.setdefault(contact.public, contact)
            if len(found) == MAX_INTRODUCERS:
                break
        return list(found.values())
