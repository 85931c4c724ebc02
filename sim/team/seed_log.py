"""Write and read a seed log: a file with one line of JSON for each range of seeds, to which lines are only appended.

The file is valid however the last run ended: an incomplete last line (after a loss of power) is skipped when reading,
and removed when appending.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from middleware.errors import BadSetting


@dataclass(frozen=True)
class SeedRun:
    """The result of running ``count`` seeds from ``first`` on: the failed seeds, and the duration in seconds.

    ``what`` lists the workloads if they were not selected by the seeds; ``commit`` ends with + if the source tree had
    uncommitted changes.
    """

    date: str
    commit: str
    what: str
    first: int
    count: int
    failures: tuple[int, ...]
    seconds: float

    def to_json(self) -> str:
        """Return the entry as a line of the file."""
        return json.dumps(asdict(self))


def parse_entries(text: str, file: str) -> list[SeedRun]:
    """Parse a seed log; raises ``BadSetting`` for an invalid line (except an incomplete last one)."""
    found = []
    for number, line in enumerate(text.splitlines(), start=1):
        try:
            found.append(_parse_entry(json.loads(line)))
        except (ValueError, TypeError, KeyError) as error:
            if line and number <= text.count("\n"):
                problem = f"line {number} is not a seed log entry ({error})"
                raise BadSetting(file, "--log", problem, "choose another file, or remove the line") from None
    return found


def find_missing(seeds: range, logged: Iterable[SeedRun], what: str) -> list[int]:
    """Return the ``seeds`` that are in no entry with the same workloads, for any commit."""
    done = {seed for one in logged if one.what == what for seed in range(one.first, one.first + one.count)}
    return [seed for seed in seeds if seed not in done]


def split_ranges(seeds: Sequence[int], most: int) -> list[Sequence[int]]:
    """Split ``seeds`` into ranges without gaps, of at most ``most`` seeds each."""
    found: list[Sequence[int]] = []
    begin = 0
    for end in range(1, len(seeds) + 1):
        is_last = end == len(seeds) or seeds[end] != seeds[end - 1] + 1 or end - begin == most
        if is_last:
            found.append(seeds[begin:end])
            begin = end
    return found


def append_entry(file: str, entry: SeedRun) -> None:
    """Append a line to a seed log and flush it to disk."""
    with open(file, "a+b") as book:
        book.seek(0, os.SEEK_END)
        is_torn = False
        if book.tell():
            book.seek(-1, os.SEEK_END)
            is_torn = book.read(1) != b"\n"
        if is_torn:
            _remove_incomplete_line(book)
        book.write(entry.to_json().encode() + b"\n")
        book.flush()
        os.fsync(book.fileno())


def _remove_incomplete_line(book: Any) -> None:
    """Remove an incomplete last line."""
    book.seek(0)
    whole = book.read().rfind(b"\n") + 1
    book.truncate(whole)


def _parse_entry(content: dict[str, Any]) -> SeedRun:
    known = {one.name: content[one.name] for one in fields(SeedRun)}
    known["failures"] = tuple(map(int, known["failures"]))
    known["first"], known["count"] = int(known["first"]), int(known["count"])
    return SeedRun(**known)
