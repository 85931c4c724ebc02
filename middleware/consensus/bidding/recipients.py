"""The nodes that offered bids to this node and receive its announcements; pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

from middleware.consensus.bidding.announcement import Announcement
from middleware.consensus.bidding.outgoing_message import Notice
from middleware.entangled.contact import Contact

MAX_RECIPIENTS = 1024
"""Maximum number of listeners; the oldest is removed, and then has to request the announcement."""
RETRY_PAUSES_S = (0.0, 1.0, 2.0, 4.0)
"""Seconds between each failed message and the next message; after the last failure, the listener has to request the
announcement."""
NO_PRECEDENCE = (0, 0)


@dataclass
class _Recipient:
    """``known_precedence`` is the precedence of the last announcement that the listener has confirmed."""

    contact: Contact
    is_shared: bool
    known_precedence: tuple[int, int] = NO_PRECEDENCE
    is_pending: bool = False
    failures: int = 0
    send_at: float = 0.0


class Recipients:
    """The listeners of one node in one auction: nodes that get the announcement from this node.

    A *shared* listener has sent its bid to all quorum members, so it receives each announcement from the member that
    made it. All other listeners receive all announcements from this node.
    """

    def __init__(self) -> None:
        self._recipients: dict[bytes, _Recipient] = {}

    def __len__(self) -> int:
        return len(self._recipients)

    def has(self, contact: Contact) -> bool:
        """Return whether ``contact`` is a listener."""
        return contact.node_id in self._recipients

    @property
    def is_shared(self) -> bool:
        """Whether most listeners are shared; this is so in a small team."""
        shared = sum(1 for recipient in self._recipients.values() if recipient.is_shared)
        return 2 * shared > len(self._recipients)

    def add(self, contact: Contact, is_shared: bool = False) -> None:
        """Add ``contact`` as a listener, or update a known listener, because ``contact`` is reachable now."""
        known = self._recipients.get(contact.node_id)
        if known is not None:
            known.contact, known.failures, known.send_at = contact, 0, 0.0
            known.is_shared = known.is_shared and is_shared
            return
        if len(self._recipients) >= MAX_RECIPIENTS:
            del self._recipients[next(iter(self._recipients))]
        self._recipients[contact.node_id] = _Recipient(contact, is_shared)

    def record_known(self, contact: Contact, announcement: Announcement) -> None:
        """Record that a listener knows this announcement."""
        recipient = self._recipients.get(contact.node_id)
        if recipient is not None:
            recipient.known_precedence = max(recipient.known_precedence, announcement.precedence)

    def compute_due(self, announcement: Announcement | None, is_mine: bool) -> float:
        """Return the time of the next message to a listener."""
        uninformed = self._find_uninformed(announcement, is_mine)
        return min((recipient.send_at for recipient in uninformed), default=math.inf)

    def take_due_notices(self, announcement: Announcement | None, is_mine: bool, now: float) -> list[Notice]:
        """Return the messages that are due now, at most one per listener."""
        out = []
        for recipient in self._find_uninformed(announcement, is_mine):
            if announcement is not None and recipient.send_at <= now:
                recipient.is_pending = True
                out.append(Notice(recipient.contact, announcement))
        return out

    def on_answer(self, notice: Notice) -> None:
        """Record that a listener confirmed the announcement."""
        recipient = self._recipients.get(notice.to.node_id)
        if recipient is not None:
            recipient.is_pending, recipient.failures, recipient.send_at = False, 0, 0.0
        self.record_known(notice.to, notice.announcement)

    def on_failure(self, notice: Notice, now: float) -> None:
        """Record that a listener did not answer."""
        recipient = self._recipients.get(notice.to.node_id)
        if recipient is not None:
            recipient.is_pending = False
            is_last = recipient.failures >= len(RETRY_PAUSES_S)
            recipient.send_at = math.inf if is_last else now + RETRY_PAUSES_S[recipient.failures]
            recipient.failures += 1

    def _find_uninformed(self, announcement: Announcement | None, is_mine: bool) -> list[_Recipient]:
        """Return the listeners that do not know ``announcement`` and have no pending message."""
        if announcement is None:
            return []
        return [
            recipient
            for recipient in self._recipients.values()
            if recipient.known_precedence < announcement.precedence
            and not recipient.is_pending
            and (is_mine or not recipient.is_shared)
        ]
