"""Store bounded state of other nodes for NAT traversal."""

from __future__ import annotations

from middleware.entangled.bounded import put_bounded
from middleware.entangled.identity import derive_node_id
from middleware.entangled.wire.peer import MAX_PEERS, Peers
from middleware.entangled.wire.session import Session

LIVE_S = 20.0
"""A peer is asked for help only if its latest datagram arrived within this number of seconds."""
MAX_KNOWN = 1024
"""The number of peers for which introducers, relays and similar state are remembered."""


class KnownPeers:
    """Maps the ids of peers that have a session, or will have one soon, to their public keys."""

    def __init__(self, peers: Peers) -> None:
        self._peers = peers
        self._publics: dict[bytes, bytes] = {}

    def __len__(self) -> int:
        return len(self._publics)

    def add(self, public: bytes) -> None:
        """Add a peer."""
        put_bounded(self._publics, derive_node_id(public), public, MAX_PEERS)

    def forget(self, public: bytes) -> None:
        """Delete a peer."""
        self._publics.pop(derive_node_id(public), None)

    def find_session(self, wanted: bytes) -> Session | None:
        """Return the newest session with the node of that id."""
        return self._peers.find_session(self._publics.get(wanted, b""))

    def find_direct_session(self, wanted: bytes) -> Session | None:
        """Return the newest session with the node of that id that is not relayed."""
        return self._peers.find_direct_session(self._publics.get(wanted, b""))
