"""Tests of tasks, reports, results and orders as records, and of the capabilities that a task requires."""

from __future__ import annotations

from dataclasses import replace

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.directory.presence import Capabilities
from middleware.entangled.contact import Contact
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.entangled.record import Record, hash_key
from middleware.tasks.order import PAUSE, RESUME, Order, find_newest_order
from middleware.tasks.task import (
    CANCELLED,
    COMPLETED,
    FAILED,
    MEMBER,
    ORDER,
    RESULT,
    Member,
    Result,
    Task,
    find_outcome,
    find_unmet_requirements,
    group_key,
    parse_member,
    parse_result,
    parse_task,
)

DOG = Identity(b"\1" * 32)
CAT = Identity(b"\2" * 32)
COUNCIL = tuple(Contact(who.public, Address("10.0.0.1", 7000)) for who in (DOG, CAT))
TASK = Task("t1", "search", "Find it", {"camera": {"width": 208}}, {"radius": 0.3}, created=5.0, council=COUNCIL)
UUID = DOG.node_id.hex()
REPORT = Member(UUID, "dog", "WAITING", 1.5, UUID, "abcd", 3, "nearest")
PAUSED = Order(PAUSE, "vaio", 5.0)
DONE = Result(COMPLETED, "dog", 12.5, 3, (("dog", 1.5),))


def record(name: str, value: object, owner: Identity = DOG) -> Record:
    """Return a record with this value; a value that is not bytes is packed."""
    packed = value if isinstance(value, bytes) or value is None else bytes(msgpack.packb(value))
    return Record(hash_key("any"), name, owner.public, 1, "team", 1.0, packed, bytes(64))


def changed(packed: bytes, **changes: object) -> dict[str, object]:
    """Return the content of a packed value with ``changes``."""
    return {**msgpack.unpackb(packed), **changes}


anything = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63)
    | st.floats()
    | st.text(max_size=4)
    | st.binary(max_size=4),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
)
NAMES = sorted({*msgpack.unpackb(TASK.pack()), *msgpack.unpackb(REPORT.pack()), *msgpack.unpackb(DONE.pack())})
DEPTH = b"\x91" * 900


class DecoderTests(SynchronousTestCase):
    def test_there_and_back(self) -> None:
        """Tasks, reports and results survive packing and unpacking."""
        self.assertEqual(parse_task(record("t1", TASK.pack())), TASK)
        self.assertEqual(parse_member(record(MEMBER, REPORT.pack())), REPORT)
        self.assertEqual(parse_result(record(RESULT, DONE.pack())), DONE)
        minded = replace(REPORT, battery=0.5, value=(1.0, -2.5), choice="red", weight=2.0, electorate=5.0)
        self.assertEqual(parse_member(record(MEMBER, minded.pack())), minded)
        bare = replace(REPORT, cost=None)
        self.assertEqual(parse_member(record(MEMBER, bare.pack())), bare)

    def test_in_another_slot(self) -> None:
        """A task, report or result is ignored if it is in a slot whose name belongs to a different record."""
        self.assertIsNone(parse_task(record("t2", TASK.pack())))
        self.assertIsNone(parse_member(record(RESULT, REPORT.pack())))
        self.assertIsNone(parse_result(record(MEMBER, DONE.pack())))

    def test_nobody_reports_for_another(self) -> None:
        """A report that states the id of another node is ignored."""
        self.assertIsNone(parse_member(record(MEMBER, REPORT.pack(), CAT)))

    def test_crafted_tasks(self) -> None:
        """A task with a wrong type, an invalid number or an invalid council member is ignored."""
        bad: dict[str, list[object]] = {
            "task_id": [5, None],
            "kind": [5],
            "title": [b"x"],
            "requirements": [5, {"camera": 5}, {"camera": {"width": [1]}}, {5: {}}, {"camera": {"width": None}}],
            "parameters": [5, {"radius": []}, {"radius": float("nan")}],
            "strategy": [5, None],
            "waiting_period": ["8", -1.0, float("inf"), float("nan"), True],
            "lease_ttl": [0, -1, 61.0, float("nan"), "1"],
            "hysteresis": [-0.1, None],
            "created": [float("inf"), 1e300, "now"],
            "priority": [1.0, 1001, None, "high"],
            "deadline": [-1.0, float("nan"), None],
            "stop_time": [-1.0, "1"],
            "stall_limit": [-1.0, []],
            "value": [-1.0, float("inf")],
            "generation": [-1, 0.5],
            "configuration": [-1, None],
            "group": [5, None],
            "preemptible": [1, None],
            "exclusive": [0, "no"],
            "council": [5, None, [5], [[b"x", "10.0.0.1", 7000]], [COUNCIL[0].pack(), 5], {"a": 1}],
        }
        for name, values in bad.items():
            for value in values:
                self.assertIsNone(parse_task(record("t1", changed(TASK.pack(), **{name: value}))), (name, value))
        for value in (None, b"", b"\xc1", [1], {}, {"task_id": "t1"}, DEPTH):
            self.assertIsNone(parse_task(record("t1", value)), value)

    def test_crafted_reports(self) -> None:
        """A report with a wrong type is ignored; a report with an invalid cost is read without a cost."""
        bad: dict[str, list[object]] = {
            "name": [5],
            "status": [5],
            "assigned": [None],
            "digest": [5],
            "token": [-1, 1.0, 2**60],
            "why": [5],
            "epoch": [-1],
            "serial": [0.5],
            "state": [None],
            "available": [1],
            "load": [-1],
            "age": [-1.0],
            "valid_for": [float("nan")],
            "progress": ["half"],
            "angle": [float("inf")],
            "post": [[1.0]],
            "uuid": [5],
            "battery": [1.5, None, float("nan")],
            "value": [5, "ab", ["a"], [float("inf")], [1e12], [0.0] * 9],
            "choice": [5, "x" * 65, "red\x1b[2J"],
            "weight": [-1.0, 1e12, True],
            "electorate": [float("nan"), "all"],
        }
        for name, values in bad.items():
            for value in values:
                self.assertIsNone(parse_member(record(MEMBER, changed(REPORT.pack(), **{name: value}))), (name, value))
        for cost in ("near", -1.0, float("nan"), float("inf"), True, [1]):
            report = parse_member(record(MEMBER, changed(REPORT.pack(), cost=cost)))
            self.assertEqual(report, replace(REPORT, cost=None), cost)
        for nothing in (None, b"", {}, {"uuid": UUID}, DEPTH):
            self.assertIsNone(parse_member(record(MEMBER, nothing)), nothing)

    def test_report_that_is_stale_when_it_comes(self) -> None:
        """A report that is older than its validity is read without a cost.

        A report without a validity is never too old.
        """
        for age, valid_for, cost in ((2.0, 1.0, None), (1.0, 2.0, 1.5), (9.0, 0.0, 1.5)):
            report = parse_member(record(MEMBER, changed(REPORT.pack(), age=age, valid_for=valid_for)))
            self.assertEqual(report and report.cost, cost, (age, valid_for))

    def test_usual_fields_take_no_room(self) -> None:
        """Default values are omitted from a record, and restored when the record is read."""
        plain = Task("t1", "search", "Find it")
        self.assertEqual(
            sorted(msgpack.unpackb(plain.pack())), ["kind", "parameters", "requirements", "task_id", "title"]
        )
        self.assertEqual(parse_task(record("t1", plain.pack())), plain)
        full = replace(TASK, priority=5, deadline=9.0, preemptible=True, exclusive=False, group="g", configuration=2)
        self.assertEqual(parse_task(record("t1", full.pack())), full)

    def test_crafted_results(self) -> None:
        """A result with a wrong type, number or outcome is ignored."""
        bad: dict[str, list[object]] = {
            "outcome": ["WON", []],
            "by": [5],
            "why": [5],
            "took": ["5", float("nan")],
            "token": [float("inf"), "5", -1],
            "bids": [5, [5], [["a"]], [["a", "b"]], [[5, 1.0]]],
        }
        for name, values in bad.items():
            for value in values:
                self.assertIsNone(parse_result(record(RESULT, changed(DONE.pack(), **{name: value}))), (name, value))
        for value in (None, b"", {}, {"outcome": COMPLETED}, DEPTH):
            self.assertIsNone(parse_result(record(RESULT, value)), value)

    @settings(max_examples=250)
    @given(st.binary(max_size=60) | st.dictionaries(st.sampled_from(NAMES), anything, max_size=4) | anything)
    def test_total(self, value: object) -> None:
        """Any record is decoded as a valid object or as None, without an exception."""
        values = [value]
        if isinstance(value, dict) and all(isinstance(name, str) for name in value):
            values += [changed(one, **value) for one in (TASK.pack(), REPORT.pack(), DONE.pack())]
        for one in values:
            task = parse_task(record("t1", one))
            if task is not None:
                lacking = find_unmet_requirements({"camera": {"width": 1}}, task.requirements)
                self.assertTrue(all(isinstance(line, str) for line in lacking), lacking)
            self.assertIsInstance(parse_member(record(MEMBER, one)), Member | None)
            self.assertIsInstance(find_outcome(TASK, [record(RESULT, one)]), Result | None)


class OutcomeTests(SynchronousTestCase):
    def test_highest_token_holds(self) -> None:
        """Of several results the result with the highest token wins, in any order.

        Without a result the task is open.
        """
        late = Result(FAILED, "cat", 1.0, 7)
        records = [record(RESULT, DONE.pack()), record(RESULT, late.pack(), CAT), record(MEMBER, REPORT.pack())]
        self.assertEqual(find_outcome(TASK, records), late)
        self.assertEqual(find_outcome(TASK, records[::-1]), late)
        self.assertIsNone(find_outcome(TASK, records[2:]))
        self.assertEqual(find_outcome(TASK, [record(RESULT, Result(CANCELLED, "x").pack())]), Result(CANCELLED, "x"))

    def test_groups_are_apart(self) -> None:
        """Two tasks never share a key."""
        self.assertNotEqual(group_key("t1"), group_key("t2"))


class RefusalTests(SynchronousTestCase):
    def test_reasons(self) -> None:
        """A device can perform a task if it has all required capabilities.

        Otherwise the reasons list each missing capability.
        """
        has: Capabilities = {"camera": {"width": 208, "colour": "rgb"}, "legs": {}}
        rows: list[tuple[Capabilities, list[str]]] = [
            ({}, []),
            ({"legs": {}}, []),
            ({"camera": {"width": 208}}, []),
            ({"camera": {"colour": "rgb"}}, []),
            ({"arm": {}}, ["has no arm"]),
            ({"camera": {"width": 640}}, ["camera width is 208, less than 640"]),
            ({"camera": {"height": 1}}, ["camera has no property height"]),
            ({"camera": {"colour": "grey"}}, ["camera colour is rgb, not grey"]),
            ({"camera": {"width": "wide"}}, ["camera width is 208, not wide"]),
            ({"arm": {}, "camera": {"width": 209}}, ["has no arm", "camera width is 208, less than 209"]),
        ]
        for requirements, reasons in rows:
            self.assertEqual(find_unmet_requirements(has, requirements), reasons)

    def test_a_number_that_is_none_is_not_enough(self) -> None:
        """A capability with the value NaN meets no requirement."""
        self.assertEqual(len(find_unmet_requirements({"camera": {"width": float("nan")}}, {"camera": {"width": 1}})), 1)


class OrderTests(SynchronousTestCase):
    def test_newest_holds(self) -> None:
        """Of several orders the newest order wins, whatever the order of the records.

        Ties are broken deterministically.
        """
        resumed = replace(PAUSED, word=RESUME, at=6.0)
        records = [record(ORDER, PAUSED.pack()), record(ORDER, resumed.pack())]
        self.assertEqual(find_newest_order(records), resumed)
        self.assertEqual(find_newest_order(records[::-1]), resumed)
        tie = [record(ORDER, PAUSED.pack()), record(ORDER, replace(PAUSED, word=RESUME).pack())]
        self.assertEqual(find_newest_order(tie), find_newest_order(tie[::-1]))

    def test_nothing(self) -> None:
        """Without a valid order the task continues."""
        lawful = msgpack.unpackb(PAUSED.pack())
        crafted = [{}, {**lawful, "word": "FLY"}, {**lawful, "by": 5}, {**lawful, "at": float("nan")}, [1], b"\xc1"]
        for value in crafted:
            self.assertIsNone(find_newest_order([record(ORDER, value)]), value)
        self.assertIsNone(find_newest_order([record(MEMBER, PAUSED.pack())]))
        self.assertIsNone(find_newest_order([]))
