"""Seeded bugs: each breaks the library in one place, and some schedule has to show it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from middleware.entangled import overlay, owner, reader
from middleware.entangled.errors import EntangledError
from middleware.entangled.handover import Handover
from middleware.entangled.overlay import Overlay
from middleware.entangled.reader import Reader
from middleware.entangled.record import Record, Slot
from middleware.entangled.replica import Replica
from middleware.entangled.roster import Roster


async def _nothing(*_: object) -> None:
    return None


def _idle(*_: object) -> None:
    return None


async def _lookup_that_believes(self: Overlay, target: bytes) -> list[Any]:
    for contact in self.nearest(target):
        try:
            answer = await self.ask(contact, "find_node", target)
        except EntangledError:
            continue
        for found in overlay.contacts_of(answer):
            self.proved(found)
    return self.nearest(target)


async def _read_here(self: Reader, key: bytes) -> dict[Slot, Record]:
    return {record.slot: record for record in self._replica.held(key)}


def _any_answer(answers: dict[bytes, Any], voters: frozenset[bytes]) -> int:
    return len(answers) * 8


BUGS: dict[str, list[tuple[Any, str, Any]]] = {
    "tombstone dropped too early": [(owner, "TOMBSTONE_TTL", 3.0)],
    "acknowledged by a minority": [(Overlay, "voters", lambda self, key, targets: [targets[0].node_id])],
    "lower sequence accepted": [(Record, "beats", lambda self, other: True)],
    "contact entered unchecked": [(Overlay, "lookup", _lookup_that_believes)],
    "no hand-over": [
        (Handover, "_reconcile", _nothing),
        (Handover, "lost", _idle),
        (Handover, "is_sure", lambda self: True),
    ],
    "absent members do not count": [
        (Overlay, "voters", lambda self, key, targets: [contact.node_id for contact in targets])
    ],
    "nothing instead of unavailable": [(Reader, "_nothing", lambda self, answers, voters: [])],
    "signature not checked": [(Replica, "is_lawful", lambda self, record, peer: True)],
    "sure before it has caught up": [(Handover, "is_sure", lambda self: True)],
    "a read from the own store counts as sure": [(Reader, "newest", _read_here)],
    "numbers start again after a restart": [(owner, "BLOCK", -(2**40))],
    "the absent are not sought": [(Roster, "absent", lambda self: [])],
    "any answer counts": [(reader, "_votes", _any_answer)],
}

FINDERS: dict[str, tuple[str, ...]] = {}
"""The workloads that look for a bug, where these are not the records."""


@contextmanager
def seeded(name: str | None) -> Iterator[None]:
    """The library with that bug in it (None: as it is)."""
    changes = BUGS[name] if name else []
    kept = [(place, attribute, getattr(place, attribute)) for place, attribute, _ in changes]
    for place, attribute, broken in changes:
        setattr(place, attribute, broken)
    try:
        yield
    finally:
        for place, attribute, genuine in kept:
            setattr(place, attribute, genuine)
