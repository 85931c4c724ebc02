"""EntangledNode: the verbs of the library, wired over overlay, replica, owner, subscriber and the sealed endpoint.

It decides nothing itself: who is known stands in ``overlay`` and ``membership``, what is held for others in ``replica``
and ``handover``, what is its own in ``owner``, what it reads in ``reader`` and ``subscriber``.
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
from middleware.entangled.contact import Contact, unpacked
from middleware.entangled.data.store import Store
from middleware.entangled.errors import NotRunning, Refused, TooLarge
from middleware.entangled.identity import Identity, node_id
from middleware.entangled.kademlia.discovery import Discovery
from middleware.entangled.kademlia.membership import Membership
from middleware.entangled.kademlia.overlay import Overlay
from middleware.entangled.network.multicast import Multicast
from middleware.entangled.network.network import Address, Network, detours_of
from middleware.entangled.reach.path import PathNetwork
from middleware.entangled.reach.reach import Reach
from middleware.entangled.record import KEY_BYTES, MAX_NAME, MAX_VALUE, TOLERATED_ABSENCE, Lifetime, Record, Slot
from middleware.entangled.replication.handover import Handover
from middleware.entangled.replication.owner import Concern, Owner, Stored
from middleware.entangled.replication.reader import ReadConcern, Reader
from middleware.entangled.replication.replica import Replica
from middleware.entangled.replication.subscriber import Subscriber
from middleware.entangled.replication.watch import Changed, Watch
from middleware.entangled.wire.door import DOUBLED, OPEN, REVOKED, ROLE, SUPERSEDED, Door, meaning
from middleware.entangled.wire.endpoint import Endpoint

if TYPE_CHECKING:
    from middleware.entangled.space.seat import Seat

NOTE = 30.0
"""Seconds between two notes of the time; whoever comes or goes is noted at once."""
CONTACTS = "contacts"
LAST_SEEN = "last seen"
SEATED = "decree/incarnation"
"""The note of a node that was in a council in an earlier life, and is asked about it in this one."""
MAX_NOTED = 64

Answers = TypeVar("Answers", bound=Callable[..., object])


class EntangledNode:
    """One peer; it lives once, from ``start`` to ``stop``.

    ``lease`` is how long, in seconds, what this node owns on lease outlives its last sign of life; more means fewer
    false losses, less means quicker notice.  ``rng`` and ``clock`` are the only sources of chance and time; ``wall``
    gives seconds that go on while the node is off, by which it knows how long it was away (without it, it assumes that
    it was not for long).  ``door`` says who is let in, and who may do what.  ``lan`` is its place in the group of the
    LAN, where it finds its team without known nodes.
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
        door: Door = OPEN,
        lan: Multicast | None = None,
    ) -> None:
        self.identity = identity
        self.store = store
        self.lease = lease
        self._network = network
        self._wall = wall
        self._chores = chores = Background(clock)
        paths = PathNetwork(network)
        self.endpoint = Endpoint(identity, team_key, paths, clock, rng, door)
        self.overlay = Overlay(lambda: self.contact, self.endpoint, clock, chores)
        self.reach = Reach(identity.node_id, self.endpoint, paths, self.overlay.contacts, clock, chores)
        self.overlay.on_named.add(self.reach.acquaintances.named)
        self.replica = Replica(store, self.endpoint, self.overlay, clock, chores)
        self._owner = Owner(identity, lease, store, self.replica, self.overlay, self.endpoint, clock, chores)
        self._membership = membership = Membership(self.overlay, self.endpoint, clock, rng, chores)
        membership.sounding.needs_use = self.reach.ways.needs_use
        self._detour = membership.detour
        self.discovery = (
            None if lan is None else Discovery(lan, self.endpoint, self.overlay, membership, clock, rng, chores)
        )
        self._handover = Handover(store, self.replica, self.overlay, self._owner, self.endpoint, clock, rng, chores)
        self._reader = Reader(self.replica, self.overlay, self._owner, chores)
        self._subscriber = Subscriber(
            identity.node_id, self.replica, self.overlay, self._reader, self.endpoint, clock, chores
        )
        self.replica.is_sure = self._handover.is_sure
        self._made_of = (clock, rng)
        self.endpoint.expose("decree.enrol", self._answer_enrol)
        self.overlay.on_newcomer.add(self._welcome)
        self.overlay.on_lost.add(self._lost)
        self.replica.on_record.add(self._held_here)
        self.replica.on_gone.add(self._gone_here)
        if wall is not None:
            self.endpoint.echoer.wall = wall
        self.endpoint.on_refused.add(self._refused)
        self.endpoint.on_refusing.add(self._refusing)
        self._running = False

    @cached_property
    def seat(self) -> Seat:
        """This node's seat in the councils of tuple spaces."""
        # Imported by the first who calls it to one: a node that is in none is spared half a MiB.
        from middleware.entangled.space.seat import Seat

        seat = Seat(self.endpoint, self.store, *self._made_of)
        seat.written = self.store.written
        return seat

    # -- life -------------------------------------------------------------------------------------------------------

    @property
    def contact(self) -> Contact:
        """This node as others know it."""
        return Contact(self.identity.public, self._network.address)

    def start(self) -> None:
        """Open the port and begin to keep leases, watches and contacts fresh; raises ``PortInUse``."""
        self.endpoint.start()
        self._running = True
        forgot = self._forget_after_long_absence()
        if self.store.noted(SEATED) is not None:
            self.seat.sit()
        self._handover.start(forgot)
        for part in (self._membership, self.replica, self._owner, self._subscriber):
            part.start()
        self._chores.every(NOTE, self._note_contacts)
        if self.discovery is not None:
            self.discovery.start()

    def join(self, known: Sequence[Address]) -> Deferred[None]:
        """Enter the network through ``known`` nodes (thesis, Algorithm 4.1), with back-off until one answers.

        The contacts of an earlier life, which the store remembers, are tried beside them, and the detours of the
        network (tunnels) when nobody has answered for 1.5 s, and whenever all contact is lost.  Fires when one of
        them has answered, so that keys can be read; where there are none, at once (the first node of a network), or,
        with a ``lan``, as soon as one of the team answers there or nobody did for a moment.  The node then looks up
        its own id, meets the others, and takes over what it is to hold.
        """
        self.reach.acquaintances.bootstraps |= {*known, *detours_of(self._network)}
        return _run(self._join(known))

    def stop(self) -> None:
        """Say goodbye, so that what is leased here leaves at once, and close the port."""
        if self._running:
            self._note_contacts()
            for contact in self.overlay.contacts():
                self.endpoint.tell(contact, "goodbye")
        self.vanish()

    def vanish(self) -> None:
        """Leave without a word, as a node does whose power or radio fails."""
        if self._running:
            self._running = False
            self._subscriber.stop()
            self._chores.stop()
            if self.discovery is not None:
                self.discovery.stop()
            self.endpoint.stop()

    def set_lease(self, lease: float) -> None:
        """Have what this node owns on lease outlive its last sign of life for so many seconds from now on."""
        self.lease = lease
        self._owner.set_lease(lease)

    def evict(self, public: bytes, code: str = REVOKED) -> None:
        """Part with the node of that key, which the door lets in no more: it is told ``code``, and what it leased goes.

        It is no member any more, and counts in no majority.
        """
        self.endpoint.evict(public, code)
        self._parted(public)

    def review(self) -> None:
        """Judge all records that are held, owned or watched anew: what the door knows of their owners has changed."""
        for part in (self._owner, self.replica, self._subscriber):
            part.review()

    # -- verbs ------------------------------------------------------------------------------------------------------

    def put(
        self,
        key: bytes,
        name: str,
        value: bytes,
        lifetime: Lifetime = "team",
        concern: Concern = "majority",
        expect: int | None = None,
        lease: float | None = None,
    ) -> Deferred[Stored]:
        """Store ``value`` in the slot (key, this node, name); fires with the number of replicas that have it by then.

        ``concern`` says how many that are at least: ``one``, a ``majority`` of the k closest members, the absent ones
        counted in, or ``all`` of these.  Fails with ``NotAcknowledged`` where they cannot be reached; the record may
        spread all the same.  With ``expect`` it is stored only where the slot's sequence is that (0: it was never
        filled), and fails with ``Conflict`` else: a compare-and-set.  What it fires with is a number whose ``sequence``
        says what the slot's is now.  What is leased may have a longer ``lease`` than the node's, in seconds.

        Fails with ``Refused``, code ``role``, where this node's role, or the owner's as the replicas know it, may not
        write there.

        Raises ``TooLarge`` at once for a value over ``MAX_VALUE`` or a name over ``MAX_NAME`` bytes, and
        ``ValueError`` for what is no key.
        """
        if len(value) > MAX_VALUE:
            raise TooLarge(f"value of {len(value)} bytes; a record carries at most {MAX_VALUE}")
        return self._put(key, name, value, lifetime, concern, expect, lease)

    def release(self, key: bytes, name: str) -> None:
        """Look after what this node leased in a slot no more: within its lease it is gone, and leaves no tombstone."""
        self._owner.release(Slot(key, self.identity.public, name))

    def remove(
        self, key: bytes, name: str, concern: Concern = "majority", expect: int | None = None
    ) -> Deferred[Stored]:
        """Empty a slot of this node: a tombstone takes the place of its record; fails as ``put`` does.

        The tombstone stays for ``record.TOMBSTONE_TTL``, longer than any absence that is tolerated.
        """
        return self._put(key, name, None, "team", concern, expect)

    def get(self, key: bytes, concern: ReadConcern = "majority") -> Deferred[list[Record]]:
        """What the network holds under ``key``.

        A ``majority`` read never shows less than was acknowledged to any writer or shown to any majority read before.
        A ``fast`` one asks one replica (another one where it is slow): it may be a moment old, and lack a slot that
        this replica missed.  Where nothing is found, a majority has said so; where too few answer for that, fails with
        ``Unavailable``.
        """
        self._check(key)
        return _run(self._reader.read(key, concern))

    def watch(self, key: bytes, changed: Changed, keep: bool = False) -> Watch:
        """Call ``changed`` with all records of ``key`` whenever they differ, until ``stop()`` of what is returned.

        With ``keep`` they are also in the node's own store for as long as they are seen, for whoever reads its file.
        """
        self._check(key)
        return self._subscriber.watch(key, changed, keep)

    def refresh(self, watch: Watch) -> None:
        """Ask those that hold a watched key at once whether they hold anything new; else they are asked every 2 s."""
        if self._running:
            self._subscriber.refresh(watch)

    def rpc(self, name: str, changes: bool = False) -> Callable[[Answers], Answers]:
        """Let peers call the decorated function ``answer(peer, *arguments)`` under ``name``.

        Its plain annotations are checked before it runs; with ``changes`` it runs once for each call, however often the
        wire repeats it.  What it may return and raise, and ``deadline``, stands at ``Endpoint.expose``.
        """

        def expose(answer: Answers) -> Answers:
            self.endpoint.expose(name, answer, changes)
            return answer

        return expose

    def call(
        self, contact: Contact, name: str, *arguments: object, timeout: float | None = None, changes: bool = False
    ) -> Deferred[Any]:
        """Call a peer's method; say ``changes`` where it was exposed so.

        Fails with ``Refused`` or a named error of the method's own, or ``NoAnswer``; cancelling it tells the peer.
        """
        if not self._running:
            raise NotRunning("start the node first")
        return self.endpoint.ask(contact, name, *arguments, timeout=timeout, changes=changes)

    def find_node(self, node_id: bytes) -> Deferred[list[Contact]]:
        """The k live nodes closest to ``node_id``, by an iterative lookup (Kademlia, section 2.3)."""
        self._check(node_id)
        return _run(self.overlay.lookup(node_id))

    def newest(self, contact: Contact) -> Contact:
        """Return the node of ``contact`` with the last address it was heard from."""
        return self.overlay.table.get(contact.node_id) or contact

    # -- inside -----------------------------------------------------------------------------------------------------

    def _put(
        self,
        key: bytes,
        name: str,
        value: bytes | None,
        lifetime: Lifetime,
        concern: Concern,
        expect: int | None,
        lease: float | None = None,
    ) -> Deferred[Stored]:
        self._check(key)
        if len(name.encode()) > MAX_NAME:
            raise TooLarge(f"name of {len(name.encode())} bytes; a record's name has at most {MAX_NAME}")
        if not self.replica.may_store(Slot(key, self.identity.public, name)):
            return fail(Refused(f"this node may not write {name!r} there: {meaning(ROLE)}", ROLE))
        if expect is not None:
            return _run(self._compare_and_set(Slot(key, self.identity.public, name), value, lifetime, concern, expect))
        return _run(self._owner.put(self._owner.next(key, name, value, lifetime, lease=lease), concern))

    async def _compare_and_set(
        self, slot: Slot, value: bytes | None, lifetime: Lifetime, concern: Concern, expect: int
    ) -> Stored:
        # Nobody but this node writes the slot, but an earlier life of it may have.
        read = None if self._owner.owns(slot) else (await self._reader.newest(slot.key)).get(slot)
        record = self._owner.next(slot.key, slot.name, value, lifetime, expect, read)
        return await self._owner.put(record, concern)

    async def _join(self, known: Sequence[Address]) -> None:
        ways, noted = detours_of(self._network), self._noted_contacts()
        self._detour.begin(ways, known)
        if self.discovery is not None and not known:
            await self.discovery.first()
        if ways and not self._membership.is_entered:
            await self._detour.beside(self._membership.join(known, noted) if known else None)
        else:
            await self._membership.join(known, noted)
        self._chores.fork(self._settle())

    async def _settle(self) -> None:
        await self._membership.settle()
        if self._running:
            self._handover.joined()
            self._note_contacts()

    def _held_here(self, record: Record) -> None:
        self._handover.stored(record)
        self._subscriber.held_here(record)

    def _forget_after_long_absence(self) -> bool:
        """Re-join empty where this node was away for longer than tombstones are kept; whether it was."""
        try:
            away = self._wall() - float(self.store.noted(LAST_SEEN) or b"nan") if self._wall else 0.0
        except ValueError:  # a rotten file may hold anything
            away = 0.0
        if is_long := away > TOLERATED_ABSENCE:
            self._log.warn("away for {days:.0f} days: what was held is forgotten", days=away / 86400)
            for record in self.store.records():
                self.store.discard(record.slot)
        return is_long

    def _answer_enrol(self, peer: Contact) -> bytes:
        return self.seat.answer_enrol(peer)

    def _welcome(self, contact: Contact) -> None:
        if not self.overlay.is_large:  # where many come, the next note will do
            self._note_contacts()
        for part in (self._owner, self._handover, self._subscriber):
            part.welcome(contact)

    def _lost(self, contact: Contact) -> None:
        self._subscriber.forget(contact.node_id)
        self._handover.lost(contact)
        self._membership.lost(contact)
        self.reach.ways.lost(contact)

    def _refused(self, contact: Contact, code: str) -> None:
        """A member does not let this node in: it cannot be reached, and counts as one that is absent."""
        self.overlay.turned_away(contact)

    def _refusing(self, contact: Contact, code: str) -> None:
        if code not in (DOUBLED, SUPERSEDED):  # else the other one of that identity is a member still
            self._parted(contact.public)

    def _parted(self, public: bytes) -> None:
        contact = self.overlay.known(node_id(public))
        if contact is not None:
            self.replica.answer_goodbye(contact)
            self._membership.forget(contact)
            self._note_contacts()

    def _gone_here(self, record: Record) -> None:
        if not self._owner.lost_here(record):
            self._subscriber.gone_here(record)

    def _note_contacts(self) -> None:
        if self._wall is not None:
            self.store.note(LAST_SEEN, repr(self._wall()).encode())
        known = {c.node_id: c for c in [*self.overlay.contacts(), *self.overlay.roster.absent()]}
        contacts = sorted(known.values(), key=lambda c: c.node_id)[:MAX_NOTED]
        if contacts:
            # One that has lost sight of everybody had better remember whom it knew.
            self.store.note(CONTACTS, msgpack.packb([c.packed() for c in contacts]))

    def _noted_contacts(self) -> list[Contact]:
        try:
            noted = msgpack.unpackb(self.store.noted(CONTACTS) or b"\x90")
        except Exception:  # a rotten file may hold anything
            return []
        contacts = [unpacked(fields) for fields in noted] if isinstance(noted, list) else []
        return [c for c in contacts if c is not None and c.node_id != self.identity.node_id][:MAX_NOTED]

    def _check(self, key: bytes) -> None:
        if not self._running:
            raise NotRunning("start the node first")
        if len(key) != KEY_BYTES:
            raise ValueError(f"a key has {KEY_BYTES} bytes, this one {len(key)}")


def _run(work: Coroutine[Any, Any, Any]) -> Deferred[Any]:
    return Deferred.fromCoroutine(work)
