"""Ledger: which questions run or have been run, so that a repeated one is answered and not run again."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from middleware.entangled.wire.session import Session

KEPT_S = 30.0
MAX_PER_PEER = 1024
MAX_ENTRIES = 16384


@dataclass(slots=True)
class Entry:
    """One question; ``answer`` is None while it runs, ``session`` is where the answer goes (None: nowhere yet)."""

    session: Session | None
    answer: bytes | None = None
    ended_at: float = 0.0


class Ledger:
    """The questions that run, and those that ended in the last ``KEPT_S`` seconds, by (public key, question id).

    When it is full new questions are turned away: forgetting an old one early could run a change twice.
    """

    def __init__(self) -> None:
        self._running: dict[tuple[bytes, int], Entry] = {}
        self._ended: dict[tuple[bytes, int], Entry] = {}
        self._per_peer: Counter[bytes] = Counter()

    def __len__(self) -> int:
        return len(self._running) + len(self._ended)

    def entry(self, public: bytes, question: int) -> Entry | None:
        """What is known of a question."""
        key = (public, question)
        return self._running.get(key) or self._ended.get(key)

    def begin(self, public: bytes, question: int, session: Session | None, now: float) -> Entry | None:
        """Enter a question that is about to run; None where there is no room."""
        self._expire(now)
        if len(self) >= MAX_ENTRIES or self._per_peer[public] >= MAX_PER_PEER:
            return None
        entry = self._running[public, question] = Entry(session)
        self._per_peer[public] += 1
        return entry

    def end(self, public: bytes, question: int, answer: bytes | None, now: float) -> None:
        """Keep the ``answer`` of a question that ran, or forget the question where it is None and may run again."""
        entry = self._running.pop((public, question), None)
        if entry is None:
            return
        if answer is None:
            self._count_down(public)
        else:
            entry.answer, entry.ended_at, entry.session = answer, now, None
            self._ended[public, question] = entry

    def clear(self) -> None:
        """Forget everything."""
        self._running.clear()
        self._ended.clear()
        self._per_peer.clear()

    def _expire(self, now: float) -> None:
        while self._ended:
            key = next(iter(self._ended))
            if self._ended[key].ended_at > now - KEPT_S:
                return
            del self._ended[key]
            self._count_down(key[0])

    def _count_down(self, public: bytes) -> None:
        self._per_peer[public] -= 1
        if not self._per_peer[public]:
            del self._per_peer[public]
