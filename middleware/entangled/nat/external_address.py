"""Track the external addresses of this node; behind a router they differ from its local addresses.

With REACH.SEEN a node notifies a peer that the peer's datagrams come from a new address, which the peer cannot detect.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background
from middleware.entangled.bounded import put_bounded
from middleware.entangled.contact import Contact
from middleware.entangled.nat.candidate import is_near, is_possible
from middleware.entangled.nat.known_peers import MAX_KNOWN
from middleware.entangled.nat.relayed_network import RelayedNetwork
from middleware.entangled.network.network import Address, is_relayed
from middleware.entangled.wire.endpoint import Endpoint
from middleware.entangled.wire.session import Session

REPORT_TTL_S = 600.0
"""The seconds for which a reported address is still used after a newer address was reported."""
NOTIFY_DELAY_S, NOTIFY_INTERVAL_S = 0.1, 1.0
"""The delay of a notification that a peer's address changed, and the minimum interval between two notifications, in
seconds.  After the delay the notification is sent only if the address has not changed back: a replayed datagram changes
an address only briefly."""
KEEP_ALIVE_S = 2.5
"""If all possible introducers were silent for this number of seconds, this node sends a datagram to one of them.  The
datagram keeps this node's NAT mapping open and informs the introducer of this node's current address."""


class ExternalAddresses:
    """The addresses at which peers see this node.

    ``contacts`` returns the known contacts.  ``on_changed`` is called with the reporting peer when the external address
    changed.  A node ``is_translated`` as soon as a peer has reported an address that none of the node's interfaces has.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        network: RelayedNetwork,
        contacts: Callable[[], Iterable[Contact]],
        on_changed: Callable[[Contact], None],
        clock: IReactorTime,
        background: Background,
    ) -> None:
        self.is_translated = False
        self._on_changed = on_changed
        self._endpoint = endpoint
        self._peers = endpoint.peers
        self._network = network
        self._contacts = contacts
        self._clock = clock
        self._background = background
        self._reports: dict[bytes, tuple[Address, float]] = {}
        self._last: Address | None = None
        self._notified_at: dict[bytes, float] = {}
        self._quiet_until = float("-inf")

    @property
    def addresses(self) -> list[Address]:
        """The external addresses, the latest reported first; two ports of one host indicate a symmetric NAT."""
        recent = sorted(self._reports.values(), key=lambda seen: -seen[1])
        return list(dict.fromkeys(address for address, at in recent if recent[0][1] - at < REPORT_TTL_S))

    def is_far(self, address: Address) -> bool:
        """Return whether other nodes may know a different path to the peer at an address that does not answer."""
        if address.host[:1] == "~":
            return is_relayed(address)
        return not is_near(address.host, self._network.source_address(address).host, self.is_translated)

    def forget(self, public: bytes) -> None:
        """Delete the state of a peer."""
        self._reports.pop(public, None)
        self._notified_at.pop(public, None)

    # -- reports of peers -------------------------------------------------------------------------------------------

    def answer_seen(self, peer: Contact, host: str, port: int) -> None:
        """Answer REACH.SEEN: this node's address changed, so the NAT mappings of its other paths are lost."""
        if is_possible(Address(host, port)):
            self.record(peer, Address(host, port), is_change=True)

    def record(self, peer: Contact, address: Address, is_change: bool = False) -> None:
        """Record the address at which a peer sees this node; ``is_change``: the peer reports a change."""
        before, at = self._reports.get(peer.public, (None, -NOTIFY_INTERVAL_S))
        now = self._clock.seconds()
        if now - at < NOTIFY_INTERVAL_S or is_relayed(peer.address):
            return
        if self._last == address:
            address = self._last  # share one object between all peers
        self._last = address
        put_bounded(self._reports, peer.public, (address, now), MAX_KNOWN)
        self.is_translated = self.is_translated or address.host not in self._network.local_hosts()
        # Datagrams from an additional port of this node have a different external address in any case.
        is_usual = self._network.source_address(peer.address).port == self._network.address.port
        if is_usual and address != before and (is_change or before is not None):
            self._on_changed(peer)

    # -- reports to peers -------------------------------------------------------------------------------------------

    def report_change(self, session: Session) -> None:
        """Notify a peer that its address changed, which the peer cannot detect."""
        contact, now = session.contact, self._clock.seconds()
        if not self.is_far(contact.address) or is_relayed(contact.address):
            return
        if now - self._notified_at.get(contact.public, -NOTIFY_INTERVAL_S) < NOTIFY_INTERVAL_S:
            return
        put_bounded(self._notified_at, contact.public, now, MAX_KNOWN)
        self._background.later(NOTIFY_DELAY_S, self._notify, contact)

    def _notify(self, contact: Contact) -> None:
        session = self._peers.find_session(contact.public)
        if self._endpoint.is_running and session is not None and session.contact == contact:
            self._endpoint.notify(contact, "reach.seen", contact.address.host, contact.address.port)

    def keep_mapping_open(self, now: float) -> None:
        """If all possible introducers were silent recently, send one a datagram to keep the NAT mapping open."""
        if now <= self._quiet_until:
            return
        sessions = [s for c in self._contacts() if (s := self._peers.find_direct_session(c.public)) is not None]
        sessions.sort(key=lambda session: -session.last_received_at)
        latest = next((session for session in sessions if self.is_far(session.contact.address)), None)
        if latest is not None:
            self._quiet_until = latest.last_received_at + KEEP_ALIVE_S
            if now > self._quiet_until:
                self._endpoint.send_sealed(latest, b"")
