"""Way: by which way each peer is reached, since when, and which of the ways go through a hole in the own router."""

from __future__ import annotations

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.bounded import keep
from middleware.entangled.contact import Contact
from middleware.entangled.network.network import is_relayed
from middleware.entangled.reach.carrier import Carriers
from middleware.entangled.reach.known import MAX_KNOWN
from middleware.entangled.reach.outside import Outside
from middleware.entangled.reach.passage import Kind, Passage, kind_of
from middleware.entangled.reach.path import PathNetwork
from middleware.entangled.wire.peer import Peers
from middleware.entangled.wire.session import Session

HELD_S = 5.0
"""Seconds for which a handshake goes on that others help with."""
OPENED = 64
"""Sessions that are opened anew when this node's address changed."""
MAX_FRESH = 16
"""Fresh local ports at the same time."""
SHUT_S = 60.0
"""Seconds after which a fresh port is closed where no session goes by it."""


class Ways:
    """The ways to peers with which there are, or were, sessions."""

    def __init__(
        self, peers: Peers, paths: PathNetwork, outside: Outside, carriers: Carriers, clock: IReactorTime
    ) -> None:
        self._peers = peers
        self._paths = paths
        self._outside = outside
        self._carriers = carriers
        self._clock = clock
        self._passages: dict[bytes, tuple[Kind, float]] = {}
        self._introduced_at: dict[bytes, float] = {}
        self._holes: dict[bytes, None] = {}

    def passage(self, contact: Contact) -> Passage:
        """How a peer is reached now, by whom, and since when."""
        session = self._peers.session(contact.public)
        if session is None:
            return Passage("none")
        kind = self._kind(session)
        noted, since = self._passages.get(contact.public, (kind, session.opened_at))
        carrier = self._carriers.session(contact.node_id) if kind == "carried" else None
        by = b"" if carrier is None else carrier.contact.node_id
        return Passage(kind, session.contact.address, by, since if noted == kind else session.opened_at)

    def needs_use(self, contact: Contact) -> bool:
        """Whether the way to a peer is open for only so long as it is used: routers forget whom they let in."""
        kind, _ = self._passages.get(contact.public, ("none", 0.0))
        return self._outside.is_translated or contact.address.is_virtual or kind == "punched"

    @property
    def has_holes(self) -> bool:
        """Whether any way goes, or went lately, through a hole in the own router."""
        return bool(self._holes)

    def uses(self, port: int) -> bool:
        """Whether a session through a hole in the own router goes by this local port."""
        for public in self._holes:
            session = self._peers.direct_session(public)
            if session is not None and self._paths.local(session.contact.address).port == port:
                return True
        return False

    # -- what happens to them ---------------------------------------------------------------------------------------

    def introduced(self, public: bytes) -> None:
        """Take note that somebody introduces this node and a peer to each other now."""
        keep(self._introduced_at, public, self._clock.seconds(), MAX_KNOWN)

    def established(self, session: Session) -> None:
        """Take note of a session that is used from now on."""
        self._note_passage(session)
        address = session.contact.address
        if not is_relayed(address) and self._outside.is_far(address):
            keep(self._holes, session.contact.public, None, MAX_KNOWN)

    def open_again(self, teller: bytes) -> None:
        """Open the sessions anew that went through a hole in the own router, the newest ones of them at least.

        All but the one with ``teller``, who said that this node is seen elsewhere.
        """
        for public in list(reversed(self._holes))[:OPENED]:
            peer = self._peers.known(public)
            if peer is None or peer.session is None:
                del self._holes[public]
            elif public != teller:
                self._peers.open(peer, peer.session.contact.address)

    def lost(self, contact: Contact) -> None:
        """Forget since when a peer was reached: it is no more."""
        self._passages.pop(contact.public, None)

    def forget(self, public: bytes) -> None:
        """Forget a peer with which there is no session."""
        for table in (self._passages, self._introduced_at, self._holes):
            table.pop(public, None)

    def _note_passage(self, session: Session) -> None:
        """Take note since when a peer is reached as it is now; a successor of a session changes nothing of that."""
        public = session.contact.public
        peer = self._peers.known(public)
        if peer is None or peer.session is not session:
            return  # the one that was there is used on
        kind, noted = self._kind(session), self._passages.get(public)
        if noted is None and len(peer.sessions) > 1:
            former = peer.sessions[-2]
            noted = (self._kind(former), former.opened_at)
        if noted is not None or kind == "punched":  # else the session itself says it
            since = noted[1] if noted is not None and noted[0] == kind else self._clock.seconds()
            keep(self._passages, public, (kind, since), MAX_KNOWN)

    def _kind(self, session: Session) -> Kind:
        contact = session.contact
        own = contact.address if contact.address.is_virtual else self._paths.local(contact.address)
        before, _ = self._passages.get(contact.public, ("none", 0.0))
        introduced_at = self._introduced_at.get(contact.public, float("-inf"))
        was_introduced = before == "punched" or abs(session.opened_at - introduced_at) < HELD_S
        return kind_of(contact.address, own, self._outside.is_translated, was_introduced)


class FreshPorts:
    """Further local ports, from which a node knocks where early knocks may have spoilt its usual one."""

    def __init__(self, paths: PathNetwork, ways: Ways, clock: IReactorTime) -> None:
        self._paths = paths
        self._ways = ways
        self._clock = clock
        self._opened_at: dict[int, float] = {}

    def __len__(self) -> int:
        return len(self._opened_at)

    def __contains__(self, port: int) -> bool:
        return port in self._opened_at

    def open(self) -> int:
        """A fresh local port; 0 where there are too many."""
        now = self._clock.seconds()
        if len(self._opened_at) >= MAX_FRESH:
            unused = self._unused_since(now - HELD_S)
            if not unused:
                return 0
            self._shut(unused[0])
        port = self._paths.open_port()
        if port:
            self._opened_at[port] = now
        return port

    def shut_unused(self, now: float) -> None:
        """Close those that were opened long ago, and by which no session goes."""
        for port in self._unused_since(now - SHUT_S):
            self._shut(port)

    def _unused_since(self, before: float) -> list[int]:
        """Those by which no session goes though they were opened before that moment, the oldest first."""
        return [port for port, at in self._opened_at.items() if at < before and not self._ways.uses(port)]

    def _shut(self, port: int) -> None:
        del self._opened_at[port]
        self._paths.shut_port(port)
