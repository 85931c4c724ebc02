"""Audience: those who offered bids to this node and are owed what is announced; pure."""

from __future__ import annotations

from dataclasses import dataclass

from middleware.dissemination.announcement import Announcement
from middleware.dissemination.errand import Notice
from middleware.entangled.kademlia.contact import Contact

MAX_LISTENERS = 1024
"""Beyond it the one that came first goes; it will ask by itself."""
MAX_TRIES = 2
"""Errands in a row that may fail before a listener is left to ask by itself."""
NOTHING = (0, 0)


@dataclass
class _Listener:
    """``knows`` is the precedence of the last announcement that it has confirmed."""

    contact: Contact
    is_shared: bool
    knows: tuple[int, int] = NOTHING
    is_asked: bool = False
    failures: int = 0


class Audience:
    """The listeners of one node in one auction.

    One that is shared with the rest of the council hears an announcement from the member who made it, the others hear
    all of them from here.
    """

    def __init__(self) -> None:
        self._listeners: dict[bytes, _Listener] = {}

    def __len__(self) -> int:
        return len(self._listeners)

    @property
    def is_shared(self) -> bool:
        """Whether most listeners are shared, as where every bidder tells the whole council."""
        shared = sum(1 for listener in self._listeners.values() if listener.is_shared)
        return 2 * shared > len(self._listeners)

    def add(self, contact: Contact, is_shared: bool = False) -> None:
        """Let ``contact`` hear what is announced; it has shown that it lives."""
        known = self._listeners.get(contact.node_id)
        if known is not None:
            known.contact, known.failures = contact, 0
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

    def notices(self, announcement: Announcement | None, is_mine: bool) -> list[Notice]:
        """What is owed now; nobody is owed two things at once."""
        if announcement is None:
            return []
        owed = []
        for listener in self._listeners.values():
            is_late = listener.knows < announcement.precedence and listener.failures < MAX_TRIES
            if is_late and not listener.is_asked and (is_mine or not listener.is_shared):
                listener.is_asked = True
                owed.append(Notice(listener.contact, announcement))
        return owed

    def answered(self, notice: Notice) -> None:
        """Take note that a listener confirmed."""
        self._settled(notice, 0)
        self.knows(notice.to, notice.announcement)

    def failed(self, notice: Notice) -> None:
        """Take note that a listener did not answer."""
        self._settled(notice, 1)

    def _settled(self, notice: Notice, failures: int) -> None:
        listener = self._listeners.get(notice.to.node_id)
        if listener is not None:
            listener.is_asked = False
            listener.failures = listener.failures + 1 if failures else 0
