"""Keeper: keeps the records of a space in order; it notes what was taken, and uses the slots of what is over again.

Nothing depends on it for safety: the council knows who took a tuple.  A note only spares readers a tuple that is gone.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field

from middleware.entangled.background import Background
from middleware.entangled.record import Record
from middleware.entangled.space.peer import Peer
from middleware.entangled.space.posting import (
    MARK_BYTES,
    Member,
    Place,
    Posted,
    Taken,
    packed_taken,
    packed_tuple,
    posting,
    standing,
)
from middleware.entangled.space.template import Tuple

GRACE = 2.0
"""Seconds that whoever took a tuple has to note that, before one who found out does it instead."""
TIDY = 30.0
HURRY = 2.0
"""Seconds until slots are tidied where they run up faster than that."""
SLACK = 8
"""Slots in use that are never worth a hurry."""


@dataclass
class _Ledger:
    """The own slots under one key: what they hold, and which may be used again."""

    holds: dict[str, Place] = field(default_factory=dict)
    free: list[str] = field(default_factory=list)
    orphans: frozenset[str] = frozenset()
    enough: int = SLACK
    is_hurried: bool = False


class Keeper:
    """The slots of one node in the keys of one space."""

    def __init__(self, node: Peer, rng: random.Random, chores: Background) -> None:
        self._node = node
        self._rng = rng
        self._chores = chores
        # A former life may have left tuples in its slots, which must not be written over.
        self._life = rng.randbytes(4).hex()
        self._made = 0
        self._ledgers: dict[bytes, _Ledger] = {}
        self._doubtful: dict[Place, bytes] = {}

    @property
    def keys(self) -> list[bytes]:
        """The keys that are kept in order here."""
        return list(self._ledgers)

    def look_after(self, key: bytes) -> None:
        """Keep what this node has under ``key`` in order from now on."""
        if key not in self._ledgers:
            if not self._ledgers:
                self._chores.every(TIDY, self._tidy_all)
            self._ledgers[key] = _Ledger()

    async def post(self, key: bytes, fields: Tuple, council: list[Member], ttl: float | None) -> None:
        """Put a tuple, and take it out after ``ttl`` seconds where nobody took it; fails as ``Peer.put``."""
        name = self._slot(key)
        place = Place(key, self._node.identity.public, name, self._rng.randbytes(MARK_BYTES))
        self._ledgers[key].holds[name] = place
        if ttl is not None:
            self._chores.later(ttl, self._withdraw, place)
        await self._node.put(key, name, packed_tuple(place.mark, fields, council))

    async def note(self, place: Place, taker: bytes) -> None:
        """Write down that the tuple of ``place`` was taken; readers do not see it any more."""
        name = self._slot(place.key)
        self._ledgers[place.key].holds[name] = place
        await self._node.put(place.key, name, packed_taken(place, taker))

    def doubt(self, place: Place, taker: bytes) -> None:
        """Look later whether whoever took the tuple has noted that."""
        if not self._doubtful:
            self._chores.later(GRACE, lambda: self._chores.fork(self._dispel()))
        self._doubtful[place] = taker

    # -- inside -----------------------------------------------------------------------------------------------------

    def _slot(self, key: bytes) -> str:
        """The name of an own slot under ``key`` that holds nothing any more."""
        self.look_after(key)
        ledger = self._ledgers[key]
        if len(ledger.holds) >= ledger.enough and not ledger.is_hurried:
            ledger.is_hurried = True
            self._chores.later(HURRY, lambda: self._chores.fork(self._hurried(key)))
        if ledger.free:
            return ledger.free.pop()
        self._made += 1
        return f"{self._life}/{self._made:x}"

    def _withdraw(self, place: Place) -> None:
        ledger = self._ledgers[place.key]
        if ledger.holds.get(place.name) == place:
            del ledger.holds[place.name]
            ledger.free.append(place.name)
            self._remove(place.key, place.name)

    def _remove(self, key: bytes, name: str) -> None:
        async def removed() -> None:
            await self._node.remove(key, name)

        self._chores.fork(removed())

    async def _dispel(self) -> None:
        doubtful, self._doubtful = self._doubtful, {}
        for key in dict.fromkeys(place.key for place in doubtful):
            for one in standing(await self._node.get(key))[0]:
                if one.place in doubtful:
                    self._chores.fork(self.note(one.place, doubtful[one.place]))

    def _tidy_all(self) -> None:
        for key in self._ledgers:
            self._chores.fork(self._tidy(key, is_thorough=True))

    async def _hurried(self, key: bytes) -> None:
        try:
            await self._tidy(key)
        finally:
            self._ledgers[key].is_hurried = False

    async def _tidy(self, key: bytes, is_thorough: bool = False) -> None:
        """Free the own slots under ``key`` that hold what is over: tuples that were taken, and notes about such.

        A slot is free only where the very thing was seen in it that was put there last, for replicas may lag behind.  A
        tuple that is not seen once may only have been missed; its note goes when it is not seen twice.  Slots that were
        free the last time as well are emptied by a thorough round, so that they cost readers nothing.
        """
        ledger = self._ledgers[key]
        idle = set(ledger.free)
        own = self._node.identity.public
        records: list[Record] = await self._node.get(key)
        said = {record.slot: posting(record) for record in records}
        there = {one.place for one in said.values() if isinstance(one, Posted)}
        taken = {one.place for one in said.values() if isinstance(one, Taken)}
        orphans = []
        for slot, one in said.items():
            is_orphan = isinstance(one, Taken) and one.place not in there
            is_over = one is not None and one.place in taken and not isinstance(one, Taken)
            if slot.owner != own or one is None or not (is_orphan or is_over):
                continue
            name = slot.name
            if is_orphan:
                orphans.append(name)
            if is_orphan and name not in ledger.orphans:
                continue
            if ledger.holds.get(name) == one.place:
                del ledger.holds[name]
                ledger.free.append(name)
            elif not name.startswith(self._life) or (is_thorough and name in idle and name in ledger.free):
                self._remove(key, name)
        ledger.orphans = frozenset(orphans)
        ledger.enough = 2 * len(ledger.holds) + SLACK
