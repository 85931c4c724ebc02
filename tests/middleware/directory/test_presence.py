"""Tests of device records and of the presence that a node announces."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgpack
from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from middleware.directory.presence import (
    DEVICES,
    IDLE,
    MAX_MESSAGES,
    SEARCHING,
    Device,
    Presence,
    parse_device,
    parse_devices,
)
from middleware.entangled.identity import Identity
from middleware.entangled.record import Record
from middleware.entangled.value import MAX_VALUE_BYTES

DOG = Identity(b"\1" * 32)
CAT = Identity(b"\2" * 32)
DEVICE = Device(
    DOG.node_id.hex(),
    "dog",
    "aibo",
    "yellow stripe",
    {"camera": {"width": 208, "colour": "yes"}},
    "10.0.0.1:7000",
    ("edge", "web"),
    3,
    12.5,
    "t1",
    SEARCHING,
    ((1.0, "hello"),),
    {"contacts": 3},
)


def record(value: object, owner: Identity = DOG, name: str = "dog") -> Record:
    """Return a record with this value in the slot ``name``; a value that is not bytes is packed."""
    packed = value if isinstance(value, bytes) or value is None else bytes(msgpack.packb(value))
    return Record(DEVICES, name, owner.public, 1, "leased", 1.0, packed, bytes(64))


def content(**changes: object) -> dict[str, object]:
    """Return the content of the record of ``DEVICE`` with ``changes``."""
    return {**msgpack.unpackb(DEVICE.pack()), **changes}


class DeviceTests(SynchronousTestCase):
    def test_there_and_back(self) -> None:
        """A device survives packing and unpacking; unused fields take no space."""
        self.assertEqual(parse_device(record(DEVICE.pack())), DEVICE)
        placed = replace(DEVICE, pages=("http://10.0.0.1:8080",), position={"x": 1.0, "y": 2.5, "heading": -0.5})
        self.assertEqual(parse_device(record(placed.pack())), placed)
        bare = {"uuid": DEVICE.uuid, "name": "dog", "of a later version": 1}
        self.assertEqual(parse_device(record(bare)), Device(DEVICE.uuid, "dog"))
        self.assertEqual({"pages", "position"} & set(msgpack.unpackb(DEVICE.pack())), set())

    def test_crafted(self) -> None:
        """A record of another node, or with a wrong type, an invalid number or no name, is not decoded as a device."""
        bad: dict[str, list[object]] = {
            "uuid": [None, 5, ""],
            "name": [5, None, b"dog"],
            "kind": [1],
            "description": [[]],
            "capabilities": [
                5,
                {"camera": 5},
                {"camera": {"width": [1]}},
                {"camera": {"width": float("nan")}},
                {5: {}},
            ],
            "address": [7000],
            "roles": [5, [5], [[]]],
            "joined": ["1", 1.0, True, -1, 2**60],
            "since": ["5", float("inf"), None, 1e300],
            "task": [5],
            "status": ["ASLEEP", 5],
            "pages": [5, "http://a", [5], {"a": 1}],
            "position": [5, [1.0], {"x": "1"}, {"x": float("nan")}, {5: 1.0}],
            "messages": [5, [5], [[1.0]], [[1.0, 5]], [["x", "y"]], [[float("nan"), "y"]], {"a": 1}],
            "network": [5, {"n": "x"}, {"n": float("inf")}],
        }
        for name, values in bad.items():
            for value in values:
                try:
                    one = record(content(**{name: value}))
                except ValueError:
                    continue
                self.assertIsNone(parse_device(one), (name, value))
        self.assertIsNone(parse_device(record(DEVICE.pack(), CAT)))
        for value in (None, b"", b"\xc1", [1], 5, {}, {"name": "dog"}, b"\x91" * 600):
            self.assertIsNone(parse_device(record(value)), value)

    @settings(max_examples=200)
    @given(
        st.binary(max_size=60)
        | st.recursive(
            st.none() | st.booleans() | st.integers(-(2**63), 2**63) | st.floats() | st.text(max_size=4),
            lambda inner: (
                st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(sorted(content())), inner, max_size=6)
            ),
        )
    )
    def test_total(self, value: object) -> None:
        """Any record is decoded as a device or as None, without an exception."""
        one = record(value)
        self.assertIsInstance(parse_device(one), Device | None)
        if isinstance(value, dict):
            parse_device(record({**content(), **value}))

    def test_order_of_joining(self) -> None:
        """Devices are listed in the order of joining, then by uuid; records that are not devices are skipped."""
        cat = Device(CAT.node_id.hex(), "cat", joined=1)
        records = [record(DEVICE.pack()), record(cat.pack(), CAT, "cat"), record(b"?")]
        self.assertEqual([d.name for d, _ in parse_devices(records)], ["cat", "dog"])
        self.assertEqual(parse_devices(records)[0][1], records[1])
        self.assertEqual(parse_devices([record(cat.pack(), CAT, "dog")]), [])

    def test_one_name_twice(self) -> None:
        """Devices with the same name get a part of their ids as a suffix; two records of one device get no suffix."""
        cat = Device(CAT.node_id.hex(), "dog", joined=1)
        records = [record(DEVICE.pack()), record(cat.pack(), CAT)]
        self.assertEqual([d.name for d, _ in parse_devices(records)], [f"dog-{d.uuid[:6]}" for d in (cat, DEVICE)])
        self.assertEqual([d.name for d, _ in parse_devices([records[0], records[0]])], ["dog", "dog"])

    def test_message_lines(self) -> None:
        """Only the newest messages are kept, each truncated to the maximum length."""
        device = DEVICE
        for n in range(9):
            device = device.with_message(float(n), f"{n}" * 100)
        self.assertEqual([t for t, _ in device.messages], [4.0, 5.0, 6.0, 7.0, 8.0])
        self.assertEqual({len(text) for _, text in device.messages}, {70})
        self.assertEqual(len(device.messages), MAX_MESSAGES)

    def test_too_large_gives_way(self) -> None:
        """A record that is too large drops old messages first, then the description, and then the deployed modules."""
        device = Device(DEVICE.uuid, "dog", description="d" * 600)
        for n in range(5):
            device = device.with_message(float(n), f"{n}" * 70)
        said = parse_device(record(device.pack()))
        assert said is not None
        self.assertLessEqual(len(device.pack()), MAX_VALUE_BYTES)
        self.assertEqual(said.description, device.description)
        self.assertEqual(said.messages, device.messages[-len(said.messages) :])
        huge = Device(DEVICE.uuid, "dog", description="d" * 1200, messages=((1.0, "m"),))
        said = parse_device(record(huge.pack()))
        self.assertEqual(said and (said.description, said.messages), ("", ()))
        crowded = Device(DEVICE.uuid, "dog", deployed={f"{n}" * 32: "1 1a2b3c4d, 2 refused" for n in range(8)})
        said = parse_device(record(replace(crowded, capabilities={"c" * 300: {"p" * 200: 1.0}}).pack()))
        self.assertEqual(said and said.deployed, {})


class PresenceTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.told: list[Device | None] = []
        self.calls: list[tuple[float, Callable[[], None]]] = []
        self.presence = Presence(DEVICE, lambda value: self.told.append(parse_device(record(value))), self.later)

    def later(self, delay: float, work: Callable[[], None]) -> Any:
        self.calls.append((delay, work))

    def test_silent_before_it_appears(self) -> None:
        """A change before the first announcement is not announced separately, but contained in this announcement."""
        self.presence.change(status=IDLE)
        self.assertEqual((self.told, self.calls), ([], []))
        self.presence.appear(7)
        self.assertEqual([(d.joined, d.status) for d in self.told if d], [(7, IDLE)])

    def test_changes_are_gathered(self) -> None:
        """Several changes within ``PAUSE_S`` are announced together; a change without effect is not announced."""
        self.presence.appear(7)
        self.presence.change(status=IDLE)
        self.presence.change(task="t2")
        self.presence.change(task="t2")
        self.assertEqual([delay for delay, _ in self.calls], [Presence.PAUSE_S])
        self.calls.pop()[1]()
        self.assertEqual([(d.task, d.status) for d in self.told[1:] if d], [("t2", IDLE)])
        self.presence.change(task="t2")
        self.assertEqual(self.calls, [])
        self.presence.add_message(5.0, "here")
        self.calls.pop()[1]()
        self.assertEqual(self.told[-1] and self.told[-1].messages[-1], (5.0, "here"))
