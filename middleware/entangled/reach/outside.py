"""Keep the external addresses of this node, which differ from its local ones behind a router.

REACH.SEEN notifies a peer that its datagrams come from a new address, which it cannot detect itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.background import Background
from middleware.entangled.bounded import keep
from middleware.entangled.contact import Contact
from middleware.entangled.network.network import Address, is_relayed
from middleware.entangled.reach.candidate import is_near, is_possible
from middleware.entangled.reach.known import MAX_KNOWN
from middleware.entangled.reach.path import PathNetwork
from middleware.entangled.wire.endpoint import Endpoint
from middleware.entangled.wire.session import Session

SEEN_S = 600.0
"""The seconds for which a reported address is used next to a newer one."""
SEEN_AFTER, SEEN_GAP = 0.1, 1.0
"""The delay in seconds of a notification that a peer's address changed, sent if it has not changed back (a replay
changes an address only briefly), and the minimum interval between two."""
ANCHOR_S = 2.5
"""The silence in seconds of all possible introducers after which this node sends one of them a datagram, which keeps
its NAT mapping open and shows its current address."""


class Outside:
    """The addresses at which peers see this node.

    ``contacts`` returns the known contacts.  ``moved`` is called with the reporting peer when the external address
    changed.  A node ``is_translated`` as soon as one peer saw it at an address that is not one of its interfaces.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        paths: PathNetwork,
        contacts: Callable[[], Iterable[Contact]],
        moved: Callable[[Contact], None],
        clock: IReactorTime,
        chores: Background,
    ) -> None:
        self.is_translated = False
        self._moved = moved
        self._endpoint = endpoint
        self._peers = endpoint.peers
        self._paths = paths
        self._contacts = contacts
        self._clock = clock
        self._chores = chores
        self._seen: dict[bytes, tuple[Address, float]] = {}
        self._last: Address | None = None
        self._notified_at: dict[bytes, float] = {}
        self._quiet_until = float("-inf")

    @property
    def addresses(self) -> list[Address]:
        """The external addresses, the latest reported first; two ports of one host indicate a symmetric NAT."""
        recent = sorted(self._seen.values(), key=lambda seen: -seen[1])
        return list(dict.fromkeys(address for address, at in recent if recent[0][1] - at < SEEN_S))

    def is_far(self, address: Address) -> bool:
        """Return whether other nodes may know another path to an address that does not answer."""
        if address.host[:1] == "~":
            return is_relayed(address)
        return not is_near(address.host, self._paths.local(address).host, self.is_translated)

    def forget(self, public: bytes) -> None:
        """Delete the state of a peer."""
        self._seen.pop(public, None)
        self._notified_at.pop(public, None)

    # -- reports of peers -------------------------------------------------------------------------------------------

    def answer_seen(self, peer: Contact, host: str, port: int) -> None:
        """REACH.SEEN: this node's address changed, so the NAT mappings of its other paths are lost."""
        if is_possible(Address(host, port)):
            self.saw(peer, Address(host, port), is_told=True)

    def saw(self, peer: Contact, address: Address, is_told: bool = False) -> None:
        """Record the address at which a peer sees this node; ``is_told``: the peer reports a change."""
        before, at = self._seen.get(peer.public, (None, -SEEN_GAP))
        now = self._clock.seconds()
        if now - at < SEEN_GAP or is_relayed(peer.address):
            return
        if self._last == address:
            address = self._last  # share one object between all peers
        self._last = address
        keep(self._seen, peer.public, (address, now), MAX_KNOWN)
        self.is_translated = self.is_translated or address.host not in self._paths.hosts()
        # From an additional port of this node its address differs anyway.
        is_usual = self._paths.local(peer.address).port == self._paths.address.port
        if is_usual and address != before and (is_told or before is not None):
            self._moved(peer)

    # -- reports to peers -------------------------------------------------------------------------------------------

    def tell(self, session: Session) -> None:
        """Notify a peer that its address changed, which it cannot detect itself."""
        contact, now = session.contact, self._clock.seconds()
        if not self.is_far(contact.address) or is_relayed(contact.address):
            return
        if now - self._notified_at.get(contact.public, -SEEN_GAP) < SEEN_GAP:
            return
        keep(self._notified_at, contact.public, now, MAX_KNOWN)
        self._chores.later(SEEN_AFTER, self._notify, contact)

    def _notify(self, contact: Contact) -> None:
        session = self._peers.session(contact.public)
        if self._endpoint.is_running and session is not None and session.contact == contact:
            self._endpoint.tell(contact, "reach.seen", contact.address.host, contact.address.port)

    def show(self, now: float) -> None:
        """Send a datagram to a possible introducer if none was heard lately, which shows this node's address."""
        if now <= self._quiet_until:
            return
        sessions = [s for c in self._contacts() if (s := self._peers.direct_session(c.public)) is not None]
        sessions.sort(key=lambda session: -session.heard_at)
        latest = next((session for session in sessions if self.is_far(session.contact.address)), None)
        if latest is not None:
            self._quiet_until = latest.heard_at + ANCHOR_S
            if now > self._quiet_until:
                self._endpoint.send_inside(latest, b"")
