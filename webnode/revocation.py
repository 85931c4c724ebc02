"""Revocation: the sessions that were ended before their time, as every web node of the team knows them.

Each web node keeps one record with those that were ended at it, so that all others hear of them at once, and a web node
that starts later reads them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgpack

from middleware.entangled.errors import EntangledError
from middleware.entangled.record import Record, hashed_key
from middleware.entangled.value import LARGEST, bounded, is_number, mapping_of
from middleware.node import SwarmNode

REVOKED = hashed_key("signed-out")
SLOT = "signed-out"
MOST = 60
"""Sessions in one record, the newest: it has to fit into a datagram."""
REMEMBERED = 4096
ID_BYTES = 8


class Revocations:
    """Sessions that were ended here, known to no other node; ``has`` may be asked on any thread."""

    def __init__(self) -> None:
        self._known: dict[str, float] = {}

    def has(self, token_id: str) -> bool:
        """Whether it was ended."""
        return token_id in self._known

    def add(self, token_id: str, until: float) -> None:
        """End it; whatever was made of it runs out ``until`` then, in unix seconds."""
        self._known = _newest({**self._known, token_id: until}, REMEMBERED)


class TeamRevocations(Revocations):
    """Those that were ended at any web node of the team of ``node``."""

    def __init__(self, node: SwarmNode) -> None:
        super().__init__()
        self._node = node
        self._own: dict[str, float] = {}
        self._watch = node.entangled.watch(REVOKED, self._heard, keep=True)

    def add(self, token_id: str, until: float) -> None:
        """End it here at once, and tell the others."""
        self._learn({token_id: until})
        own = {each: end for each, end in self._own.items() if end > self._node.wall()}
        self._own = _newest({**own, token_id: until}, MOST)
        ends = {bytes.fromhex(each): int(min(end, LARGEST)) for each, end in self._own.items()}
        self._node.entangled.put(REVOKED, SLOT, bounded(bytes(msgpack.packb(ends))), "team").addErrback(_untold)

    def _heard(self, records: list[Record]) -> None:
        for record in records:
            self._learn(revoked_in(record))

    def _learn(self, ends: Mapping[str, float]) -> None:
        # What was ended stays so, though who told it is gone; and a new table each time: whoever looks on another
        # thread has the old one in hand.
        now = self._node.wall()
        known = {each: end for each, end in self._known.items() if end > now}
        self._known = _newest({**known, **{each: end for each, end in ends.items() if end > now}}, REMEMBERED)


def revoked_in(record: Record) -> Mapping[str, float]:
    """The sessions that a record ends, by id, with when each would have run out; none where its value is no such."""
    content: dict[Any, Any] | None = mapping_of(record) if record.name == SLOT else None
    return {
        each.hex(): float(end)
        for each, end in (content or {}).items()
        if isinstance(each, bytes) and len(each) == ID_BYTES and is_number(end)
    }


def _newest(ends: Mapping[str, float], most: int) -> dict[str, float]:
    return dict(list(ends.items())[-most:])


def _untold(failure: Any) -> None:
    """Nobody could be told now: it holds here."""
    failure.trap(EntangledError)
