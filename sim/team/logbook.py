"""Logbook: a file of lines in JSON, each of which says what a stretch of seeds came to; it is only ever added to.

It is valid after every line, whatever ended the run: half a line at its end (a loss of power) is left out when it is
read, and closed when it is added to.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from middleware.errors import BadSetting


@dataclass(frozen=True)
class Entry:
    """So many seeds from ``first`` on were run: which of them failed, and in how many seconds.

    ``what`` names the workloads where they were not those of the seeds; ``commit`` has a + where the tree was changed.
    """

    date: str
    commit: str
    what: str
    first: int
    count: int
    failures: tuple[int, ...]
    seconds: float

    def line(self) -> str:
        """The entry as a line of the file."""
        return json.dumps(asdict(self))


def entries(text: str, file: str) -> list[Entry]:
    """The entries of a logbook; raises ``BadSetting`` where a line is not one (but for half a line at the end)."""
    found = []
    for number, line in enumerate(text.splitlines(), start=1):
        try:
            found.append(_entry(json.loads(line)))
        except (ValueError, TypeError, KeyError) as error:
            if line and number <= text.count("\n"):
                problem = f"line {number} is no entry of a logbook ({error})"
                raise BadSetting(file, "--log", problem, "name another file, or take the line out") from None
    return found


def missing(seeds: range, logged: Iterable[Entry], what: str) -> list[int]:
    """Those of ``seeds`` that no entry about the same workloads has, whichever commit it was."""
    done = {seed for one in logged if one.what == what for seed in range(one.first, one.first + one.count)}
    return [seed for seed in seeds if seed not in done]


def stretches(seeds: Sequence[int], most: int) -> list[Sequence[int]]:
    """``seeds`` in stretches without gaps, of at most so many."""
    found: list[Sequence[int]] = []
    begin = 0
    for end in range(1, len(seeds) + 1):
        is_last = end == len(seeds) or seeds[end] != seeds[end - 1] + 1 or end - begin == most
        if is_last:
            found.append(seeds[begin:end])
            begin = end
    return found


def append(file: str, entry: Entry) -> None:
    """Add a line to a logbook, and have it on the disk."""
    with open(file, "a+b") as book:
        book.seek(0, os.SEEK_END)
        is_torn = False
        if book.tell():
            book.seek(-1, os.SEEK_END)
            is_torn = book.read(1) != b"\n"
        if is_torn:
            _close_the_line(book)
        book.write(entry.line().encode() + b"\n")
        book.flush()
        os.fsync(book.fileno())


def _close_the_line(book: Any) -> None:
    """Take half a line away."""
    book.seek(0)
    whole = book.read().rfind(b"\n") + 1
    book.truncate(whole)


def _entry(told: dict[str, Any]) -> Entry:
    known = {one.name: told[one.name] for one in fields(Entry)}
    known["failures"] = tuple(map(int, known["failures"]))
    known["first"], known["count"] = int(known["first"]), int(known["count"])
    return Entry(**known)
