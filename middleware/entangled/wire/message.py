"""Encode and decode the content of encrypted datagrams: msgpack messages, fragments, and receipts for fragments.

``decode``, ``parse_fragment`` and ``parse_receipt`` accept any bytes: they return a value or raise ``Malformed``.
Absolute times are never transmitted.  A fragment (PART) and a receipt each fill one datagram::

    PART     0x01  flags 1  id 8  total bytes 4  number 2  the bytes of this fragment
    RECEIPT  0x02  flags 1  id 8  next 2  room 2  cause 2  bitmap

All fragments except the last have ``FRAGMENT_BYTES`` bytes, so the number of a fragment determines its offset, and
fragments never overlap.  ``next`` is the first missing fragment, bit n of the bitmap (least significant first) is set
if fragment ``next + 1 + n`` has arrived, and ``room`` is the number of fragments, starting with ``next``, that the
receiver accepts.  ``cause`` is the fragment that triggered the receipt.  Only the round trip of this fragment is
measured, because earlier receipts for other fragments may have been lost.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, NoReturn

import msgpack

from middleware.entangled.errors import Malformed
from middleware.entangled.network.network import MAX_DATAGRAM_BYTES
from middleware.entangled.wire.session import MAX_PLAIN_BYTES

# A record of 1 MiB, with space for its other fields and for the fields of the request that contains it.
MAX_MESSAGE_BYTES = 2**20 + 4096
MAX_METHOD = 64
MAX_CODE = 64
MAX_TEXT = 300
MAX_DEPTH = 16
# A byte on the wire can become a list of 56 bytes in memory, so the number of items in large messages is limited too.
MAX_ITEMS = 2**17
NO_LIMIT_MS = 2**32 - 1
REFUSED, UNKNOWN_METHOD, BAD_ARGUMENTS = "refused", "unknown-method", "bad-arguments"
INTERNAL, CANCELLED, GONE, BUSY = "internal", "cancelled", "gone", "busy"
_REQUEST, _ANSWER, _FAILURE, _NOTIFICATION, _CANCEL = range(5)
_UINT32 = b"\xce"

PART, RECEIPT = 0x01, 0x02
REFUSAL = 0x04
"""The kind of a message that notifies the peer of its rejection; the refusal code follows."""
IS_ANSWER = 0x01  # flag of PART and RECEIPT: the message is the answer to the request with this id
WANTS_RECEIPT = 0x02  # flag of PART: the sender wants a receipt now
DONE = 0x02  # flag of RECEIPT: stop sending; all fragments have arrived, or the message is no longer needed
_FRAGMENT_HEADER_BYTES = 16
_RECEIPT_HEADER_BYTES = 16
FRAGMENT_BYTES = MAX_PLAIN_BYTES - _FRAGMENT_HEADER_BYTES
MAX_FRAGMENTS = -(-MAX_MESSAGE_BYTES // FRAGMENT_BYTES)
MAX_BITMAP_BYTES = -(-MAX_FRAGMENTS // 8)


@dataclass(frozen=True, slots=True)
class Request:
    """Calls ``method``; the requester's ``id`` (64 bits) distinguishes a repeated request from a new one.

    The requester no longer waits for answers to its requests to this peer that have an id below ``id - behind``.
    ``left_ms`` is the time that the requester will still wait, in milliseconds.
    """

    id: int
    method: str
    arguments: tuple[object, ...]
    left_ms: int = NO_LIMIT_MS
    behind: int = 0


@dataclass(frozen=True, slots=True)
class Answer:
    """The result of a method."""

    id: int
    value: object


@dataclass(frozen=True, slots=True)
class Failure:
    """The error of a request; ``code`` is its kind, ``text`` describes it."""

    id: int
    code: str
    text: str


@dataclass(frozen=True, slots=True)
class Notification:
    """A notification: calls ``method`` without an answer."""

    method: str
    arguments: tuple[object, ...]


@dataclass(frozen=True, slots=True)
class Cancel:
    """Notifies the responder that the answer to the request ``id`` is no longer needed."""

    id: int


Message = Request | Answer | Failure | Notification | Cancel


def encode(message: Message) -> bytes:
    """Encode ``message``; raise ``TypeError``, ``ValueError`` or ``OverflowError`` if it cannot be packed."""
    match message:
        case Request(id=number, method=method, arguments=arguments, left_ms=left_ms, behind=behind):
            # The remaining time is last and always has four bytes, so that ``set_remaining_time`` can replace it.
            head = bytes(msgpack.packb([_REQUEST, number, behind, method, arguments]))
            return b"\x96" + head[1:] + _UINT32 + left_ms.to_bytes(4, "big")
        case Answer(id=number, value=value):
            fields = [_ANSWER, number, value]
        case Failure(id=number, code=code, text=text):
            fields = [_FAILURE, number, code, text[:MAX_TEXT].encode(errors="replace").decode()]
        case Notification(method=method, arguments=arguments):
            fields = [_NOTIFICATION, method, arguments]
        case Cancel(id=number):
            fields = [_CANCEL, number]
    return bytes(msgpack.packb(fields))


def set_remaining_time(request: bytes, seconds: float) -> bytes:
    """Return a copy of an encoded request with the remaining time replaced by ``seconds``."""
    left_ms = min(NO_LIMIT_MS, max(0, round(seconds * 1000)))
    return request[:-4] + left_ms.to_bytes(4, "big")


def decode(data: bytes) -> Message:
    """Decode a message; for any invalid bytes raise ``Malformed``."""
    is_large = len(data) > MAX_DATAGRAM_BYTES
    longest = MAX_MESSAGE_BYTES if is_large else MAX_DATAGRAM_BYTES
    budget = _ItemLimit() if is_large else None
    try:
        fields = msgpack.unpackb(
            data,
            strict_map_key=True,
            ext_hook=_reject_extension,
            list_hook=budget and budget.count,
            object_hook=budget and budget.count,
            max_str_len=longest,
            max_bin_len=longest,
            max_array_len=min(longest, MAX_ITEMS),
            max_map_len=min(longest, MAX_ITEMS),
            max_ext_len=0,
        )
    except Exception as error:  # untrusted input: msgpack raises more types than it documents
        raise Malformed(f"the message is not valid msgpack: {type(error).__name__}") from None
    if type(fields) is not list or not fields or type(fields[0]) is not int:  # True and 1.0 also equal 1
        raise Malformed("the message is not a list that starts with the number of a kind")
    kind, size = fields[0], len(fields)
    if kind == _REQUEST and size == 6:
        _, id_, behind, method, arguments, left = fields
        is_numbered = _is_id(id_) and _is_id(behind) and behind <= id_
        is_timed = type(left) is int and 0 <= left <= NO_LIMIT_MS
        if is_numbered and is_timed and _is_method(method) and type(arguments) is list and _is_plain_data(arguments):
            return Request(id_, method, tuple(arguments), left, behind)
    elif kind == _ANSWER and size == 3:
        _, id_, value = fields
        if _is_id(id_) and _is_plain_data(value):
            return Answer(id_, value)
    elif kind == _FAILURE and size == 4:
        _, id_, code, text = fields
        if _is_id(id_) and is_code(code) and type(text) is str and len(text) <= MAX_TEXT:
            return Failure(id_, code, text)
    elif kind == _NOTIFICATION and size == 3:
        _, method, arguments = fields
        if _is_method(method) and type(arguments) is list and _is_plain_data(arguments):
            return Notification(method, tuple(arguments))
    elif kind == _CANCEL and size == 2 and _is_id(fields[1]):
        return Cancel(fields[1])
    raise Malformed("the fields of the message do not match any kind of message")


def is_code(value: object) -> bool:
    """Return whether ``value`` is a well-formed error code."""
    return isinstance(value, str) and 0 < len(value) <= MAX_CODE and value.isascii() and value.isprintable()


class _ItemLimit:
    """Counts the items of the lists and maps of one message while they are decoded."""

    def __init__(self) -> None:
        self._left = MAX_ITEMS

    def count(self, items: object) -> object:
        assert isinstance(items, list | dict)
        self._left -= 1 + len(items)
        if self._left < 0:
            raise Malformed(f"the message has more than {MAX_ITEMS} items")
        return items


def _reject_extension(code: int, data: bytes) -> NoReturn:
    raise Malformed("the message contains a msgpack extension type, which the protocol does not use")


def _is_id(value: object) -> bool:
    return type(value) is int and 0 <= value < 2**64


def _is_method(value: object) -> bool:
    return type(value) is str and 0 < len(value) <= MAX_METHOD


def _is_plain_data(value: object) -> bool:
    """Return whether nothing is nested deeper than ``MAX_DEPTH``, and all types are part of the protocol."""
    # The unpacker creates exactly these types and no subclasses.
    level: list[object] = [value]
    for _ in range(MAX_DEPTH):
        below: list[object] = []
        for item in level:
            kind = type(item)
            if kind is list:
                below += item  # type: ignore[arg-type]
            elif kind is dict:
                below += item.values()  # type: ignore[attr-defined]
            elif kind is msgpack.Timestamp:
                return False
        if not below:
            return True
        level = below
    return False


class MessageKey(NamedTuple):
    """Identifies a fragmented message of a peer: the request ``id``, or the answer to it."""

    is_answer: bool
    id: int


class Fragment(NamedTuple):
    """The content of a PART."""

    key: MessageKey
    wants_receipt: bool
    total: int
    number: int
    data: bytes


class Receipt(NamedTuple):
    """The content of a RECEIPT; bit n of ``here`` is set if the receiver has fragment n."""

    key: MessageKey
    is_done: bool
    next: int
    room: int
    cause: int
    received: int


def count_fragments(total: int) -> int:
    """Return the number of fragments of a message of ``total`` bytes."""
    return -(-total // FRAGMENT_BYTES)


def parse_fragment(plain: bytes) -> Fragment:
    """Decode a PART; raise ``Malformed``."""
    flags, total = plain[1] if len(plain) > _FRAGMENT_HEADER_BYTES else 0xFF, int.from_bytes(plain[10:14], "little")
    number, data = int.from_bytes(plain[14:16], "little"), plain[_FRAGMENT_HEADER_BYTES:]
    if flags & ~(IS_ANSWER | WANTS_RECEIPT) or not 0 < total <= MAX_MESSAGE_BYTES or number >= count_fragments(total):
        raise Malformed("the fragment has unknown flags, or an invalid size or number")
    if len(data) != min(FRAGMENT_BYTES, total - number * FRAGMENT_BYTES):
        raise Malformed("the length of the fragment is wrong for its number")
    return Fragment(_parse_key(plain), bool(flags & WANTS_RECEIPT), total, number, data)


def parse_receipt(plain: bytes) -> Receipt:
    """Decode a RECEIPT; raise ``Malformed``."""
    if not _RECEIPT_HEADER_BYTES <= len(plain) <= _RECEIPT_HEADER_BYTES + MAX_BITMAP_BYTES or plain[1] & ~(
        IS_ANSWER | DONE
    ):
        raise Malformed("the receipt has the wrong length or unknown flags")
    first = int.from_bytes(plain[10:12], "little")
    room, cause = int.from_bytes(plain[12:14], "little"), int.from_bytes(plain[14:16], "little")
    received = int.from_bytes(plain[_RECEIPT_HEADER_BYTES:], "little") << (first + 1) | (1 << first) - 1
    return Receipt(_parse_key(plain), bool(plain[1] & DONE), first, room, cause, received)


def pack_receipt(key: MessageKey, is_done: bool, room: int, cause: int, received: int) -> bytes:
    """Return the RECEIPT for a message.

    Bit n of ``received`` is set if fragment n has arrived; ``cause`` is the latest fragment.
    """
    first = ((received + 1) & ~received).bit_length() - 1  # the lowest bit that is not set
    bitmap = received >> (first + 1)
    head = bytes([RECEIPT, key.is_answer * IS_ANSWER | is_done * DONE]) + key.id.to_bytes(8, "little")
    head += first.to_bytes(2, "little") + room.to_bytes(2, "little") + cause.to_bytes(2, "little")
    return head + bitmap.to_bytes(-(-bitmap.bit_length() // 8), "little")


def _parse_key(plain: bytes) -> MessageKey:
    return MessageKey(bool(plain[1] & IS_ANSWER), int.from_bytes(plain[2:10], "little"))
