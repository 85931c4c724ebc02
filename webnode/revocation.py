"""Share the sessions that were ended early among the web nodes of the team.

Each web node keeps one record with the sessions that ended there; the others watch these records, and a web node that
starts later reads them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgpack

from middleware.entangled.errors import EntangledError
from middleware.entangled.record import Record, hash_key
from middleware.entangled.value import MAX_NUMBER, check_size, is_number, parse_mapping
from middleware.node import SwarmNode

REVOKED_KEY = hash_key("signed-out")
SLOT = "signed-out"
MAX_PUBLISHED = 60
"""Maximum number of sessions in one record, the newest; the record has to fit into a datagram."""
MAX_KNOWN = 4096
ID_BYTES = 8


class Revocations:
    """The revoked sessions of one web node, not shared; ``is_revoked`` may be called on any thread."""

    def __init__(self) -> None:
        self._known: dict[str, float] = {}

    def is_revoked(self, token_id: str) -> bool:
        """Return whether the session is revoked."""
        return token_id in self._known

    def revoke(self, token_id: str, until: float) -> None:
        """Revoke a session; it and all tokens derived from it expire at ``until``, in unix seconds."""
        self._known = _select_newest({**self._known, token_id: until}, MAX_KNOWN)


class TeamRevocations(Revocations):
    """The sessions revoked at any web node of the team of ``node``."""

    def __init__(self, node: SwarmNode) -> None:
        super().__init__()
        self._node = node
        self._own: dict[str, float] = {}
        self._watch = node.entangled.watch(REVOKED_KEY, self._on_records, keep=True)

    def revoke(self, token_id: str, until: float) -> None:
        """Revoke a session here, and publish the revocation to the other web nodes."""
        self._add_known({token_id: until})
        own = {each: end for each, end in self._own.items() if end > self._node.wall()}
        self._own = _select_newest({**own, token_id: until}, MAX_PUBLISHED)
        ends = {bytes.fromhex(each): int(min(end, MAX_NUMBER)) for each, end in self._own.items()}
        self._node.entangled.put(REVOKED_KEY, SLOT, check_size(bytes(msgpack.packb(ends))), "team").addErrback(
            _ignore_failure
        )

    def _on_records(self, records: list[Record]) -> None:
        for record in records:
            self._add_known(read_revocations(record))

    def _add_known(self, ends: Mapping[str, float]) -> None:
        # A revocation stays valid when its publisher leaves.  The table is replaced, never modified, because other
        # threads read it.
        now = self._node.wall()
        known = {each: end for each, end in self._known.items() if end > now}
        self._known = _select_newest({**known, **{each: end for each, end in ends.items() if end > now}}, MAX_KNOWN)


def read_revocations(record: Record) -> Mapping[str, float]:
    """Return the sessions that a record revokes, by id with their time of expiry; empty if it is invalid."""
    content: dict[Any, Any] | None = parse_mapping(record) if record.name == SLOT else None
    return {
        each.hex(): float(end)
        for each, end in (content or {}).items()
        if isinstance(each, bytes) and len(each) == ID_BYTES and is_number(end)
    }


def _select_newest(ends: Mapping[str, float], max_count: int) -> dict[str, float]:
    return dict(list(ends.items())[-max_count:])


def _ignore_failure(failure: Any) -> None:
    """Ignore the failure: no replica could be reached, but the revocation is valid at this node."""
    failure.trap(EntangledError)
