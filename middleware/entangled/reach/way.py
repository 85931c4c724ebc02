"""Track the path to each peer, its duration, and the paths through NAT mappings."""

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
"""The seconds for which a handshake continues while other nodes help."""
OPENED = 64
"""The number of sessions that are reopened when this node's address changes."""
MAX_FRESH = 16
"""The maximum number of additional local ports."""
SHUT_S = 60.0
"""The seconds after which an additional port without a session is closed."""


class Ways:
    """The paths to peers with present or former sessions."""

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
        """Return the path to a peer at present, with its relay and its start."""
        session = self._peers.session(contact.public)
        if session is None:
            return Passage("none")
        kind = self._kind(session)
        noted, since = self._passages.get(contact.public, (kind, session.opened_at))
        carrier = self._carriers.session(contact.node_id) if kind == "carried" else None
        by = b"" if carrier is None else carrier.contact.node_id
        return Passage(kind, session.contact.address, by, since if noted == kind else session.opened_at)

    def needs_use(self, contact: Contact) -> bool:
        """Return whether the path to a peer stays open only while it is used, because NAT mappings expire."""
        kind, _ = self._passages.get(contact.public, ("none", 0.0))
        return self._outside.is_translated or contact.address.is_virtual or kind == "punched"

    @property
    def has_holes(self) -> bool:
        """Whether any path uses, or recently used, a NAT mapping of this node's router."""
        return bool(self._holes)

    def uses(self, port: int) -> bool:
        """Return whether a session through a NAT mapping uses this local port."""
        for public in self._holes:
            session = self._peers.direct_session(public)
            if session is not None and self._paths.local(session.contact.address).port == port:
                return True
        return False

    # -- events -----------------------------------------------------------------------------------------------------

    def introduced(self, public: bytes) -> None:
        """Record that this node and a peer are being introduced."""
        keep(self._introduced_at, public, self._clock.seconds(), MAX_KNOWN)

    def established(self, session: Session) -> None:
        """Record a new session."""
        self._note_passage(session)
        address = session.contact.address
        if not is_relayed(address) and self._outside.is_far(address):
            keep(self._holes, session.contact.public, None, MAX_KNOWN)

    def open_again(self, teller: bytes) -> None:
        """Reopen the latest sessions through NAT mappings, except the one with ``teller``, which reported it."""
        for public in list(reversed(self._holes))[:OPENED]:
            peer = self._peers.known(public)
            if peer is None or peer.session is None:
                del self._holes[public]
            elif public != teller:
                self._peers.open(peer, peer.session.contact.address)

    def lost(self, contact: Contact) -> None:
        """Forget the path to a peer that is gone."""
        self._passages.pop(contact.public, None)

    def forget(self, public: bytes) -> None:
        """Delete the state of a peer without a session."""
        for table in (self._passages, self._introduced_at, self._holes):
            table.pop(public, None)

    def _note_passage(self, session: Session) -> None:
        """Record the start of the present kind of path; a renewed session does not change it."""
        public = session.contact.public
        peer = self._peers.known(public)
        if peer is None or peer.session is not session:
            return  # the existing session is still in use
        kind, noted = self._kind(session), self._passages.get(public)
        if noted is None and len(peer.sessions) > 1:
            former = peer.sessions[-2]
            noted = (self._kind(former), former.opened_at)
        if noted is not None or kind == "punched":  # otherwise the session has this information
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
    """Additional local ports for hole punching, if early INITs may have spoilt the usual port."""

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
        """Open an additional local port and return it; 0 if there are too many."""
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
        """Close the ports that were opened long ago and have no session."""
        for port in self._unused_since(now - SHUT_S):
            self._shut(port)

    def _unused_since(self, before: float) -> list[int]:
        """Return the ports without a session that were opened before a time, the oldest first."""
        return [port for port, at in self._opened_at.items() if at < before and not self._ways.uses(port)]

    def _shut(self, port: int) -> None:
        del self._opened_at[port]
        self._paths.shut_port(port)
