"""An announcement contains the best bids of an auction, signed by one quorum member; pure.

A wrong announcement is harmless: it influences which agent should act, but only a lease gives the right to act.  Of two
announcements, the one with the higher number is valid; if the numbers are equal, the one from the member with the lower
rank is valid.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import msgpack

from middleware.consensus.bidding.auction import Auction
from middleware.consensus.bidding.bid import pack_report, parse_report
from middleware.consensus.bidding.merge_rule import MAX_REPORTS
from middleware.consensus.strategy import Report
from middleware.entangled.identity import is_signature_valid
from middleware.entangled.value import is_natural


@dataclass(frozen=True)
class AnnouncedReport:
    """One of the best reports, and the revision of its bid."""

    report: Report
    revision: int = 0


@dataclass(frozen=True)
class Announcement:
    """One announcement, with ``number`` counted from 1, of the quorum member with the given ``rank``."""

    number: int
    rank: int
    entries: tuple[AnnouncedReport, ...]
    signature: bytes = field(default=b"", compare=False)

    @property
    def precedence(self) -> tuple[int, int]:
        """The sort key: of two announcements the one with the higher key is valid."""
        return self.number, -self.rank

    @property
    def reports(self) -> tuple[Report, ...]:
        """The announced reports."""
        return tuple(entry.report for entry in self.entries)

    def sign(self, sign: Callable[[bytes], bytes], auction: Auction) -> Announcement:
        """Return this announcement for ``auction`` with the signature that ``sign`` returns."""
        return replace(self, signature=sign(self._signed_bytes(auction)))

    def is_genuine(self, auction: Auction) -> bool:
        """Return whether the quorum member with this rank signed exactly this announcement for ``auction``."""
        if self.rank >= len(auction.council):
            return False
        return is_signature_valid(auction.council[self.rank].public, self._signed_bytes(auction), self.signature)

    def pack(self) -> list[object]:
        """Return the encoding for messages."""
        return [self.number, self.rank, self._pack_entries(), self.signature]

    def _pack_entries(self) -> list[object]:
        return [[e.report.agent, pack_report(e.report), e.revision] for e in self.entries]

    def _signed_bytes(self, auction: Auction) -> bytes:
        content = [auction.digest, self.number, self.rank, self._pack_entries()]
        return b"announcement" + bytes(msgpack.packb(content))


def parse_announcement(content: object) -> Announcement | None:
    """Decode an announcement; None if it is malformed.  Never raises."""
    if not isinstance(content, list) or len(content) != 4:
        return None
    number, rank, packed, signature = content
    if not (is_natural(number) and is_natural(rank) and isinstance(signature, bytes) and len(signature) == 64):
        return None
    if not isinstance(packed, list) or len(packed) > MAX_REPORTS:
        return None
    entries = [entry for each in packed if (entry := _parse_entry(each)) is not None]
    if number == 0 or len({entry.report.agent for entry in entries}) != len(packed):
        return None
    return Announcement(number, rank, tuple(entries), signature)


def _parse_entry(content: object) -> AnnouncedReport | None:
    if not isinstance(content, list) or len(content) != 3:
        return None
    agent, packed, revision = content
    if not (isinstance(agent, str) and len(agent) == 40 and agent.isascii() and is_natural(revision)):
        return None
    report = parse_report(packed, agent)
    return AnnouncedReport(report, revision) if report is not None else None
