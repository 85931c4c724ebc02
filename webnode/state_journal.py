"""Number the changes between successive states of the team, and keep the newest.  Pure.

A page that reconnects after a short interruption gets the changes that it missed; otherwise it gets the whole state.
Change numbers are valid for one process run of one node, which ``epoch`` identifies.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from webnode.state import State

MAX_CHANGES = 64
"""Number of changes kept; a page that missed more gets the whole state."""
KEYS: Mapping[str, str] = {"devices": "uuid", "tasks": "id", "groups": "task"}
"""The parts of a state that are lists, each with the key that identifies its rows."""


@dataclass(frozen=True)
class Change:
    """The difference between two states: new and changed rows, ids of removed rows, and changed values.

    ``encoded`` is ``content`` as JSON, encoded once for all pages.
    """

    n: int
    content: Mapping[str, Any]
    encoded: str


class Journal:
    """The newest state and the changes that led to it."""

    def __init__(self, epoch: str) -> None:
        self.state: State = {}
        self.n = 0
        self._epoch = epoch
        self._changes: deque[Change] = deque(maxlen=MAX_CHANGES)
        self._rows: dict[str, dict[str, str]] = {name: {} for name in KEYS}

    def add_state(self, state: State) -> Change | None:
        """Store the next state and return its difference, or None if it is equal.

        Raises ``ValueError`` if JSON cannot represent it; then the journal does not change.
        """
        rows = {name: {row[key]: encode_json(row) for row in state.get(name, ())} for name, key in KEYS.items()}
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
        change = Change(self.n + 1, content, encode_json(content))
        self.n += 1
        self.state, self._rows = state, rows
        self._changes.append(change)
        return change

    def make_event_id(self, n: int) -> str:
        """Return the event id of a page that has received all changes up to ``n``."""
        return f"{self._epoch}-{n}"

    def parse_event_id(self, name: str) -> int:
        """Return the change number of an event id; 0 if it is invalid or belongs to another node or run."""
        epoch, _, n = name.rpartition("-")
        is_ours = epoch == self._epoch and n.isascii() and n.isdigit() and len(n) < 18
        return int(n) if is_ours and int(n) <= self.n else 0

    def list_since(self, n: int) -> list[Change] | None:
        """Return the changes after ``n``, or None if some of them are no longer kept."""
        if n <= 0 or (self._changes and n < self._changes[0].n - 1):
            return None
        return [change for change in self._changes if change.n > n]


def encode_json(content: object) -> str:
    """Encode compact JSON; raises ``ValueError`` if that is not possible."""
    return json.dumps(content, separators=(",", ":"), allow_nan=False)
