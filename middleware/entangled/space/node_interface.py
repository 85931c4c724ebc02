"""The interface of a node to its tuple spaces; ``EntangledNode`` implements it.

A tuple space reads and writes records, finds the nodes closest to a key, and calls their methods.
"""

from __future__ import annotations

from typing import Any, Protocol

from twisted.internet.defer import Deferred

from middleware.entangled.contact import Contact
from middleware.entangled.data.store import Store
from middleware.entangled.identity import Identity
from middleware.entangled.record import Record
from middleware.entangled.replication.owner import Stored
from middleware.entangled.replication.watch import OnChanged, Watch
from middleware.entangled.space.take_acceptor import TakeAcceptor


class MethodCaller(Protocol):
    """An endpoint that calls methods of peers."""

    def ask(self, contact: Contact, method: str, *arguments: object, changes: bool = False) -> Deferred[Any]:
        """Call ``method`` of ``contact``; fire with its answer, or fail with an ``EntangledError``."""


class RecordAccess(Protocol):
    """The records of a node and of its network."""

    def put(self, key: bytes, name: str, value: bytes) -> Deferred[Stored]:
        """Write the record ``name`` of this node under ``key``."""

    def remove(self, key: bytes, name: str) -> Deferred[Stored]:
        """Replace the record ``name`` of this node under ``key`` by a tombstone."""

    def get(self, key: bytes) -> Deferred[list[Record]]:
        """Read all records under ``key``."""

    def watch(self, key: bytes, changed: OnChanged) -> Watch:
        """Call ``changed`` with all records of ``key`` on each change."""

    def refresh(self, watch: Watch) -> None:
        """Poll the replicas of a watched key now."""


class NodeInterface(RecordAccess, Protocol):
    """A node that takes tuples and is a member of councils."""

    @property
    def identity(self) -> Identity:
        """The node's key pair."""

    @property
    def contact(self) -> Contact:
        """The node's public key and address."""

    @property
    def store(self) -> Store:
        """The records and notes that the node stores."""

    @property
    def endpoint(self) -> MethodCaller:
        """The node's endpoint."""

    @property
    def take_acceptor(self) -> TakeAcceptor:
        """The node's acceptor for takes."""

    def find_node(self, node_id: bytes) -> Deferred[list[Contact]]:
        """Look up the k live nodes closest to ``node_id``."""

    def find_newest(self, contact: Contact) -> Contact:
        """Return ``contact`` with the last address at which it was observed."""
