"""Tables of the SQLite file, checksums of rows, and migration from older schemas.

Each row contains a CRC-32 of its fields, because SQLite's structural checks do not detect bit errors of flash memory
inside values.
"""

from __future__ import annotations

import sqlite3
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import msgpack

from middleware.entangled.errors import BadStore
from middleware.entangled.record import Record, parse_record

APPLICATION_ID = 0x53574E31
"""The application id in the header of the file, which identifies it as a store ("SWN1")."""
SCHEMA_VERSION = 2
FILE_MARK = bytes.fromhex("a9531c4e5fd0428fb1e7706d2c8834f6")
"""The value of a note by which a store file with a damaged header is identified."""
CREATE_RECORDS_1 = (
    "CREATE TABLE records(key BLOB, owner BLOB, name TEXT, sequence INTEGER, lifetime TEXT, ttl REAL, value BLOB,"
    " signature BLOB, PRIMARY KEY(key, owner, name)) WITHOUT ROWID"
)
"""The table of schema 1, which is slow with large values, because they are stored in the tree that SQLite searches."""
CREATE_RECORDS = (
    "CREATE TABLE records(id INTEGER PRIMARY KEY, key BLOB, owner BLOB, name TEXT, sequence INTEGER, lifetime TEXT,"
    " ttl REAL, signature BLOB, crc INTEGER, value BLOB, UNIQUE(key, owner, name))"
)
CREATE_NOTES = "CREATE TABLE notes(name TEXT PRIMARY KEY, value BLOB, crc INTEGER)"
CREATE_ROTTEN = (
    "CREATE TABLE rotten(id INTEGER PRIMARY KEY, key BLOB, owner BLOB, name TEXT, sequence INTEGER, lifetime TEXT,"
    " ttl REAL, signature BLOB, crc INTEGER, value BLOB)"
)
MAX_CORRUPT_ROWS = 16
"""The maximum number of corrupt rows that are kept for diagnosis; it limits their space on the SD card."""

FIELDS = "key, owner, name, sequence, lifetime, ttl, signature, crc, value"
SELECT_RECORDS = f"SELECT {FIELDS} FROM records"
PUT_RECORD = (
    f"INSERT INTO records({FIELDS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT(key, owner, name) DO UPDATE SET"
    " sequence = excluded.sequence, lifetime = excluded.lifetime, ttl = excluded.ttl, signature = excluded.signature,"
    " crc = excluded.crc, value = excluded.value"
)
DELETE_RECORD = "DELETE FROM records WHERE key = ? AND owner = ? AND name = ?"
PUT_NOTE = "REPLACE INTO notes VALUES (?, ?, ?)"

Statement = tuple[str, Sequence[Any]]


class CorruptStore(Exception):
    """The file is a damaged store; ``str()`` describes the damage."""


@dataclass
class Contents:
    """The contents of a file; ``repairs`` are SQL statements that set aside corrupt rows and remove leased records."""

    records: list[Record] = field(default_factory=list)
    notes: dict[str, bytes] = field(default_factory=dict)
    corrupt_rows: int = 0
    repairs: list[Statement] = field(default_factory=list)


def make_row(record: Record) -> tuple[object, ...]:
    """Return the row of ``record`` in the order of ``FIELDS``."""
    crc = _crc(record.pack())
    return *record.slot, record.sequence, record.lifetime, record.ttl, record.signature, crc, record.value


def parse_row(row: Sequence[Any]) -> Record | None:
    """Return the record in a row of ``FIELDS`` whose strings are bytes; None if the row is corrupt."""
    record = _parse_unchecked(row)
    return record if record is not None and _crc(record.pack()) == row[7] else None


def make_note_row(name: str, value: bytes) -> tuple[str, bytes, int]:
    """Return a row of ``notes``."""
    return name, value, _crc([name, value])


def use_bytes(connection: sqlite3.Connection) -> None:
    """Make ``connection`` return strings as bytes, because a corrupt string may not be UTF-8."""
    connection.text_factory = bytes


def check_version(path: str, connection: sqlite3.Connection) -> int:
    """Return the schema version of the file, 0 if it is empty.

    Raises ``BadStore`` if the file is not a store or has a newer schema, ``CorruptStore`` if it is a damaged store.
    """
    (application,) = connection.execute("PRAGMA application_id").fetchone()
    (version,) = connection.execute("PRAGMA user_version").fetchone()
    tables = [_decode_text(sql) for (sql,) in connection.execute("SELECT sql FROM sqlite_schema WHERE type = 'table'")]
    if application != APPLICATION_ID:
        if CREATE_RECORDS in tables or CREATE_RECORDS_1 in tables:
            raise CorruptStore("the header has a different application id")
        if application or version or tables:
            raise BadStore(f"store {path}: belongs to another program; choose a different file")
        return 0
    if version > SCHEMA_VERSION:
        raise BadStore(f"store {path}: has the newer schema {version}; update this program, or choose a different file")
    if (CREATE_RECORDS if version == SCHEMA_VERSION else CREATE_RECORDS_1) not in tables:
        raise CorruptStore(f"the tables of schema {version} are missing")
    (result,) = connection.execute("PRAGMA integrity_check(1)").fetchone()
    if _decode_text(result) != "ok":
        raise CorruptStore(str(_decode_text(result)))
    return int(version)


def create_tables(connection: sqlite3.Connection, version: int) -> None:
    """Create or migrate the tables from ``version`` (0: empty) to ``SCHEMA_VERSION`` in one transaction."""
    if version == SCHEMA_VERSION:
        return
    connection.execute("BEGIN IMMEDIATE")
    try:
        if version == 1:
            connection.execute("ALTER TABLE records RENAME TO old_records")
            connection.execute("ALTER TABLE notes RENAME TO old_notes")
        for statement in (CREATE_RECORDS, CREATE_NOTES, CREATE_ROTTEN):
            connection.execute(statement)
        if version == 1:
            _migrate_from_1(connection)
        connection.execute(PUT_NOTE, make_note_row("mark", FILE_MARK))
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
        connection.execute("COMMIT")
    except BaseException:
        connection.rollback()
        raise


def read_contents(connection: sqlite3.Connection) -> Contents:
    """Read the whole file, records in order of insertion."""
    found = Contents()
    # Many rows have the same owner or key; such rows share one bytes object to save memory.
    known: dict[bytes, bytes] = {}
    for row_id, key, owner, *rest in connection.execute(f"SELECT id, {FIELDS} FROM records ORDER BY id"):
        record = parse_row([known.setdefault(key, key), known.setdefault(owner, owner), *rest])
        if record is None:
            found.corrupt_rows += 1
            found.repairs += _set_aside(row_id)
        elif record.lifetime == "team":
            found.records.append(record)
    # Leases end with the process that received their renewals.
    found.repairs.append(("DELETE FROM records WHERE lifetime = 'leased'", ()))
    found.notes, bad = read_notes(connection)
    found.corrupt_rows += bad
    return found


def read_notes(connection: sqlite3.Connection) -> tuple[dict[str, bytes], int]:
    """Return the notes with a valid checksum, and the number of corrupt ones."""
    notes: dict[str, bytes] = {}
    corrupt_rows = 0
    for raw, value, crc in connection.execute("SELECT name, value, crc FROM notes ORDER BY name"):
        name = _decode_text(raw)
        if isinstance(name, str) and isinstance(value, bytes) and _crc([name, value]) == crc:
            notes[name] = value
        else:
            corrupt_rows += 1
    return notes, corrupt_rows


def _migrate_from_1(connection: sqlite3.Connection) -> None:
    """Copy the rows of schema 1 and compute their checksums."""
    fields = "key, owner, name, sequence, lifetime, ttl, signature, NULL, value"
    for row in connection.execute(f"SELECT {fields} FROM old_records ORDER BY key, owner, name"):
        record = _parse_unchecked(row)
        if record is None:
            connection.execute(f"INSERT INTO rotten({FIELDS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", row)
        else:
            connection.execute(PUT_RECORD, make_row(record))
    notes = connection.execute("SELECT name, value FROM old_notes").fetchall()
    connection.executemany(PUT_NOTE, [make_note_row(name.decode(), value) for name, value in notes])
    connection.execute("DROP TABLE old_records")
    connection.execute("DROP TABLE old_notes")


def _parse_unchecked(row: Sequence[Any]) -> Record | None:
    key, owner, name, sequence, lifetime, ttl, signature, _, value = row
    return parse_record([key, _decode_text(name), owner, sequence, _decode_text(lifetime), ttl, value, signature])


def _set_aside(row_id: int) -> list[Statement]:
    return [
        (f"INSERT INTO rotten({FIELDS}) SELECT {FIELDS} FROM records WHERE id = ?", (row_id,)),
        ("DELETE FROM records WHERE id = ?", (row_id,)),
        ("DELETE FROM rotten WHERE id <= (SELECT max(id) FROM rotten) - ?", (MAX_CORRUPT_ROWS,)),
    ]


def _decode_text(raw: object) -> object:
    if not isinstance(raw, bytes):
        return raw
    try:
        return raw.decode()
    except UnicodeDecodeError:
        return None


def _crc(fields: list[object]) -> int:
    return zlib.crc32(msgpack.packb(fields))
