"""Audience: those who offered bids to this node and are owed what is announced; pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

from middleware.consensus.bidding.announcement import Announcement
from middleware.consensus.bidding.errand import Notice
from middleware.entangled.contact import Contact

MAX_LISTENERS = 1024
"""Beyond it the one that came first goes; it will ask by itself."""
PAUSES = (0.0, 1.0, 2.0, 4.0)
"""Seconds after each failed errand until the next; after the last a listener is left to ask by itself."""
NOTHING = (0, 0)


@dataclass
class _Listener:
    """``knows`` is the precedence of the last announcement that it has confirmed."""

    contact: Contact
    is_shared: bool
    knows: tuple[int, int] = NOTHING
    is_asked: bool = False
    failures: int = 0
    ask_at: float = 0.0


class Audience:
    """The listeners of one node in one auction.

    One that is shared with the rest of the council hears an announcement from the member who made it, the others hear
    all of them from here.
    """

    def __init__(self) -> None:
        self._listeners: dict[bytes, _Listener] = {}

    def __len__(self) -> int:
        return len(self._listeners)

    def has(self, contact: Contact) -> bool:
        """Whether ``contact`` is one of them."""
        return contact.node_id in self._listeners

    @property
    def is_shared(self) -> bool:
        """Whether most listeners are shared, as where every bidder tells the whole council."""
        shared = sum(1 for listener in self._listeners.values() if listener.is_shared)
        return 2 * shared > len(self._listeners)

    def add(self, contact: Contact, is_shared: bool = False) -> None:
        """Let ``contact`` hear what is announced; it has shown that it lives."""
        known = self._listeners.get(contact.node_id)
        if known is not None:
            known.contact, known.failures, known.ask_at = contact, 0, 0.0
            known.is_shared = known.is_shared and is_shared
            return
        if len(self._listeners) >= MAX_LISTENERS:
            del self._listeners[next(iter(self._listeners))]
        self._listeners[contact.node_id] = _Listener(contact, is_shared)

    def knows(self, contact: Contact, announcement: Announcement) -> None:
        """Take note that a listener has this announcement."""
        listener = self._listeners.get(contact.node_id)
        if listener is not None:
            listener.knows = max(listener.knows, announcement.precedence)

    def due(self, announcement: Announcement | None, is_mine: bool) -> float:
        """When somebody is owed something."""
        owed = self._owed(announcement, is_mine)
        return min((listener.ask_at for listener in owed), default=math.inf)

    def notices(self, announcement: Announcement | None, is_mine: bool, now: float) -> list[Notice]:
        """What is owed now; nobody is owed two things at once."""
        out = []
        for listener in self._owed(announcement, is_mine):
            if announcement is not None and listener.ask_at <= now:
                listener.is_asked = True
                out.append(Notice(listener.contact, announcement))
        return out

    def answered(self, notice: Notice) -> None:
        """Take note that a listener confirmed."""
        listener = self._listeners.get(notice.to.node_id)
        if listener is not None:
            listener.is_asked, listener.failures, listener.ask_at = False, 0, 0.0
        self.knows(notice.to, notice.announcement)

    def failed(self, notice: Notice, now: float) -> None:
        """Take note that a listener did not answer."""
        listener = self._listeners.get(notice.to.node_id)
        if listener is not None:
            listener.is_asked = False
            is_last = listener.failures >= len(PAUSES)
            listener.ask_at = math.inf if is_last else now + PAUSES[listener.failures]
            listener.failures += 1

    def _owed(self, announcement: Announcement | None, is_mine: bool) -> list[_Listener]:
        """The listeners that do not know ``announcement`` and are not being told it."""
        if announcement is None:
            return []
        return [
            listener
            for listener in self._listeners.values()
            if listener.knows < announcement.precedence
            and not listener.is_asked
            and (is_mine or not listener.is_shared)
        ]
