"""The nodes that offered bids to this node and receive its announcements; pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

from middleware.consensus.bidding.announcement import Announcement
from middleware.consensus.bidding.errand import Notice
from middleware.entangled.contact import Contact

MAX_LISTENERS = 1024
"""Maximum number of listeners; the oldest is removed, and asks for the announcement itself."""
PAUSES = (0.0, 1.0, 2.0, 4.0)
"""Seconds after each failed message until the next; after the last one a listener must ask itself."""
NOTHING = (0, 0)


@dataclass
class _Listener:
    """``knows`` is the precedence of the last announcement that the listener has confirmed."""

    contact: Contact
    is_shared: bool
    knows: tuple[int, int] = NOTHING
    is_asked: bool = False
    failures: int = 0
    ask_at: float = 0.0


class Audience:
    """The listeners of one node in one auction.

    A listener that is shared with the other quorum members receives an announcement from the member that made it; the
    others receive all announcements from this node.
    """

    def __init__(self) -> None:
        self._listeners: dict[bytes, _Listener] = {}

    def __len__(self) -> int:
        return len(self._listeners)

    def has(self, contact: Contact) -> bool:
        """Return whether ``contact`` is a listener."""
        return contact.node_id in self._listeners

    @property
    def is_shared(self) -> bool:
        """Whether most listeners are shared, as in a small team, in which every bidder sends to all quorum members."""
        shared = sum(1 for listener in self._listeners.values() if listener.is_shared)
        return 2 * shared > len(self._listeners)

    def add(self, contact: Contact, is_shared: bool = False) -> None:
        """Add ``contact`` as a listener, or update it; it is reachable at present."""
        known = self._listeners.get(contact.node_id)
        if known is not None:
            known.contact, known.failures, known.ask_at = contact, 0, 0.0
            known.is_shared = known.is_shared and is_shared
            return
        if len(self._listeners) >= MAX_LISTENERS:
            del self._listeners[next(iter(self._listeners))]
        self._listeners[contact.node_id] = _Listener(contact, is_shared)

    def knows(self, contact: Contact, announcement: Announcement) -> None:
        """Record that a listener has this announcement."""
        listener = self._listeners.get(contact.node_id)
        if listener is not None:
            listener.knows = max(listener.knows, announcement.precedence)

    def due(self, announcement: Announcement | None, is_mine: bool) -> float:
        """Return the time of the next message to a listener."""
        owed = self._owed(announcement, is_mine)
        return min((listener.ask_at for listener in owed), default=math.inf)

    def notices(self, announcement: Announcement | None, is_mine: bool, now: float) -> list[Notice]:
        """Return the messages that are due now, at most one per listener."""
        out = []
        for listener in self._owed(announcement, is_mine):
            if announcement is not None and listener.ask_at <= now:
                listener.is_asked = True
                out.append(Notice(listener.contact, announcement))
        return out

    def answered(self, notice: Notice) -> None:
        """Record that a listener confirmed the announcement."""
        listener = self._listeners.get(notice.to.node_id)
        if listener is not None:
            listener.is_asked, listener.failures, listener.ask_at = False, 0, 0.0
        self.knows(notice.to, notice.announcement)

    def failed(self, notice: Notice, now: float) -> None:
        """Record that a listener did not answer."""
        listener = self._listeners.get(notice.to.node_id)
        if listener is not None:
            listener.is_asked = False
            is_last = listener.failures >= len(PAUSES)
            listener.ask_at = math.inf if is_last else now + PAUSES[listener.failures]
            listener.failures += 1

    def _owed(self, announcement: Announcement | None, is_mine: bool) -> list[_Listener]:
        """Return the listeners that do not know ``announcement`` and have no message under way."""
        if announcement is None:
            return []
        return [
            listener
            for listener in self._listeners.values()
            if listener.knows < announcement.precedence
            and not listener.is_asked
            and (is_mine or not listener.is_shared)
        ]
