"""Lookup: one iterative search for the k nodes closest to an id (Kademlia, section 2.3).

Pure: says whom to ask, is told what came of it, and knows when it is done.  It ends when the k closest known contacts
that have not failed have all answered, so in a quiet connected network it finds exactly the k closest nodes.
"""

from __future__ import annotations

from bisect import insort
from collections.abc import Iterable
from enum import Enum

from middleware.entangled.contact import Contact
from middleware.entangled.kademlia.distance import closest, distance


class _State(Enum):
    """What is known of a candidate."""

    NEW = "new"
    ASKED = "asked"
    SLOW = "slow"
    ANSWERED = "answered"
    FAILED = "failed"


class Lookup:
    """A search for ``target`` that begins at ``seeds``.

    ``k`` is how many are wanted; ``alpha`` how many are asked at the same time: more is quicker in bad weather and
    costs more datagrams.  ``exclude`` is the id of the node that searches; it is never asked and never found.
    """

    def __init__(
        self, target: bytes, k: int, alpha: int, seeds: Iterable[Contact], exclude: bytes | None = None
    ) -> None:
        self._target = target
        self._k = k
        self._alpha = alpha
        self._exclude = exclude
        self._contacts: dict[bytes, Contact] = {}
        self._states: dict[bytes, _State] = {}
        self._order: list[tuple[int, bytes]] = []
        self._in_flight = 0
        for contact in seeds:
            self._add(contact)

    @property
    def is_finished(self) -> bool:
        """Whether the k closest candidates that have not failed have all answered; so too where there are none."""
        return all(self._states[node_id] is _State.ANSWERED for node_id in self._nearest(_State.FAILED))

    def next(self) -> list[Contact]:
        """Whom to ask now, closest first; from now on they count as asked."""
        asked = []
        # While a slow one is given time, the next closest is asked in its stead: it stands ready if the slow one is
        # lost.
        for node_id in self._nearest(_State.FAILED, _State.SLOW):
            if self._in_flight >= self._alpha:
                break
            if self._states[node_id] is _State.NEW:
                self._move(node_id, _State.ASKED)
                asked.append(self._contacts[node_id])
        return asked

    def answered(self, contact: Contact, contacts: Iterable[Contact]) -> None:
        """Take in that ``contact`` answered with ``contacts``; of those at most the k closest are believed."""
        if self._was_asked(contact):
            self._move(contact.node_id, _State.ANSWERED)
            for found in closest(contacts, self._target, self._k):
                self._add(found)

    def failed(self, contact: Contact) -> None:
        """Give up on ``contact``."""
        if self._was_asked(contact):
            self._move(contact.node_id, _State.FAILED)

    def slow(self, contact: Contact) -> None:
        """Free the place of ``contact`` among those in flight without giving up on it (a hedge)."""
        if self._states.get(contact.node_id) is _State.ASKED:
            self._move(contact.node_id, _State.SLOW)

    def closest(self) -> list[Contact]:
        """The k closest contacts that have answered, closest first."""
        answered = [c for node_id, c in self._contacts.items() if self._states[node_id] is _State.ANSWERED]
        return closest(answered, self._target, self._k)

    def _add(self, contact: Contact) -> None:
        if contact.node_id != self._exclude and contact.node_id not in self._contacts:
            self._contacts[contact.node_id] = contact
            self._states[contact.node_id] = _State.NEW
            insort(self._order, (distance(contact.node_id, self._target), contact.node_id))

    def _was_asked(self, contact: Contact) -> bool:
        return self._states.get(contact.node_id, _State.NEW) is not _State.NEW

    def _move(self, node_id: bytes, state: _State) -> None:
        self._in_flight += (state is _State.ASKED) - (self._states[node_id] is _State.ASKED)
        self._states[node_id] = state

    def _nearest(self, *without: _State) -> list[bytes]:
        """The k closest candidates in none of these states."""
        nearest: list[bytes] = []
        for _, node_id in self._order:
            if self._states[node_id] not in without:
                nearest.append(node_id)
                if len(nearest) == self._k:
                    break
        return nearest
