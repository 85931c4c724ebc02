"""Track the path to each peer, how long it has been in use, and which paths use NAT mappings."""

from __future__ import annotations

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.bounded import put_bounded
from middleware.entangled.contact import Contact
from middleware.entangled.nat.external_address import ExternalAddresses
from middleware.entangled.nat.known_peers import MAX_KNOWN
from middleware.entangled.nat.path_kind import PathKind, PeerPath, classify_path
from middleware.entangled.nat.relay_client import RelayClient
from middleware.entangled.nat.relayed_network import RelayedNetwork
from middleware.entangled.network.network import is_relayed
from middleware.entangled.wire.peer import Peers
from middleware.entangled.wire.session import Session

EXTENSION_S = 5.0
"""The seconds for which a handshake continues while introducers and relays help."""
MAX_REOPENED = 64
"""The maximum number of sessions that are reopened when this node's address changes."""
MAX_PORTS = 16
"""The maximum number of additional local ports."""
UNUSED_PORT_S = 60.0
"""The seconds after which an additional port without a session is closed."""


class PathTracker:
    """The paths to peers that have or had a session."""

    def __init__(
        self,
        peers: Peers,
        network: RelayedNetwork,
        external: ExternalAddresses,
        relays: RelayClient,
        clock: IReactorTime,
    ) -> None:
        self._peers = peers
        self._network = network
        self._external = external
        self._relays = relays
        self._clock = clock
        self._path_kinds: dict[bytes, tuple[PathKind, float]] = {}
        self._introduced_at: dict[bytes, float] = {}
        self._mapped_peers: dict[bytes, None] = {}

    def find_path(self, contact: Contact) -> PeerPath:
        """Return the current path to a peer, with its relay and the time since which it is used."""
        session = self._peers.find_session(contact.public)
        if session is None:
            return PeerPath("none")
        kind = self._classify(session)
        noted, since = self._path_kinds.get(contact.public, (kind, session.opened_at))
        relay = self._relays.find_session(contact.node_id) if kind == "carried" else None
        by = b"" if relay is None else relay.contact.node_id
        return PeerPath(kind, session.contact.address, by, since if noted == kind else session.opened_at)

    def needs_keep_alive(self, contact: Contact) -> bool:
        """Return whether the path to a peer closes when it is unused, because NAT mappings expire."""
        kind, _ = self._path_kinds.get(contact.public, ("none", 0.0))
        return self._external.is_translated or contact.address.is_virtual or kind == "punched"

    @property
    def has_nat_mappings(self) -> bool:
        """Whether any path uses, or recently used, a NAT mapping of this node's router."""
        return bool(self._mapped_peers)

    def is_port_used(self, port: int) -> bool:
        """Return whether a session through a NAT mapping uses this local port."""
        for public in self._mapped_peers:
            session = self._peers.find_direct_session(public)
            if session is not None and self._network.source_address(session.contact.address).port == port:
                return True
        return False

    # -- events -----------------------------------------------------------------------------------------------------

    def record_introduction(self, public: bytes) -> None:
        """Record that this node and a peer are being introduced."""
        put_bounded(self._introduced_at, public, self._clock.seconds(), MAX_KNOWN)

    def record_session(self, session: Session) -> None:
        """Record a new session."""
        self._record_path(session)
        address = session.contact.address
        if not is_relayed(address) and self._external.is_far(address):
            put_bounded(self._mapped_peers, session.contact.public, None, MAX_KNOWN)

    def reopen(self, reporter: bytes) -> None:
        """Reopen the latest sessions through NAT mappings, after ``reporter`` reported a new address of this node.

        The session with ``reporter`` is not reopened.
        """
        for public in list(reversed(self._mapped_peers))[:MAX_REOPENED]:
            peer = self._peers.get(public)
            if peer is None or peer.session is None:
                del self._mapped_peers[public]
            elif public != reporter:
                self._peers.open(peer, peer.session.contact.address)

    def forget_path(self, contact: Contact) -> None:
        """Forget the path to a peer that has left or does not answer."""
        self._path_kinds.pop(contact.public, None)

    def forget(self, public: bytes) -> None:
        """Delete the state of a peer without a session."""
        for table in (self._path_kinds, self._introduced_at, self._mapped_peers):
            table.pop(public, None)

    def _record_path(self, session: Session) -> None:
        """Record when the path to a peer changed its kind; a renewed session of the same kind changes nothing."""
        public = session.contact.public
        peer = self._peers.get(public)
        if peer is None or peer.session is not session:
            return  # the existing session is still in use
        kind, noted = self._classify(session), self._path_kinds.get(public)
        if noted is None and len(peer.sessions) > 1:
            former = peer.sessions[-2]
            noted = (self._classify(former), former.opened_at)
        if noted is not None or kind == "punched":  # for any other path, the session determines the kind
            since = noted[1] if noted is not None and noted[0] == kind else self._clock.seconds()
            put_bounded(self._path_kinds, public, (kind, since), MAX_KNOWN)

    def _classify(self, session: Session) -> PathKind:
        contact = session.contact
        own = contact.address if contact.address.is_virtual else self._network.source_address(contact.address)
        before, _ = self._path_kinds.get(contact.public, ("none", 0.0))
        introduced_at = self._introduced_at.get(contact.public, float("-inf"))
        was_introduced = before == "punched" or abs(session.opened_at - introduced_at) < EXTENSION_S
        return classify_path(contact.address, own, self._external.is_translated, was_introduced)


class AdditionalPorts:
    """Additional local ports for hole punching, used if early INITs may have made the usual port unusable."""

    def __init__(self, network: RelayedNetwork, tracker: PathTracker, clock: IReactorTime) -> None:
        self._network = network
        self._tracker = tracker
        self._clock = clock
        self._opened_at: dict[int, float] = {}

    def __len__(self) -> int:
        return len(self._opened_at)

    def __contains__(self, port: int) -> bool:
        return port in self._opened_at

    def open(self) -> int:
        """Open an additional local port and return it; 0 if there are too many."""
        now = self._clock.seconds()
        if len(self._opened_at) >= MAX_PORTS:
            unused = self._unused_since(now - EXTENSION_S)
            if not unused:
                return 0
            self._close(unused[0])
        port = self._network.open_port()
        if port:
            self._opened_at[port] = now
        return port

    def close_unused(self, now: float) -> None:
        """Close the ports that were opened long ago and have no session."""
        for port in self._unused_since(now - UNUSED_PORT_S):
            self._close(port)

    def _unused_since(self, before: float) -> list[int]:
        """Return the ports without a session that were opened before the time ``before``, the oldest first."""
        return [port for port, at in self._opened_at.items() if at < before and not self._tracker.is_port_used(port)]

    def _close(self, port: int) -> None:
        del self._opened_at[port]
        self._network.close_port(port)
