"""EntangledNode: the public interface of the peer-to-peer library.

The node connects the parts of the library.  ``overlay`` and ``membership`` find the other nodes; ``replica`` and
``handover`` store the records of other owners; ``owner`` maintains the node's own records; ``reader`` and
``subscriber`` read and watch records.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Coroutine, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import msgpack
from twisted.internet.defer import Deferred, fail
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from middleware.entangled.background import Background
from middleware.entangled.contact import Contact, parse_contact
from middleware.entangled.data.store import Store
from middleware.entangled.errors import NotRunning, Refused, TooLarge
from middleware.entangled.identity import Identity, derive_node_id
from middleware.entangled.kademlia.lan_discovery import LanDiscovery
from middleware.entangled.kademlia.membership import Membership
from middleware.entangled.kademlia.overlay import Overlay
from middleware.entangled.nat.relayed_network import RelayedNetwork
from middleware.entangled.nat.traversal import NatTraversal
from middleware.entangled.network.multicast import Multicast
from middleware.entangled.network.network import Address, Network, find_alternate_paths
from middleware.entangled.record import (
    KEY_BYTES,
    MAX_NAME_BYTES,
    MAX_VALUE_BYTES,
    TOLERATED_ABSENCE_S,
    Lifetime,
    Record,
    Slot,
)
from middleware.entangled.replication.handover import Handover
from middleware.entangled.replication.owner import ConsistencyLevel, Owner, Stored
from middleware.entangled.replication.reader import ReadConsistency, Reader
from middleware.entangled.replication.replica import Replica
from middleware.entangled.replication.subscriber import Subscriber
from middleware.entangled.replication.watch import OnChanged, Watch
from middleware.entangled.wire.admission_check import (
    DOUBLED,
    OPEN_ADMISSION,
    REVOKED,
    ROLE,
    SUPERSEDED,
    AdmissionCheck,
    explain,
)
from middleware.entangled.wire.endpoint import Endpoint

if TYPE_CHECKING:
    from middleware.entangled.space.take_acceptor import TakeAcceptor

NOTE_INTERVAL_S = 30.0
"""Seconds between two notes in the store of the time and the contacts; a new or lost contact is noted immediately."""
CONTACTS_NOTE = "contacts"
LAST_SEEN_NOTE = "last seen"
INCARNATION_NOTE = "decree/incarnation"
"""The name of a note that exists if the node was a member of councils of tuples before its restart."""
MAX_NOTED_CONTACTS = 64

Answers = TypeVar("Answers", bound=Callable[..., object])


class EntangledNode:
    """One node of the network; it runs once, from ``start`` to ``stop``.

    ``lease`` is the time in seconds after which leased records expire when the node is silent.  With a higher value,
    fewer live nodes are considered failed; with a lower value, failures are detected sooner.  ``rng`` and ``clock`` are
    the only sources of randomness and time.  ``wall`` returns seconds that continue while the node is off, to measure
    its absence (None: assume a short absence).  ``admission`` is the admission check.  ``lan`` is the multicast group
    in which the node finds its team if it has no known nodes.
    """

    _log = Logger()

    def __init__(
        self,
        identity: Identity,
        team_key: bytes,
        network: Network,
        store: Store,
        clock: IReactorTime,
        rng: random.Random,
        lease: float = 1.0,
        wall: Callable[[], float] | None = None,
        admission: AdmissionCheck = OPEN_ADMISSION,
        lan: Multicast | None = None,
    ) -> None:
        self.identity = identity
        self.store = store
        self.lease = lease
        self._network = network
        self._wall = wall
        self._background = background = Background(clock)
        paths = RelayedNetwork(network)
        self.endpoint = Endpoint(identity, team_key, paths, clock, rng, admission)
        self.overlay = Overlay(lambda: self.contact, self.endpoint, clock, background)
        self.nat = NatTraversal(identity.node_id, self.endpoint, paths, self.overlay.contacts, clock, background)
        self.overlay.on_named.add(self.nat.selector.record_namer)
        self.replica = Replica(store, self.endpoint, self.overlay, clock, background)
        self._owner = Owner(identity, lease, store, self.replica, self.overlay, self.endpoint, clock, background)
        self._membership = membership = Membership(self.overlay, self.endpoint, clock, rng, background)
        membership.prober.needs_keep_alive = self.nat.paths.needs_keep_alive
        self._alternate_paths = membership.alternate_paths
        self.discovery = (
            None if lan is None else LanDiscovery(lan, self.endpoint, self.overlay, membership, clock, rng, background)
        )
        self._handover = Handover(store, self.replica, self.overlay, self._owner, self.endpoint, clock, rng, background)
        self._reader = Reader(self.replica, self.overlay, self._owner, background)
        self._subscriber = Subscriber(
            identity.node_id, self.replica, self.overlay, self._reader, self.endpoint, clock, background
        )
        self.replica.is_synced = self._handover.is_synced
        self._acceptor_arguments = (clock, rng)
        self.endpoint.expose("decree.enrol", self._answer_enrol)
        self.overlay.on_new_contact.add(self._handle_new_contact)
        self.overlay.on_lost.add(self._handle_lost_contact)
        self.replica.on_record.add(self._handle_stored_record)
        self.replica.on_gone.add(self._handle_removed_record)
        if wall is not None:
            self.endpoint.probe_responder.unix_time = wall
        self.endpoint.on_rejected.add(self._handle_rejection)
        self.endpoint.on_rejecting.add(self._handle_rejected_peer)
        self._running = False

    @cached_property
    def take_acceptor(self) -> TakeAcceptor:
        """This node's acceptor for takes in tuple spaces."""
        # Imported on first use, which saves half a MiB in a node without councils.
        from middleware.entangled.space.take_acceptor import TakeAcceptor

        take_acceptor = TakeAcceptor(self.endpoint, self.store, *self._acceptor_arguments)
        take_acceptor.wait_for_write = self.store.wait_for_write
        return take_acceptor

    # -- lifecycle -----------------------------------------------------------------------------------------------------

    @property
    def contact(self) -> Contact:
        """This node's public key and address."""
        return Contact(self.identity.public, self._network.address)

    def start(self) -> None:
        """Open the port and start to renew leases, watches and contacts; raise ``PortInUse``."""
        self.endpoint.start()
        self._running = True
        has_dropped = self._drop_records_after_absence()
        if self.store.get_note(INCARNATION_NOTE) is not None:
            self.take_acceptor.load()
        self._handover.start(has_dropped)
        for part in (self._membership, self.replica, self._owner, self._subscriber):
            part.start()
        self._background.every(NOTE_INTERVAL_S, self._note_contacts)
        if self.discovery is not None:
            self.discovery.start()

    def join(self, known: Sequence[Address]) -> Deferred[None]:
        """Join the network through ``known`` nodes (thesis, Algorithm 4.1), with back-off until one answers.

        The node also tries the contacts of earlier runs from its store and, after 1.5 s without an answer or on loss of
        all contacts, the alternate paths of the network (tunnels).  The Deferred fires when a node has answered; from
        then on keys can be read.  Without known nodes and contacts, this may be the first node of its network.  Then
        the Deferred fires immediately; with a ``lan`` it fires when a team member answers on the LAN, or when none did
        for a short time.  Afterwards the node looks up its own id, contacts the other nodes, and fetches the records
        for which it is a replica.
        """
        self.nat.selector.bootstrap_addresses |= {*known, *find_alternate_paths(self._network)}
        return _run(self._join(known))

    def stop(self) -> None:
        """Send goodbye, so that this node's leased records are removed immediately, and close the port."""
        if self._running:
            self._note_contacts()
            for contact in self.overlay.contacts():
                self.endpoint.notify(contact, "goodbye")
        self.stop_silently()

    def stop_silently(self) -> None:
        """Stop without sending anything, like a node whose power or radio fails."""
        if self._running:
            self._running = False
            self._subscriber.stop()
            self._background.stop()
            if self.discovery is not None:
                self.discovery.stop()
            self.endpoint.stop()

    def set_lease(self, lease: float) -> None:
        """Set the duration of this node's leases to ``lease`` seconds."""
        self.lease = lease
        self._owner.set_lease(lease)

    def evict(self, public: bytes, code: str = REVOKED) -> None:
        """Remove the node with this key, which the admission check rejects: send it ``code``, and drop its leases.

        The node is no longer a member and is not counted in majorities.
        """
        self.endpoint.evict(public, code)
        self._drop_member(public)

    def recheck(self) -> None:
        """Check all stored, owned and watched records again, after the authority of an owner changed."""
        for part in (self._owner, self.replica, self._subscriber):
            part.recheck()

    # -- public ------------------------------------------------------------------------------------------------------

    def put(
        self,
        key: bytes,
        name: str,
        value: bytes,
        lifetime: Lifetime = "team",
        concern: ConsistencyLevel = "majority",
        expect: int | None = None,
        lease: float | None = None,
    ) -> Deferred[Stored]:
        """Store ``value`` in the slot (key, this node, name); fires with the number of replicas that have stored it.

        ``concern`` is the consistency level: ``one`` replica, or a ``majority`` or ``all`` of the k closest members,
        including absent members.  Fails with ``NotAcknowledged`` if too few replicas are reachable; the record may
        spread nevertheless.  With ``expect`` the write is a compare-and-set: the value is stored only if the slot has
        this sequence number (0: never used); otherwise the write fails with ``Conflict``.  The result is an integer
        whose attribute ``sequence`` is the new sequence number.  A leased record may have a longer ``lease`` than the
        node's, in seconds.

        Fails with ``Refused`` and the code ``role`` if this node or the replicas find that this node's role does not
        allow the record.

        Raises ``TooLarge`` immediately if the value has more than ``MAX_VALUE_BYTES`` bytes or the name more than
        ``MAX_NAME_BYTES`` bytes, and ``ValueError`` if the key is invalid.
        """
        if len(value) > MAX_VALUE_BYTES:
            raise TooLarge(f"the value has {len(value)} bytes; a record has at most {MAX_VALUE_BYTES}")
        return self._put(key, name, value, lifetime, concern, expect, lease)

    def release(self, key: bytes, name: str) -> None:
        """Stop renewing this node's leased record in a slot: it expires with its lease, without a tombstone."""
        self._owner.release(Slot(key, self.identity.public, name))

    def remove(
        self, key: bytes, name: str, concern: ConsistencyLevel = "majority", expect: int | None = None
    ) -> Deferred[Stored]:
        """Replace this node's record in a slot by a tombstone; fails as ``put`` does.

        The tombstone stays for ``record.TOMBSTONE_TTL_S`` seconds, longer than any tolerated absence of a node.
        """
        return self._put(key, name, None, "team", concern, expect)

    def get(self, key: bytes, concern: ReadConsistency = "majority") -> Deferred[list[Record]]:
        """Read the records under ``key``.

        A ``majority`` read returns at least all records acknowledged by a majority write or returned by an earlier
        majority read.  A ``fast`` read asks one replica, and a second one if the first is slow.  Its result may be
        slightly old, and may lack a record that this replica has not received.  An empty result is confirmed by a
        majority.  Fails with ``Unavailable`` if too few replicas answer.
        """
        self._check_key(key)
        return _run(self._reader.read(key, concern))

    def watch(self, key: bytes, changed: OnChanged, keep: bool = False) -> Watch:
        """Call ``changed`` with all records of ``key`` on each change, until ``stop()`` of the returned watch.

        With ``keep`` the node also stores these records in its own store during the watch, for programs that read the
        store's file.
        """
        self._check_key(key)
        return self._subscriber.watch(key, changed, keep)

    def refresh(self, watch: Watch) -> None:
        """Poll the replicas of a watched key now; otherwise they are polled every 2 s."""
        if self._running:
            self._subscriber.refresh(watch)

    def rpc(self, name: str, changes: bool = False) -> Callable[[Answers], Answers]:
        """Make the decorated function ``answer(peer, *arguments)`` callable by peers under ``name``.

        Arguments are checked against the function's annotations of plain types before it runs.  With ``changes`` the
        function runs once per call, even if the request is retransmitted.  ``Endpoint.expose`` describes results,
        errors and ``deadline``.
        """

        def expose(answer: Answers) -> Answers:
            self.endpoint.expose(name, answer, changes)
            return answer

        return expose

    def call(
        self, contact: Contact, name: str, *arguments: object, timeout: float | None = None, changes: bool = False
    ) -> Deferred[Any]:
        """Call a method of a peer; set ``changes`` if the peer exposed the method with ``changes``.

        Fails with ``Refused`` if the method raised an error, or with ``NoAnswer``.  Cancelling the Deferred notifies
        the peer.
        """
        if not self._running:
            raise NotRunning("the node is not running; start it first")
        return self.endpoint.ask(contact, name, *arguments, timeout=timeout, changes=changes)

    def find_node(self, node_id: bytes) -> Deferred[list[Contact]]:
        """Look up the k live nodes closest to ``node_id`` (Kademlia, section 2.3)."""
        self._check_key(node_id)
        return _run(self.overlay.lookup(node_id))

    def find_newest(self, contact: Contact) -> Contact:
        """Return ``contact`` with the last address at which it was observed."""
        return self.overlay.table.get(contact.node_id) or contact

    # -- inside -----------------------------------------------------------------------------------------------------

    def _put(
        self,
        key: bytes,
        name: str,
        value: bytes | None,
        lifetime: Lifetime,
        concern: ConsistencyLevel,
        expect: int | None,
        lease: float | None = None,
    ) -> Deferred[Stored]:
        self._check_key(key)
        if len(name.encode()) > MAX_NAME_BYTES:
            raise TooLarge(f"the name has {len(name.encode())} bytes; a record's name has at most {MAX_NAME_BYTES}")
        if not self.replica.may_store(Slot(key, self.identity.public, name)):
            return fail(Refused(f"this node may not write {name!r} under this key: {explain(ROLE)}", ROLE))
        if expect is not None:
            return _run(self._compare_and_set(Slot(key, self.identity.public, name), value, lifetime, concern, expect))
        return _run(self._owner.put(self._owner.make_record(key, name, value, lifetime, lease=lease), concern))

    async def _compare_and_set(
        self, slot: Slot, value: bytes | None, lifetime: Lifetime, concern: ConsistencyLevel, expect: int
    ) -> Stored:
        # Only this node writes the slot, but an earlier run of the node may have written it already.
        read = None if self._owner.owns(slot) else (await self._reader.read_newest(slot.key)).get(slot)
        record = self._owner.make_record(slot.key, slot.name, value, lifetime, expect, read)
        return await self._owner.put(record, concern)

    async def _join(self, known: Sequence[Address]) -> None:
        alternate_paths, noted = find_alternate_paths(self._network), self._load_contacts()
        self._alternate_paths.configure(alternate_paths, known)
        if self.discovery is not None and not known:
            await self.discovery.wait_for_first()
        if alternate_paths and not self._membership.has_entered:
            await self._alternate_paths.enter_with_fallback(self._membership.join(known, noted) if known else None)
        else:
            await self._membership.join(known, noted)
        self._background.fork(self._lookup_neighbours())

    async def _lookup_neighbours(self) -> None:
        await self._membership.lookup_neighbours()
        if self._running:
            self._handover.start_catch_up()
            self._note_contacts()

    def _handle_stored_record(self, record: Record) -> None:
        self._handover.record_republication(record)
        self._subscriber.handle_stored(record)

    def _drop_records_after_absence(self) -> bool:
        """Drop all records after an absence longer than tombstones are stored; return whether they were dropped."""
        try:
            absent_s = self._wall() - float(self.store.get_note(LAST_SEEN_NOTE) or b"nan") if self._wall else 0.0
        except ValueError:  # a corrupt file may hold anything
            absent_s = 0.0
        if is_long := absent_s > TOLERATED_ABSENCE_S:
            self._log.warn("away for {days:.0f} days: all records in the store are dropped", days=absent_s / 86400)
            for record in self.store.records():
                self.store.discard(record.slot)
        return is_long

    def _answer_enrol(self, peer: Contact) -> bytes:
        return self.take_acceptor.answer_enrol(peer)

    def _handle_new_contact(self, contact: Contact) -> None:
        if not self.overlay.is_large:  # in a large network the periodic note is enough
            self._note_contacts()
        for part in (self._owner, self._handover, self._subscriber):
            part.handle_new_contact(contact)

    def _handle_lost_contact(self, contact: Contact) -> None:
        self._subscriber.forget_replica(contact.node_id)
        self._handover.handle_lost_contact(contact)
        self._membership.remember_lost(contact)
        self.nat.paths.forget_path(contact)

    def _handle_rejection(self, contact: Contact, code: str) -> None:
        """Mark a member that rejects this node as absent."""
        self.overlay.mark_rejecting(contact)

    def _handle_rejected_peer(self, contact: Contact, code: str) -> None:
        if code not in (DOUBLED, SUPERSEDED):  # with these codes, a second node with this identity stays a member
            self._drop_member(contact.public)

    def _drop_member(self, public: bytes) -> None:
        contact = self.overlay.find_known(derive_node_id(public))
        if contact is not None:
            self.replica.answer_goodbye(contact)
            self._membership.forget(contact)
            self._note_contacts()

    def _handle_removed_record(self, record: Record) -> None:
        if not self._owner.restore(record):
            self._subscriber.handle_removed(record)

    def _note_contacts(self) -> None:
        if self._wall is not None:
            self.store.set_note(LAST_SEEN_NOTE, repr(self._wall()).encode())
        known = {c.node_id: c for c in [*self.overlay.contacts(), *self.overlay.members.list_absent()]}
        contacts = sorted(known.values(), key=lambda c: c.node_id)[:MAX_NOTED_CONTACTS]
        if contacts:
            # A node that has lost all contacts does not overwrite its last note of contacts.
            self.store.set_note(CONTACTS_NOTE, msgpack.packb([c.pack() for c in contacts]))

    def _load_contacts(self) -> list[Contact]:
        try:
            noted = msgpack.unpackb(self.store.get_note(CONTACTS_NOTE) or b"\x90")
        except Exception:  # a corrupt file may hold anything
            return []
        contacts = [parse_contact(fields) for fields in noted] if isinstance(noted, list) else []
        return [c for c in contacts if c is not None and c.node_id != self.identity.node_id][:MAX_NOTED_CONTACTS]

    def _check_key(self, key: bytes) -> None:
        if not self._running:
            raise NotRunning("the node is not running; start it first")
        if len(key) != KEY_BYTES:
            raise ValueError(f"a key must have {KEY_BYTES} bytes, not {len(key)}")


def _run(work: Coroutine[Any, Any, Any]) -> Deferred[Any]:
    return Deferred.fromCoroutine(work)
