"""Reads of a key from its replicas: a fast read from one replica, or a consistent read from a majority.

If too few replicas are reachable, a read fails with ``Unavailable`` instead of returning an empty result.  If a reply
takes longer than nearly all replies in this team, the reader sends further requests to other replicas (hedging).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Literal, NamedTuple

from twisted.internet.defer import Deferred

from middleware.entangled.background import Background, gather_until
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError, Refused, Unavailable
from middleware.entangled.kademlia.lookup import Lookup
from middleware.entangled.kademlia.overlay import ALPHA, K, Overlay, Voters, parse_contacts
from middleware.entangled.record import Record, Slot, parse_record
from middleware.entangled.replication.cache import MAX_AGE_S
from middleware.entangled.replication.owner import OWNER_FAULT_CODES, Owner
from middleware.entangled.replication.replica import CACHED_REPLY, SYNCED_REPLY, UNSYNCED_REPLY, Replica
from middleware.entangled.replication.store_reply import Outcome
from middleware.entangled.replication.watch import digest_of

ReadConsistency = Literal["fast", "majority"]
CATCH_UP_TIMEOUT_S, CATCH_UP_INTERVAL_S = 1.5, 0.1
"""A read waits up to the first number of seconds until its own node has caught up, and checks this at the second
interval."""
MAX_PAGES = 2000


class ReplicaReply(NamedTuple):
    """The reply of one replica.

    It contains the records, tombstones included, the kind of the reply (``worth``), and contacts nearer to the key.
    """

    records: list[Record]
    sync_level: int
    nearer: list[Contact]


class Reader:
    """Reads keys for one node."""

    def __init__(self, replica: Replica, overlay: Overlay, owner: Owner, background: Background) -> None:
        self._replica = replica
        self._overlay = overlay
        self._owner = owner
        self._background = background

    async def read(self, key: bytes, concern: ReadConsistency) -> list[Record]:
        """Return the records of ``key``, without tombstones, in the order of (owner, name); raise ``Unavailable``.

        A new node has no vote until it has caught up, so its reads wait for this up to ``CATCH_UP_TIMEOUT_S`` seconds.
        """
        timed_out: list[bool] | None = None
        while True:
            try:
                records = (
                    list((await self.read_newest(key)).values())
                    if concern == "majority"
                    else await self._read_fast(key)
                )
                break
            except Unavailable:
                if timed_out or self._replica.is_synced():
                    raise
            if timed_out is None:
                timed_out = []
                self._background.later(CATCH_UP_TIMEOUT_S, timed_out.append, True)
            await self._background.sleep(CATCH_UP_INTERVAL_S)
        return sorted((r for r in records if not r.is_tombstone), key=lambda r: (r.owner, r.name))

    async def read_pages(
        self,
        contact: Contact,
        key: bytes,
        page: object = None,
        wants_synced: bool = True,
        same: list[Record] | None = None,
    ) -> ReplicaReply:
        """Read the records that ``contact`` stores under ``key``, from ``page`` on (None: from the first page).

        If the records of ``contact`` are exactly ``same``, it sends no records.
        """
        records: list[Record] = []
        if page is None:
            digest = (digest_of(same),) if same else ()
            page = await self._overlay.ask(contact, "find_value", key, None, wants_synced, *digest)
            if same and isinstance(page, list) and len(page) == 3 and page[0] is None:
                return ReplicaReply(same, SYNCED_REPLY if page[2] == SYNCED_REPLY else UNSYNCED_REPLY, [])
        worth, nearer = UNSYNCED_REPLY, []
        for _ in range(MAX_PAGES):
            if not (isinstance(page, list) and len(page) >= 2 and isinstance(page[0], list)):
                break
            received = [record for record in map(parse_record, page[0]) if record is not None]
            await self._replica.certificates.fetch_missing(contact, (record.owner for record in received))
            records += [record for record in received if self.is_credible(record, key, contact)]
            # The last page determines the kind of the reply, because the replica may have lost contact between two
            # pages.
            worth = page[2] if len(page) > 2 and page[2] in (SYNCED_REPLY, CACHED_REPLY) else UNSYNCED_REPLY
            nearer = parse_contacts(page[3]) if len(page) > 3 else []
            if page[1] is None or not page[0]:
                break
            page = await self._overlay.ask(contact, "find_value", key, page[1], wants_synced)
        return ReplicaReply(records, worth, nearer)

    def is_credible(self, record: Record, key: bytes, contact: Contact) -> bool:
        """Return whether ``record``, received from ``contact``, belongs to ``key`` and is authentic."""
        if record.key != key:
            return False
        if record.owner == contact.public:
            return self._replica.may_store(record.slot)
        return self._replica.is_genuine(record)

    # -- inside -----------------------------------------------------------------------------------------------------

    async def _read_fast(self, key: bytes) -> list[Record]:
        local = self._replica.get_held(key)
        # This node's records may be outdated if it is no longer among the closest nodes.
        if (
            _has_values(local)
            and self._replica.is_synced()
            and self._overlay.is_replica(key, self._overlay.own_contact())
        ):
            return local
        if self._overlay.is_sparse:
            return await self._find_value(key)
        targets = await self._overlay.lookup_replicas(key)
        voters = self._overlay.find_voters(key, targets)
        answers = await self._query_replicas(key, targets, voters, lambda given: _is_conclusive(given, voters), width=1)
        for answer in answers.values():
            if _has_values(answer.records):
                return answer.records
        return self._confirm_empty(answers, voters)

    async def read_newest(self, key: bytes) -> dict[Slot, Record]:
        """Return the newest records of ``key`` at a majority, tombstones included; raise ``Unavailable``."""
        targets = await self._overlay.lookup_replicas(key)
        voters = self._overlay.find_voters(key, targets)
        needed = voters.majority
        answers = await self._query_replicas(
            key, targets, voters, lambda given: _count_votes(given, voters) >= needed, width=needed
        )
        _check_votes(_count_votes(answers, voters), voters)
        newest = merge_newest(answer.records for answer in answers.values())
        await self._repair(newest, targets, voters, answers)
        return newest

    def _confirm_empty(self, answers: dict[bytes, ReplicaReply], voters: Voters) -> list[Record]:
        """Return an empty list if a majority has answered; otherwise raise ``Unavailable``."""
        _check_votes(_count_votes(answers, voters), voters)
        return []

    async def _repair(
        self,
        newest: dict[Slot, Record],
        targets: list[Contact],
        voters: Voters,
        answers: dict[bytes, ReplicaReply],
    ) -> None:
        """Store records that only a minority has at a majority, so that later reads also return them."""
        has: dict[Slot, set[bytes]] = {slot: set() for slot in newest}
        for node_id, answer in answers.items():
            for record in answer.records:
                if newest[record.slot] == record:
                    has[record.slot].add(node_id)
        for slot, record in newest.items():
            if record.lifetime == "leased" or voters.count_known(has[slot]) >= voters.majority:
                continue  # only the owner stores a leased record, with each renewal
            holding = has[slot]

            async def repair_at(contact: Contact, record: Record = record, holding: set[bytes] = holding) -> None:
                try:
                    reply = await self._owner.store_at(contact, record, self._owner.remaining_lifetime(record))
                    if reply.outcome is Outcome.UNSYNCED:
                        return
                except Refused as error:
                    if error.code not in OWNER_FAULT_CODES:
                        raise
                holding.add(contact.node_id)  # the record was stored, superseded, or rejected because of its owner

            lacking = [repair_at(c) for c in targets if c.node_id not in holding]
            await gather_until(lambda _, holding=holding: voters.count_known(holding) >= voters.majority, lacking)  # type: ignore
            _check_votes(voters.count_known(holding), voters)

    async def _query_replicas(
        self,
        key: bytes,
        targets: list[Contact],
        voters: Voters,
        is_enough: Callable[[dict[bytes, ReplicaReply]], bool],
        width: int,
    ) -> dict[bytes, ReplicaReply]:
        """Collect the answers of ``targets``: ask ``width`` in parallel, and two more for each that is slow or fails.

        Two more are asked because many nodes may fail together: if half of the team has failed, every second replica is
        silent.
        """
        answers: dict[bytes, ReplicaReply] = {}
        own_id = self._overlay.own_id
        local: list[Record] = []
        if any(c.node_id == own_id for c in targets):
            local = self._replica.get_held(key)
            answers[own_id] = ReplicaReply(local, SYNCED_REPLY if self._replica.is_synced() else UNSYNCED_REPLY, [])
            width -= 1
        waiting = self._overlay.order_by_speed(c for c in targets if c.node_id != own_id)
        done: Deferred[None] = Deferred()
        pending = 0

        def settle() -> None:
            if not done.called and (is_enough(answers) or not (waiting or pending)):
                done.callback(None)

        def ask_next() -> None:
            if waiting and not done.called:
                self._background.fork(ask(waiting.pop(0)))

        def hedge(contact: Contact) -> None:
            self._overlay.mark_slow(contact)
            ask_next()
            ask_next()

        async def ask(contact: Contact) -> None:
            nonlocal pending
            pending += 1
            in_time = self._background.later(self._overlay.hedge_delay(), hedge, contact)
            more = 1
            try:
                answer = answers[contact.node_id] = await self.read_pages(contact, key, same=local)
                if answer.sync_level == SYNCED_REPLY and contact.node_id in voters.ids:
                    more = 2 if initial == 1 else 0
            except EntangledError:
                pass
            in_time()
            pending -= 1
            settle()
            # A fast read asks one replica first; if this replica has no records, it asks a majority, in two or three
            # waves.
            for _ in range(more if pending else max(more, 1)):
                ask_next()

        settle()
        initial = max(width, 1)
        for _ in range(initial):
            ask_next()
        settle()
        await done
        return dict(answers)

    async def _find_value(self, key: bytes) -> list[Record]:
        """Find the key in a large network: ask ever nearer nodes until one has records of it (Kademlia, section 2.3).

        The records of a node that is not among the closest, or is not synced, may be incomplete; they are used only if
        no other node has records of the key.  The nearest node that lacks the key gets a cached copy; the lifetime of
        the copy is halved for each node that is nearer to the key.
        """
        lookup = Lookup(key, K, ALPHA, self._overlay.find_nearest(key), exclude=self._overlay.own_id)
        found: list[Record] = []
        answers: dict[bytes, ReplicaReply] = {}

        async def visit(contact: Contact) -> None:
            answer = await self.read_pages(contact, key, wants_synced=False)
            if _has_values(answer.records) and answer.sync_level in (SYNCED_REPLY, CACHED_REPLY):
                found[:] = found or answer.records
            else:
                answers[contact.node_id] = answer
            lookup.record_answer(contact, answer.nearer)

        await self._overlay.run_lookup(lookup, visit, lambda: bool(found))
        nearest = lookup.closest()
        if not found:
            voters = self._overlay.find_voters(key, nearest)
            self._overlay.cache_lookup(key, nearest)
            some = list(merge_newest(answer.records for answer in answers.values()).values())
            return some if _has_values(some) else self._confirm_empty(answers, voters)
        lacking_nodes = [contact for contact in nearest if contact.node_id in answers]
        if lacking_nodes and all(record.lifetime == "team" for record in found):
            between = nearest.index(lacking_nodes[0])
            packed = [record.pack() for record in found]
            copy = self._overlay.ask(lacking_nodes[0], "cache", key, packed, MAX_AGE_S / 2**between, changes=True)
            self._background.fork(copy)
        return found


def merge_newest(opinions: Iterable[list[Record]]) -> dict[Slot, Record]:
    """Return for each slot the record that supersedes the others."""
    newest: dict[Slot, Record] = {}
    for records in opinions:
        for record in records:
            if record.supersedes(newest.get(record.slot)):
                newest[record.slot] = record
    return newest


def _count_votes(answers: dict[bytes, ReplicaReply], voters: Voters) -> int:
    return voters.count_known(node_id for node_id, answer in answers.items() if answer.sync_level == SYNCED_REPLY)


def _check_votes(votes: int, voters: Voters) -> None:
    """Raise ``Unavailable`` if ``votes`` are fewer than a majority of ``voters``."""
    if votes < voters.majority:
        raise Unavailable(votes, voters.majority)


def _is_conclusive(answers: dict[bytes, ReplicaReply], voters: Voters) -> bool:
    is_found = any(_has_values(answer.records) for answer in answers.values())
    return is_found or _count_votes(answers, voters) >= voters.majority


def _has_values(records: list[Record]) -> bool:
    """Return whether ``records`` are not only tombstones; a replica with only tombstones may lack records."""
    return any(not record.is_tombstone for record in records)
