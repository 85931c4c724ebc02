"""An operator's order to pause or resume a task, in a separate slot under the task's group key."""

from __future__ import annotations

from dataclasses import dataclass, fields

import msgpack

from middleware.entangled.record import Record
from middleware.entangled.value import check_size, is_number, parse_mapping
from middleware.tasks.task import ORDER

PAUSE, RESUME = "PAUSE", "RESUME"
ORDERS = (PAUSE, RESUME)


@dataclass(frozen=True)
class Order:
    """One order; ``word`` is one of ``ORDERS``, and ``at`` is in Unix seconds on the writer's clock."""

    word: str
    by: str
    at: float

    def pack(self) -> bytes:
        """Return the value of the order's record."""
        return check_size(bytes(msgpack.packb(vars(self))))


def find_newest_order(records: list[Record]) -> Order | None:
    """Return the newest order in the records of a group, or None; every node with these records gets the same order."""
    orders = [order for record in records if (order := _parse_order(record)) is not None]
    return max(orders, key=lambda order: (order.at, order.word, order.by), default=None)


def _parse_order(record: Record) -> Order | None:
    content = parse_mapping(record)
    if record.name != ORDER or content is None:
        return None
    try:
        order = Order(**{f.name: content[f.name] for f in fields(Order) if f.name in content})
    except TypeError:
        return None
    return order if order.word in ORDERS and isinstance(order.by, str) and is_number(order.at) else None
