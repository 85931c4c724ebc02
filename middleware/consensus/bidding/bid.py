"""A bid is one agent's report for one auction, signed by the agent; pure.

A forwarding node may drop or delay a bid, but cannot change it.  A later bid of the same agent has a higher revision
and replaces the earlier bid; a bid without a report withdraws it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import msgpack

from middleware.consensus.bidding.auction import Auction
from middleware.consensus.strategy import Report
from middleware.entangled.identity import Identity, derive_node_id, is_signature_valid
from middleware.entangled.value import is_natural, is_number

MAX_TEXT_CHARACTERS = 200
MAX_ITEMS = 16
_DEFAULTS = {f.name: f.default for f in fields(Report) if f.default is not MISSING}


@dataclass(frozen=True)
class Bid:
    """A bid of the agent with the key ``public``; ``report`` is None if the agent withdraws its earlier bid."""

    public: bytes
    report: Report | None
    revision: int = 0
    signature: bytes = field(default=b"", compare=False)

    @cached_property
    def agent(self) -> str:
        """The bidder's uuid."""
        return derive_node_id(self.public).hex()

    @cached_property
    def rank(self) -> tuple[int, bytes]:
        """The sort key: of two bids of one agent, the one with the higher key is valid, even if revisions are equal."""
        content = msgpack.packb(pack_report(self.report))
        return self.revision, hashlib.blake2s(content, digest_size=8).digest()

    def sign(self, identity: Identity, auction: Auction) -> Bid:
        """Return this bid with its agent's signature for ``auction``."""
        return replace(self, signature=identity.sign(self._signed_bytes(auction)))

    def is_genuine(self, auction: Auction) -> bool:
        """Return whether the agent signed exactly this bid for ``auction``."""
        return is_signature_valid(self.public, self._signed_bytes(auction), self.signature)

    def pack(self) -> list[object]:
        """Return the encoding for messages; the agent's uuid is derived from the key."""
        return [self.public, pack_report(self.report), self.revision, self.signature]

    def _signed_bytes(self, auction: Auction) -> bytes:
        return b"bid" + bytes(msgpack.packb([auction.digest, pack_report(self.report), self.revision]))


def parse_bid(content: object) -> Bid | None:
    """Decode a bid; None if it is malformed.  Never raises."""
    if not isinstance(content, list) or len(content) != 4:
        return None
    public, packed, revision, signature = content
    is_valid = (
        isinstance(public, bytes)
        and len(public) == 32
        and is_natural(revision)
        and isinstance(signature, bytes)
        and len(signature) == 64
    )
    if not is_valid:
        return None
    report = None if packed is None else parse_report(packed, derive_node_id(public).hex())
    return Bid(public, report, revision, signature) if packed is None or report is not None else None


def pack_report(report: Report | None) -> dict[str, object] | None:
    """Encode a report without its agent; fields with their default value are left out."""
    if report is None:
        return None
    content = {f.name: getattr(report, f.name) for f in fields(report) if f.name != "agent"}
    return {name: value for name, value in content.items() if name not in _DEFAULTS or value != _DEFAULTS[name]}


def parse_report(content: object, agent: str) -> Report | None:
    """Decode the report of ``agent``; None if it is malformed or its cost is invalid."""
    if not isinstance(content, Mapping) or not is_cost(content.get("cost")):
        return None
    others: dict[str, Any] = {name: _from_wire(value) for name, value in content.items() if name != "cost"}
    for name, value in others.items():
        default = _DEFAULTS.get(name, MISSING)
        if default is MISSING or not _matches_type(value, default):
            return None
    # Numbers keep their type (1 or 1.0), because the signature covers the encoded bytes.
    return Report(agent, content["cost"], **others)


def is_cost(value: object) -> bool:
    """Return whether ``value`` is a valid cost: a number of at least 0 that ``is_number`` accepts."""
    return is_number(value) and value >= 0  # type: ignore[operator]


def _from_wire(value: object) -> object:
    """Convert a decoded value: tuples were encoded as lists."""
    return tuple(value) if isinstance(value, list) else value


def _matches_type(value: object, default: object) -> bool:
    """Return whether ``value`` is valid for a field with the default ``default``."""
    if isinstance(value, tuple):
        return isinstance(default, tuple) and len(value) <= MAX_ITEMS and all(map(_is_item, value))
    if isinstance(default, float):
        return is_number(value)
    return type(value) is type(default) and (isinstance(value, bool) or _is_item(value))


def _is_item(value: object) -> bool:
    return len(value) <= MAX_TEXT_CHARACTERS if isinstance(value, str) else is_number(value)
