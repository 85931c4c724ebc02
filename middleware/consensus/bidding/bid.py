"""Bid: one agent's report for one auction, signed by the agent itself; pure.

Whoever carries it may drop it or hold it back, but cannot change it.  A later bid of the same agent has a higher
revision and takes the place of the earlier; one without a report takes it back.
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
from middleware.entangled.identity import Identity, node_id, verified
from middleware.entangled.value import is_number, is_whole

MAX_TEXT = 200
MAX_ITEMS = 16
_DEFAULTS = {f.name: f.default for f in fields(Report) if f.default is not MISSING}


@dataclass(frozen=True)
class Bid:
    """What the holder of ``public`` reports, or None where it takes its bid back."""

    public: bytes
    report: Report | None
    revision: int = 0
    signature: bytes = field(default=b"", compare=False)

    @cached_property
    def agent(self) -> str:
        """The bidder's uuid."""
        return node_id(self.public).hex()

    @cached_property
    def rank(self) -> tuple[int, bytes]:
        """Of two bids of one agent the one with the higher rank holds, also where the agent says two things at once."""
        content = msgpack.packb(packed_report(self.report))
        return self.revision, hashlib.blake2s(content, digest_size=8).digest()

    def signed(self, identity: Identity, auction: Auction) -> Bid:
        """This bid with its owner's signature for ``auction``."""
        return replace(self, signature=identity.sign(self._signed_bytes(auction)))

    def is_genuine(self, auction: Auction) -> bool:
        """Whether its owner signed exactly this, for exactly this auction."""
        return verified(self.public, self._signed_bytes(auction), self.signature)

    def packed(self) -> list[object]:
        """The bid as it stands in a message; the agent's uuid follows from the key."""
        return [self.public, packed_report(self.report), self.revision, self.signature]

    def _signed_bytes(self, auction: Auction) -> bytes:
        return b"bid" + bytes(msgpack.packb([auction.digest, packed_report(self.report), self.revision]))


def bid_of(content: object) -> Bid | None:
    """The bid that ``packed`` made, or None where it cannot be one; never raises."""
    if not isinstance(content, list) or len(content) != 4:
        return None
    public, packed, revision, signature = content
    lawful = (
        isinstance(public, bytes)
        and len(public) == 32
        and is_whole(revision)
        and isinstance(signature, bytes)
        and len(signature) == 64
    )
    if not lawful:
        return None
    report = None if packed is None else report_of(packed, node_id(public).hex())
    return Bid(public, report, revision, signature) if packed is None or report is not None else None


def packed_report(report: Report | None) -> dict[str, object] | None:
    """What a report says beyond its agent; what is as usual is left out."""
    if report is None:
        return None
    content = {f.name: getattr(report, f.name) for f in fields(report) if f.name != "agent"}
    return {name: value for name, value in content.items() if name not in _DEFAULTS or value != _DEFAULTS[name]}


def report_of(content: object, agent: str) -> Report | None:
    """The report of ``agent`` in what ``packed_report`` made, or None; a cost that is no finite distance is none."""
    if not isinstance(content, Mapping) or not is_cost(content.get("cost")):
        return None
    others: dict[str, Any] = {name: _as_sent(value) for name, value in content.items() if name != "cost"}
    for name, value in others.items():
        usual = _DEFAULTS.get(name, MISSING)
        if usual is MISSING or not _is_like(value, usual):
            return None
    # Numbers stay as they came: the signature is over their bytes.
    return Report(agent, content["cost"], **others)


def is_cost(value: object) -> bool:
    """Whether ``value`` is what acting may cost: finite, not negative, not enormous."""
    return is_number(value) and value >= 0  # type: ignore[operator]


def _as_sent(value: object) -> object:
    """What was packed: a tuple travels as a list."""
    return tuple(value) if isinstance(value, list) else value


def _is_like(value: object, usual: object) -> bool:
    """Whether a field that is usually ``usual`` may have ``value``."""
    if isinstance(value, tuple):
        return isinstance(usual, tuple) and len(value) <= MAX_ITEMS and all(map(_is_item, value))
    if isinstance(usual, float):
        return is_number(value)
    return type(value) is type(usual) and (isinstance(value, bool) or _is_item(value))


def _is_item(value: object) -> bool:
    return len(value) <= MAX_TEXT if isinstance(value, str) else is_number(value)
