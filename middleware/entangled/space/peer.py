"""The interface through which a tuple space uses a node; ``EntangledNode`` implements it.

The space reads and writes records, finds the nodes closest to a key and asks them; it needs to know nothing else.
"""

from __future__ import annotations

from typing import Any, Protocol

from twisted.internet.defer import Deferred

from middleware.entangled.contact import Contact
from middleware.entangled.data.store import Store
from middleware.entangled.identity import Identity
from middleware.entangled.record import Record
from middleware.entangled.replication.owner import Stored
from middleware.entangled.replication.watch import Changed, Watch
from middleware.entangled.space.seat import Seat


class Asking(Protocol):
    """An endpoint that asks peers."""

    def ask(self, contact: Contact, method: str, *arguments: object, changes: bool = False) -> Deferred[Any]:
        """Ask ``contact``; the Deferred fires with its answer, or fails with an ``EntangledError``."""


class Records(Protocol):
    """The records of a node and of its network."""

    def put(self, key: bytes, name: str, value: bytes) -> Deferred[Stored]:
        """Write the record ``name`` of this node under ``key``."""

    def remove(self, key: bytes, name: str) -> Deferred[Stored]:
        """Write a tombstone in its place."""

    def get(self, key: bytes) -> Deferred[list[Record]]:
        """Read all records under ``key``."""

    def watch(self, key: bytes, changed: Changed) -> Watch:
        """Call ``changed`` with all records of ``key`` whenever they differ."""

    def refresh(self, watch: Watch) -> None:
        """Poll the replicas of a watched key now."""


class Peer(Records, Protocol):
    """A node that takes tuples and sits in councils."""

    @property
    def identity(self) -> Identity:
        """Its key pair."""

    @property
    def contact(self) -> Contact:
        """Its public key and address."""

    @property
    def store(self) -> Store:
        """The records and notes that it holds."""

    @property
    def endpoint(self) -> Asking:
        """Its endpoint."""

    @property
    def seat(self) -> Seat:
        """Its acceptor of takes."""

    def find_node(self, node_id: bytes) -> Deferred[list[Contact]]:
        """Look up the k live nodes closest to ``node_id``."""

    def newest(self, contact: Contact) -> Contact:
        """Return the node of ``contact`` with the last address it was heard from."""
