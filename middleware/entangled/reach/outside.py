"""Outside: where others see this node, which behind a router is not where it is, and how each is told of the other.

REACH.SEEN tells a peer that its datagrams come from another address than before: it cannot see that itself.
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
"""Seconds for which others' word on where this node is holds beside a newer one."""
SEEN_AFTER, SEEN_GAP = 0.1, 1.0
"""Seconds after which a peer is told that it moved, if it still seems so (who replays what it caught moves nobody for
long), and at least between two times."""
ANCHOR_S = 2.5
"""Seconds without a word from anybody who introduces after which such a one is shown that this node is here: by the
datagram that shows it, it learns where to."""


class Outside:
    """The addresses at which peers see this node.

    ``contacts`` gives the peers that are known.  ``moved`` is called with the peer that told it when this
    node is seen elsewhere than before.  A node ``is_translated`` as soon as one peer saw it at an address that it has
    not.
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
        self._told_at: dict[bytes, float] = {}
        self._shown_until = float("-inf")

    @property
    def addresses(self) -> list[Address]:
        """Where others see this node, the word of the most recent first; two ports of one host: a symmetric router."""
        recent = sorted(self._seen.values(), key=lambda seen: -seen[1])
        return list(dict.fromkeys(address for address, at in recent if recent[0][1] - at < SEEN_S))

    def is_far(self, address: Address) -> bool:
        """Whether others may know more of an address than that it does not answer."""
        if address.host[:1] == "~":
            return is_relayed(address)
        return not is_near(address.host, self._paths.local(address).host, self.is_translated)

    def forget(self, public: bytes) -> None:
        """Forget what a peer told, and what it was told."""
        self._seen.pop(public, None)
        self._told_at.pop(public, None)

    # -- what others tell -------------------------------------------------------------------------------------------

    def answer_seen(self, peer: Contact, host: str, port: int) -> None:
        """REACH.SEEN (told): this node writes from another address than before; ways through its router are lost."""
        if is_possible(Address(host, port)):
            self.saw(peer, Address(host, port), is_told=True)

    def saw(self, peer: Contact, address: Address, is_told: bool = False) -> None:
        """Take note of the address at which a peer sees this node; ``is_told``: because it is another one."""
        before, at = self._seen.get(peer.public, (None, -SEEN_GAP))
        now = self._clock.seconds()
        if now - at < SEEN_GAP or is_relayed(peer.address):
            return
        if self._last == address:
            address = self._last  # one object for all who see it there
        self._last = address
        keep(self._seen, peer.public, (address, now), MAX_KNOWN)
        self.is_translated = self.is_translated or address.host not in self._paths.hosts()
        # By another port of this node itself it is seen elsewhere anyway.
        is_usual = self._paths.local(peer.address).port == self._paths.address.port
        if is_usual and address != before and (is_told or before is not None):
            self._moved(peer)

    # -- what others are told ---------------------------------------------------------------------------------------

    def tell(self, session: Session) -> None:
        """Tell a peer that its address is another one than before: it cannot see that itself."""
        contact, now = session.contact, self._clock.seconds()
        if not self.is_far(contact.address) or is_relayed(contact.address):
            return
        if now - self._told_at.get(contact.public, -SEEN_GAP) < SEEN_GAP:
            return
        keep(self._told_at, contact.public, now, MAX_KNOWN)
        self._chores.later(SEEN_AFTER, self._tell, contact)

    def _tell(self, contact: Contact) -> None:
        session = self._peers.session(contact.public)
        if self._endpoint.is_running and session is not None and session.contact == contact:
            self._endpoint.tell(contact, "reach.seen", contact.address.host, contact.address.port)

    def show(self, now: float) -> None:
        """Where nobody was heard lately who could introduce us, show one that we are here, and so from where."""
        if now <= self._shown_until:
            return
        sessions = [s for c in self._contacts() if (s := self._peers.direct_session(c.public)) is not None]
        sessions.sort(key=lambda session: -session.heard_at)
        latest = next((session for session in sessions if self.is_far(session.contact.address)), None)
        if latest is not None:
            self._shown_until = latest.heard_at + ANCHOR_S
            if now > self._shown_until:
                self._endpoint.send_inside(latest, b"")
