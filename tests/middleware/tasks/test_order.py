"""Tests of ``middleware.tasks.order``: what an operator wants of a task that is under way."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import msgpack
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.record import Record, hashed_key
from middleware.tasks.order import PAUSE, RESUME, Order, order_of
from middleware.tasks.task import MEMBER, ORDER

PAUSED = Order(PAUSE, "vaio", 5.0)


def record(value: Any, name: str = ORDER) -> Record:
    """A record with this value."""
    packed = value if isinstance(value, bytes) else bytes(msgpack.packb(value))
    return Record(hashed_key("any"), name, bytes(32), 1, "team", 1.0, packed, bytes(64))


class OrderTests(SynchronousTestCase):
    def test_newest_holds(self) -> None:
        """Of several orders the newest holds, in any order of the records; equal moments are decided, too."""
        resumed = replace(PAUSED, word=RESUME, at=6.0)
        records = [record(PAUSED.packed()), record(resumed.packed())]
        self.assertEqual(order_of(records), resumed)
        self.assertEqual(order_of(records[::-1]), resumed)
        tie = [record(PAUSED.packed()), record(replace(PAUSED, word=RESUME).packed())]
        self.assertEqual(order_of(tie), order_of(tie[::-1]))

    def test_nothing(self) -> None:
        """Without an order, or with what is none, the task goes its way."""
        lawful = msgpack.unpackb(PAUSED.packed())
        crafted = [{}, {**lawful, "word": "FLY"}, {**lawful, "by": 5}, {**lawful, "at": float("nan")}, [1], b"\xc1"]
        for value in crafted:
            self.assertIsNone(order_of([record(value)]), value)
        self.assertIsNone(order_of([record(PAUSED.packed(), MEMBER)]))
        self.assertIsNone(order_of([]))
