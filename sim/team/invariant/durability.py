"""Invariants of durability, D1 to D7: clients' writes and reads, contents of stores, and contacts of nodes.

A client numbers its writes to a slot 1, 2, 3 ...; a removal is a write without a value. An unacknowledged write may
have happened, so a read may return it. No read may return an older value than a value that was acknowledged or read
earlier.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from sim.team.event import Answered, Asked, Born, ContactKnown, Died, Event, MembersListed, Settled, Stored, Unanswered

KINDS = Asked, Answered, Unanswered, Born, Died, Settled, Stored, ContactKnown, MembersListed
"""The events that these invariants use."""
MAJORITY = "majority"


class Slot(NamedTuple):
    """The location of a record."""

    key: bytes
    owner: bytes
    name: str


@dataclass
class _Known:
    """The state of a slot: the last started write, the highest acknowledged write, and the last read of each client."""

    last_started: int = 0
    last_acknowledged: int = 0
    last_read: dict[Hashable, int] = field(default_factory=dict)
    values: set[int] = field(default_factory=set)


@dataclass
class _PendingRead:
    """A pending read, with the minimum number for each slot at its start."""

    request: Asked
    minimums: dict[Slot, int]


def _check_reads(events: Iterable[Event]) -> Iterator[tuple[str, str]]:
    """Yield the violations of D1 to D4 in all reads, each with the name of its invariant."""
    slots: dict[Slot, _Known] = {}
    by_key: dict[Hashable, list[Slot]] = {}
    writing: dict[int, tuple[_Known, int]] = {}
    reading: dict[int, _PendingRead] = {}
    is_over = False
    for event in events:
        match event:
            case Settled():
                is_over = True
            case Asked(_, number, _, "write" | "remove" as what, Slot() as slot, int(write)):
                if slot not in slots:
                    slots[slot] = _Known()
                    by_key.setdefault(slot.key, []).append(slot)
                known = slots[slot]
                known.last_started = write
                if what == "write":
                    known.values.add(write)
                writing[number] = known, write
            case Answered(_, number) if number in writing:
                known, write = writing.pop(number)
                known.last_acknowledged = max(known.last_acknowledged, write)
            case Asked(_, number, client, "read", key):
                floors = {
                    slot: max(slots[slot].last_acknowledged, slots[slot].last_read.get(client, 0))
                    for slot in by_key.get(key, ())
                }
                reading[number] = _PendingRead(event, floors)
            case Answered(_, number, dict() as shown) if number in reading:
                yield from _check_read(reading.pop(number), shown, slots, is_over)


def _check_read(
    reading: _PendingRead, shown: dict[Slot, int], slots: dict[Slot, _Known], is_over: bool
) -> Iterator[tuple[str, str]]:
    """Compare the result of a read with the writes acknowledged before it started."""
    asked = reading.request
    for place, number in shown.items():
        if place not in slots or number not in slots[place].values:
            yield "D4", f"a read shows {place.name}={number}, which its owner never wrote"
    is_sure = asked.argument == MAJORITY or is_over
    for place, floor in reading.minimums.items():
        slot, there = slots[place], shown.get(place)
        where = f"{asked.argument} read of {place.key.hex()[:6]} {place.owner.hex()[:4]}/{place.name} at {asked.at:.1f}"
        if there is None:
            # An empty result is correct only if a removal may be the newest write, or no write was acknowledged yet.
            is_removed = any(number not in slot.values for number in range(max(floor, 1), slot.last_started + 1))
            if floor and not is_removed and (is_sure or not shown):
                yield "D1", f"{where}: {floor} was acknowledged or read, but nothing is found"
        elif is_sure and there < floor:
            yield "D2" if floor in slot.values else "D3", f"{where}: shows {there} after {floor}"
        elif asked.argument == MAJORITY:
            slot.last_read[asked.client] = max(slot.last_read.get(asked.client, 0), there)


def _select(invariant: str, events: Iterable[Event]) -> Iterator[str]:
    return (text for found, text in _check_reads(events) if found == invariant)


def d1(events: Iterable[Event]) -> Iterator[str]:
    """Durability: an acknowledged value is found, or the read reports that the value is unavailable."""
    return _select("D1", events)


def d2(events: Iterable[Event]) -> Iterator[str]:
    """Freshness: a majority read returns no older values than those acknowledged or read before it started."""
    return _select("D2", events)


def d3(events: Iterable[Event]) -> Iterator[str]:
    """No resurrection: after a removal was acknowledged, no older value is read."""
    return _select("D3", events)


def d4(events: Iterable[Event]) -> Iterator[str]:
    """Owner only: reads and stores contain what the owner signed, with growing sequence numbers.

    An owner never uses a sequence number twice, even after restarts, unless it has lost its store.
    """
    yield from _select("D4", events)
    held: dict[tuple[int, int, Hashable], tuple[int, bytes]] = {}
    written: dict[Hashable, Hashable] = {}
    signed: dict[tuple[Hashable, int], tuple[Hashable, bytes]] = {}
    forgetful: set[Hashable] = set()
    owners: dict[int, bytes] = {}
    for event in events:
        if isinstance(event, Born):
            owners[event.place] = event.public
        elif isinstance(event, Died) and event.forgets:
            forgetful.add(owners.get(event.place))
        if isinstance(event, Asked) and isinstance(event.subject, Slot):
            written[event.subject] = event.subject.owner
        if not isinstance(event, Stored):
            continue
        at, mark = (event.place, event.memory, event.slot), (event.sequence, event.signature)
        if event.is_durable and mark < held.get(at, mark):
            yield f"node {event.place} went back to {event.sequence} in {event.name}"
        if event.is_durable and not event.is_genuine:
            yield f"node {event.place} holds a forged record in {event.name}"
        elif event.is_durable and event.slot in written and written[event.slot] not in forgetful:
            record = event.slot, event.signature
            if signed.setdefault((written[event.slot], event.sequence), record) != record:
                yield f"the owner of {event.name} gave the number {event.sequence} to two records"
        held[at] = mark


def d5(events: Iterable[Event]) -> Iterator[str]:
    """Valid contacts: each contact in a routing table is another node of this team, with its correct address."""
    places: dict[bytes, tuple[int, str]] = {}
    for event in events:
        if isinstance(event, Born):
            places[event.public] = event.place, event.address
        elif isinstance(event, ContactKnown):
            place, address = places.get(event.public, (event.place, ""))
            if place == event.place or address != event.address:
                yield f"node {event.place} has {event.address} in its table"


def d6(events: Iterable[Event]) -> Iterator[str]:
    """Exact lookup: after the repair interval a lookup finds the k closest living nodes, closest first."""
    living: dict[int, bytes] = {}
    looking: dict[int, Asked] = {}
    for event in events:
        match event:
            case Born(_, place, _, _, node_id):
                living[place] = node_id
            case Died(_, place):
                living.pop(place, None)
            case Asked(_, number, _, "look up"):
                looking[number] = event
            case Answered(_, number, found) if number in looking:
                asked = looking.pop(number)
                others = [node_id for place, node_id in living.items() if place != asked.client]
                if found != _find_closest(others, asked):
                    yield _describe_lost(asked, found)
            case Unanswered(_, number, why) if number in looking:
                yield _describe_lost(looking.pop(number), why)
    for asked in looking.values():
        yield _describe_lost(asked, "no answer")


def _find_closest(others: list[bytes], asked: Asked) -> tuple[bytes, ...]:
    subject: Any = asked.subject
    count: Any = asked.argument
    goal = int.from_bytes(subject)
    return tuple(sorted(others, key=lambda node_id: int.from_bytes(node_id) ^ goal)[:count])


def _describe_lost(asked: Asked, found: object) -> str:
    subject: Any = asked.subject
    shown = ", ".join(one.hex()[:6] for one in found) if isinstance(found, tuple) else str(found)
    return f"node {asked.client} does not find the closest to {subject.hex()[:6]}: {shown}"


def d7(events: Iterable[Event]) -> Iterator[str]:
    """Healing: after the repair interval every node knows all living nodes, and every read is answered."""
    living: dict[int, bytes] = {}
    reading: dict[int, Asked] = {}
    is_over = False
    for event in events:
        match event:
            case Settled():
                is_over = True
            case Born(_, place, _, _, node_id):
                living[place] = node_id
            case Died(_, place):
                living.pop(place, None)
            case Asked(_, number, _, "read"):
                reading[number] = event
            case Unanswered(_, number, why, is_unavailable) if number in reading and is_over:
                key: Any = reading[number].subject
                what = "is not answered" if is_unavailable else f"fails: {why}"
                yield f"a {reading[number].argument} read of {key.hex()[:6]} {what} after everything healed"
            case MembersListed(_, place, ids):
                others = tuple(sorted(node_id for other, node_id in living.items() if other != place))
                if ids != others:
                    yield f"node {place} knows {len(ids)} live members, there are {len(others)} others"
