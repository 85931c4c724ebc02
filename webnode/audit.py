"""Write an audit log: one JSON line per change made through the page, in a file next to the node's store."""

from __future__ import annotations

import json
import os
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Mapping
from pathlib import Path

from twisted.logger import Logger

from webnode.auth import User
from webnode.sanitize import Json

MAX_LINES = 200
"""Number of newest lines kept in memory."""
MAX_FILE_BYTES = 1 << 20
"""Size limit of the file in bytes; a full file is renamed to ``.1``, so there are at most two."""
TAIL_BYTES = 1 << 16
QUIET_S, KNOWN = 60.0, 256
"""Seconds within which equal requests of a client without a session give one line; maximum number of such clients."""


class AuditLog:
    """The audit log in the file at ``path``, or only in memory if ``path`` is None; ``wall`` returns unix time.

    If the file cannot be written, the node's log gets one warning and the page continues to work.
    """

    _log = Logger()

    def __init__(
        self, path: Path | None = None, wall: Callable[[], float] = lambda: 0.0, max_bytes: int = MAX_FILE_BYTES
    ) -> None:
        self._path = path
        self._wall = wall
        self._max_bytes = max_bytes
        self._newest: deque[dict[str, Json]] = deque([] if path is None else _read_tail(path), maxlen=MAX_LINES)
        self._counts: Counter[tuple[str, str]] = Counter()
        self._repeated: OrderedDict[tuple[str, str, str], list[float]] = OrderedDict()
        self._is_failing = False

    def write(self, user: User, source: str, route: str, target: str, outcome: str) -> None:
        """Write one line: ``route`` is method and path, ``target`` the path parameters, ``outcome`` the status."""
        self._counts[user.role, outcome[:3]] += 1
        now = self._wall()
        repeated = self._count_repetitions((source, route, outcome), now) if user.role == "anyone" else 0
        if repeated is None:
            return
        line: dict[str, Json] = {"at": round(now, 3), "who": user.name, "role": user.role, "from": source}
        line |= {"session": user.token_id, "route": route, "target": target, "outcome": outcome}
        if repeated:
            line["repeated"] = repeated
        self._newest.appendleft(line)
        if self._path is None:
            return
        try:
            _append_line(self._path, json.dumps(line) + "\n", self._max_bytes)
        except OSError as error:
            if not self._is_failing:
                self._log.warn("cannot write the audit log {path}: {error}", path=self._path, error=error)
            self._is_failing = True
        else:
            self._is_failing = False

    def list_newest(self, count: int) -> list[dict[str, Json]]:
        """Return the newest lines, newest first; at most ``MAX_LINES``."""
        return list(self._newest)[:count]

    def get_counts(self) -> Mapping[tuple[str, str], int]:
        """Return the number of changes since the start by role and status, suppressed repetitions included."""
        return self._counts

    def _count_repetitions(self, key: tuple[str, str, str], now: float) -> int | None:
        """Return the number of repetitions suppressed since the last line; None if this one is suppressed, too."""
        known = self._repeated.get(key)
        if known is not None and 0.0 <= now - known[0] < QUIET_S:
            known[1] += 1
            return None
        self._repeated[key] = [now, 0]
        self._repeated.move_to_end(key)
        if len(self._repeated) > KNOWN:
            self._repeated.popitem(last=False)
        return 0 if known is None else int(known[1])


def _append_line(path: Path, line: str, max_bytes: int) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    with open(descriptor, "a", encoding="utf-8") as file:
        is_full = file.tell() + len(line) > max_bytes
        if not is_full:
            file.write(line)
    if is_full:
        os.replace(path, path.with_name(f"{path.name}.1"))
        _append_line(path, line[:max_bytes], max_bytes)


def _read_tail(path: Path) -> list[dict[str, Json]]:
    """Return the newest lines of the file, newest first."""
    try:
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - TAIL_BYTES))
            rows = file.read().splitlines()
    except OSError:
        return []
    found = []
    for row in rows[-MAX_LINES:]:
        try:
            line = json.loads(row)
        except ValueError:
            continue
        if isinstance(line, dict):
            found.append(line)
    return found[::-1]
