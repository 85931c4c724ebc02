"""Fuzz every decoder of the wire protocol: each returns a valid object or raises ``Malformed``.

A decoded object is encoded and decoded again, and must be the same.
"""

from __future__ import annotations

import contextlib

import msgpack

from middleware.entangled import contact
from middleware.entangled.errors import Malformed
from middleware.entangled.record import unpacked
from middleware.entangled.wire.message import decoded, encoded, packed_receipt, part_of, receipt_of
from tests.fuzz.ground import Violation
from tests.fuzz.runner import main


def check(data: bytes) -> None:
    """Decode one input with every decoder; raises ``Violation``."""
    with contextlib.suppress(Malformed):
        message = decoded(data)
        again = encoded(message)
        if encoded(decoded(again)) != again:
            raise Violation("a message that is another one when it is packed and read again")
    with contextlib.suppress(Malformed):
        part_of(data)
    with contextlib.suppress(Malformed):
        receipt = receipt_of(data)
        packed = packed_receipt(receipt.key, receipt.is_done, receipt.room, receipt.cause, receipt.here)
        if receipt_of(packed) != receipt._replace(next=receipt_of(packed).next):
            raise Violation("a receipt that is another one when it is packed and read again")
    with contextlib.suppress(Exception):  # not tested here: it only provides fields for the decoders below
        fields = msgpack.unpackb(data, strict_map_key=False)
        _records(fields)


def _records(fields: object) -> None:
    record, known = unpacked(fields), contact.unpacked(fields)
    if record is not None and unpacked(record.packed()) != record:
        raise Violation("a record that is another one when it is packed and read again")
    if known is not None and contact.unpacked(known.packed()) != known:
        raise Violation("a contact that is another one when it is packed and read again")


if __name__ == "__main__":
    main("decoder", check)
