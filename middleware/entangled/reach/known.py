"""Known: what is kept of other nodes, none of it without end."""

from __future__ import annotations

from middleware.entangled.bounded import keep
from middleware.entangled.identity import node_id
from middleware.entangled.wire.peer import MAX_PEERS, Peers
from middleware.entangled.wire.session import Session

LIVELY_S = 20.0
"""Seconds since a peer was heard for which it is worth asking."""
MAX_KNOWN = 1024
"""Peers of which is kept who named them, who carries to them, and the like."""


class Known:
    """Who has which id: peers with which this node has, or shall have, a session."""

    def __init__(self, peers: Peers) -> None:
        self._peers = peers
        self._publics: dict[bytes, bytes] = {}

    def __len__(self) -> int:
        return len(self._publics)

    def note(self, public: bytes) -> None:
        """Take note of a peer."""
        keep(self._publics, node_id(public), public, MAX_PEERS)

    def forget(self, public: bytes) -> None:
        """Forget a peer."""
        self._publics.pop(node_id(public), None)

    def session(self, wanted: bytes) -> Session | None:
        """The newest session with the node of that id."""
        return self._peers.session(self._publics.get(wanted, b""))

    def direct_session(self, wanted: bytes) -> Session | None:
        """The newest session with the node of that id that no other node carries."""
        return self._peers.direct_session(self._publics.get(wanted, b""))
