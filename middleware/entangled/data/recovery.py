"""Recovery from a corrupt store file.

The corrupt file is renamed and never removed.  Its notes with a valid checksum are copied to the new store; one of the
notes is the node's identity.
"""

from __future__ import annotations

import os
import sqlite3
from contextlib import closing
from urllib.parse import quote

from middleware.entangled.data.schema import (
    APPLICATION_ID,
    CREATE_RECORDS,
    CREATE_RECORDS_1,
    FILE_MARK,
    read_notes,
    use_bytes,
)

FILE_SUFFIXES = ("", "-wal", "-shm")
TRACES = (CREATE_RECORDS.encode(), CREATE_RECORDS_1.encode(), FILE_MARK)
CHUNK_BYTES = 2**20


def is_store(path: str) -> bool:
    """Return whether an unreadable file was a store: by its header, by its tables, or because all bytes are zero."""
    return _has_store_header(path) or _is_blank(path) or any(_has_trace(path + suffix) for suffix in FILE_SUFFIXES[:2])


def set_aside(path: str) -> str:
    """Rename the file and its write-ahead log to the first free name ``PATH.rotten-1`` and so on; return the name."""
    number = 1
    while os.path.lexists(f"{path}.rotten-{number}"):
        number += 1
    aside = f"{path}.rotten-{number}"
    for suffix in FILE_SUFFIXES:
        if os.path.lexists(path + suffix):
            os.rename(path + suffix, aside + suffix)
    return aside


def read_saved_notes(path: str) -> dict[str, bytes]:
    """Return the notes with a valid checksum in a corrupt file; empty if SQLite cannot read it."""
    try:
        with closing(sqlite3.connect(f"file:{quote(path)}?mode=ro", uri=True, timeout=1.0)) as connection:
            use_bytes(connection)
            return read_notes(connection)[0]
    except sqlite3.Error:
        return {}


def _has_store_header(path: str) -> bool:
    with open(path, "rb") as file:
        return file.read(72)[68:] == APPLICATION_ID.to_bytes(4, "big")


def _is_blank(path: str) -> bool:
    """Return whether all bytes are zero, as on an SD card that lost power before it wrote the pages."""
    with open(path, "rb") as file:
        return not any(chunk.strip(b"\0") for chunk in iter(lambda: file.read(CHUNK_BYTES), b""))


def _has_trace(path: str) -> bool:
    overlap = max(map(len, TRACES))
    end = b""
    try:
        with open(path, "rb") as file:
            for chunk in iter(lambda: file.read(CHUNK_BYTES), b""):
                window = end + chunk
                if any(trace in window for trace in TRACES):
                    return True
                end = window[-overlap:]
    except FileNotFoundError:
        pass
    return False
