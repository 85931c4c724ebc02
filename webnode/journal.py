"""Journal: what changed from one state of the team to the next, numbered, and kept for a while.  Pure.

A page that was away for a moment is told what it missed; one that was away for longer, or that comes from another
node, is told everything anew.  Numbers hold for one node and one start of it, which ``epoch`` names.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from webnode.state import State

KEPT = 64
"""Changes that are kept; who missed more is better served with the whole state."""
KEYS: Mapping[str, str] = {"devices": "uuid", "tasks": "id", "groups": "task"}
"""The parts of a state that are lists, each with what tells its rows apart."""


@dataclass(frozen=True)
class Change:
    """What is different: rows that are new or other, ids of those that are gone, and values that are no lists.

    ``words`` is the ``content`` as JSON, made once for all who are told.
    """

    n: int
    content: Mapping[str, Any]
    words: str


class Journal:
    """The newest state and the changes that led to it."""

    def __init__(self, epoch: str) -> None:
        self.state: State = {}
        self.n = 0
        self._epoch = epoch
        self._changes: deque[Change] = deque(maxlen=KEPT)
        self._rows: dict[str, dict[str, str]] = {name: {} for name in KEYS}

    def take(self, state: State) -> Change | None:
        """Take the next state; returns what is different, or None.

        Raises ``ValueError`` where JSON cannot carry it; then nothing is taken.
        """
        rows = {name: {row[key]: dumped(row) for row in state.get(name, ())} for name, key in KEYS.items()}
        content: dict[str, Any] = {}
        for name, now in rows.items():
            before = self._rows[name]
            if now == before:
                continue
            content[name] = [row for row in state[name] if before.get(row[KEYS[name]]) != now[row[KEYS[name]]]]
            gone = [each for each in before if each not in now]
            if gone:
                content.setdefault("without", {})[name] = gone
        content |= {
            name: value for name, value in state.items() if name not in KEYS and self.state.get(name, self) != value
        }
        if not content and self.n:
            return None
        change = Change(self.n + 1, content, dumped(content))
        self.n += 1
        self.state, self._rows = state, rows
        self._changes.append(change)
        return change

    def id(self, n: int) -> str:
        """What a page is told that it knows, having heard everything up to ``n``."""
        return f"{self._epoch}-{n}"

    def number(self, name: str) -> int:
        """What ``name`` stands for; 0, nothing heard, where it is of another node, another start or no id at all."""
        epoch, _, n = name.rpartition("-")
        is_ours = epoch == self._epoch and n.isascii() and n.isdigit() and len(n) < 18
        return int(n) if is_ours and int(n) <= self.n else 0

    def since(self, n: int) -> list[Change] | None:
        """The changes after ``n``, or None where not all of them are kept."""
        if n <= 0 or (self._changes and n < self._changes[0].n - 1):
            return None
        return [change for change in self._changes if change.n > n]


def dumped(content: object) -> str:
    """JSON in as few bytes as it takes; raises ``ValueError`` where there is none."""
    return json.dumps(content, separators=(",", ":"), allow_nan=False)
