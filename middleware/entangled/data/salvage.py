"""Salvage: what is done with a store's file that has rotted.

It is set aside by name and never removed, and the notes in it that are still whole are brought over: with them the node
keeps its identity.
"""

from __future__ import annotations

import os
import sqlite3
from contextlib import closing
from urllib.parse import quote

from middleware.entangled.data.schema import APPLICATION_ID, MARK, RECORDS, RECORDS_1, notes_in, open_rows

PARTS = ("", "-wal", "-shm")
TRACES = (RECORDS.encode(), RECORDS_1.encode(), MARK)
CHUNK = 2**20


def is_ours(path: str) -> bool:
    """Whether a file that SQLite cannot read was a store: by its header, by what else of us is in it, or all zeros."""
    return _has_our_header(path) or _is_blank(path) or any(_has_trace(path + part) for part in PARTS[:2])


def set_aside(path: str) -> str:
    """Rename the file ``path`` with its log to the first free name, ``PATH.rotten-1`` and so on; returns that."""
    number = 1
    while os.path.lexists(f"{path}.rotten-{number}"):
        number += 1
    aside = f"{path}.rotten-{number}"
    for part in PARTS:
        if os.path.lexists(path + part):
            os.rename(path + part, aside + part)
    return aside


def saved_notes(path: str) -> dict[str, bytes]:
    """The notes of the rotten file ``path`` that are whole by their checksum; none where it cannot be read."""
    try:
        with closing(sqlite3.connect(f"file:{quote(path)}?mode=ro", uri=True, timeout=1.0)) as connection:
            open_rows(connection)
            return notes_in(connection)[0]
    except sqlite3.Error:
        return {}


def _has_our_header(path: str) -> bool:
    with open(path, "rb") as file:
        return file.read(72)[68:] == APPLICATION_ID.to_bytes(4, "big")


def _is_blank(path: str) -> bool:
    """Whether there is nothing but zeros in the file, as a card leaves it that lost its pages."""
    with open(path, "rb") as file:
        return not any(chunk.strip(b"\0") for chunk in iter(lambda: file.read(CHUNK), b""))


def _has_trace(path: str) -> bool:
    overlap = max(map(len, TRACES))
    end = b""
    try:
        with open(path, "rb") as file:
            for chunk in iter(lambda: file.read(CHUNK), b""):
                window = end + chunk
                if any(trace in window for trace in TRACES):
                    return True
                end = window[-overlap:]
    except FileNotFoundError:
        pass
    return False
