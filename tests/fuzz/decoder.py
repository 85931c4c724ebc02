"""Fuzz every decoder of the wire protocol: each returns a valid object or raises ``Malformed``.

A decoded object is encoded and decoded again, and the result must equal the first object.
"""

from __future__ import annotations

import contextlib

import msgpack

from middleware.entangled import contact
from middleware.entangled.errors import Malformed
from middleware.entangled.record import parse_record
from middleware.entangled.wire.message import decode, encode, pack_receipt, parse_fragment, parse_receipt
from tests.fuzz.ground import Violation
from tests.fuzz.runner import main


def check(data: bytes) -> None:
    """Decode one input with every decoder; raises ``Violation`` if a decoder breaks a rule."""
    with contextlib.suppress(Malformed):
        message = decode(data)
        again = encode(message)
        if encode(decode(again)) != again:
            raise Violation("a message that is another one when it is packed and read again")
    with contextlib.suppress(Malformed):
        parse_fragment(data)
    with contextlib.suppress(Malformed):
        receipt = parse_receipt(data)
        packed = pack_receipt(receipt.key, receipt.is_done, receipt.room, receipt.cause, receipt.received)
        if parse_receipt(packed) != receipt._replace(next=parse_receipt(packed).next):
            raise Violation("a receipt that is another one when it is packed and read again")
    with contextlib.suppress(Exception):  # this kind is excluded, because the decoders below read all of its fields
        fields = msgpack.unpackb(data, strict_map_key=False)
        _records(fields)


def _records(fields: object) -> None:
    record, known = parse_record(fields), contact.parse_contact(fields)
    if record is not None and parse_record(record.pack()) != record:
        raise Violation("a record that is another one when it is packed and read again")
    if known is not None and contact.parse_contact(known.pack()) != known:
        raise Violation("a contact that is another one when it is packed and read again")


if __name__ == "__main__":
    main("decoder", check)
