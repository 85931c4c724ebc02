"""Track one iterative search for the k nodes closest to an id (Kademlia, section 2.3), without I/O.

The caller sends requests to the contacts that ``take_next`` returns, and reports the results.  The lookup ends when the
k closest known contacts, except failed ones, have answered.  In a stable connected network it therefore finds exactly
the k closest nodes.
"""

from __future__ import annotations

from bisect import insort
from collections.abc import Iterable
from enum import Enum

from middleware.entangled.contact import Contact
from middleware.entangled.kademlia.distance import distance, select_closest


class _State(Enum):
    """The state of a candidate."""

    NEW = "new"
    ASKED = "asked"
    SLOW = "slow"
    ANSWERED = "answered"
    FAILED = "failed"


class Lookup:
    """A search for ``target`` that starts from ``seeds``.

    ``k`` is the number of contacts to find.  ``alpha`` is the number of parallel requests; a higher number is faster on
    lossy links, but needs more datagrams.  ``exclude`` is the id of the searching node, which is never asked and never
    found.
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
        """Whether the k closest candidates that have not failed have answered; True if there are no candidates."""
        return all(self._states[node_id] is _State.ANSWERED for node_id in self._nearest(_State.FAILED))

    def take_next(self) -> list[Contact]:
        """Return the contacts to ask now, closest first, and mark them as asked."""
        asked = []
        # While a slow contact may still answer, the next closest contact is also asked, in case the slow contact fails.
        for node_id in self._nearest(_State.FAILED, _State.SLOW):
            if self._in_flight >= self._alpha:
                break
            if self._states[node_id] is _State.NEW:
                self._set_state(node_id, _State.ASKED)
                asked.append(self._contacts[node_id])
        return asked

    def record_answer(self, contact: Contact, contacts: Iterable[Contact]) -> None:
        """Record that ``contact`` answered with ``contacts``; use at most the k closest of them."""
        if self._was_asked(contact):
            self._set_state(contact.node_id, _State.ANSWERED)
            for found in select_closest(contacts, self._target, self._k):
                self._add(found)

    def record_failure(self, contact: Contact) -> None:
        """Record that ``contact`` did not answer."""
        if self._was_asked(contact):
            self._set_state(contact.node_id, _State.FAILED)

    def mark_slow(self, contact: Contact) -> None:
        """No longer count ``contact`` among the parallel requests; its answer is still accepted (a hedge)."""
        if self._states.get(contact.node_id) is _State.ASKED:
            self._set_state(contact.node_id, _State.SLOW)

    def closest(self) -> list[Contact]:
        """Return the k closest contacts that have answered, closest first."""
        answered = [c for node_id, c in self._contacts.items() if self._states[node_id] is _State.ANSWERED]
        return select_closest(answered, self._target, self._k)

    def _add(self, contact: Contact) -> None:
        if contact.node_id != self._exclude and contact.node_id not in self._contacts:
            self._contacts[contact.node_id] = contact
            self._states[contact.node_id] = _State.NEW
            insort(self._order, (distance(contact.node_id, self._target), contact.node_id))

    def _was_asked(self, contact: Contact) -> bool:
        return self._states.get(contact.node_id, _State.NEW) is not _State.NEW

    def _set_state(self, node_id: bytes, state: _State) -> None:
        self._in_flight += (state is _State.ASKED) - (self._states[node_id] is _State.ASKED)
        self._states[node_id] = state

    def _nearest(self, *without: _State) -> list[bytes]:
        """Return the k closest candidates that are in none of the given states."""
        nearest: list[bytes] = []
        for _, node_id in self._order:
            if self._states[node_id] not in without:
                nearest.append(node_id)
                if len(nearest) == self._k:
                    break
        return nearest
