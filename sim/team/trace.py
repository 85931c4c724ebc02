"""Trace: what happened in a run, one JSON object a line, and never more lines than one can keep."""

from __future__ import annotations

import json
from typing import TextIO

MOST = 200_000
"""Lines; after these only the last one follows, which says how many are not there."""


class Trace:
    """Writes to ``out`` what a team tells (``Team.told``)."""

    def __init__(self, out: TextIO, most: int = MOST) -> None:
        self._out = out
        self._most = most
        self._told = 0

    def begin(self, **facts: object) -> None:
        """Write what run this is."""
        self._write({"trace": 1, **facts})

    def told(self, now: float, event: str, place: int, more: str) -> None:
        """Write one event: the moment in seconds, what happened, at which place, and more about it."""
        self._told += 1
        if self._told > self._most:
            return
        line: dict[str, object] = {"at": round(now, 6), "event": event}
        if place >= 0:
            line["place"] = place
        if more:
            line["more"] = more
        self._write(line)

    def end(self, **facts: object) -> None:
        """Write how it ended, and how many events are not there."""
        self._write({"end": True, "events": self._told, "left_out": max(0, self._told - self._most), **facts})
        self._out.flush()

    def _write(self, line: dict[str, object]) -> None:
        self._out.write(json.dumps(line, separators=(",", ":")) + "\n")
