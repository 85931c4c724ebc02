"""Tests of ``middleware.consensus.decision_record``: writing and reading an agent's decision record."""

from __future__ import annotations

import random
from dataclasses import replace

import msgpack
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.decision_record import (
    MAX_BEST_REPORTS,
    MAX_RECORD_BYTES,
    MAX_REPORTS,
    DecisionRecord,
    decision_records_key,
    make_decision_record,
    make_slot_name,
    parse_decision_record,
)
from middleware.consensus.report_view import ReportView
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import READABLE, Consensus, Report
from middleware.directory.presence import EXECUTING, WAITING
from middleware.entangled.identity import Identity
from middleware.entangled.record import Record
from middleware.tasks.task import Member


def identity(number: int) -> Identity:
    return Identity(number.to_bytes(32, "big"))


def member(number: int, cost: float | None, status: str = WAITING) -> Member:
    return Member(identity(number).node_id.hex(), f"dog{number}", status, cost)


def decided(
    number: int, members: list[Member], epoch: int = 1, version: str = "1", assigned: int | None = None
) -> DecisionRecord:
    """Return the decision record of dog ``number``, which knows ``members``.

    ``assigned`` replaces the computed winner.
    """
    me = next(m for m in members if m.name == f"dog{number}")
    others = [m for m in members if m is not me]
    consensus = Nearest().find([Report(m.uuid, m.cost) for m in members if m.cost is not None])
    named = consensus.assigned_agent if assigned is None else identity(assigned).node_id.hex()
    return make_decision_record("t1", epoch, me, others, "nearest", version, consensus, named, 0.1)


def record_of(number: int, record: DecisionRecord, value: bytes | None = None, name: str = "") -> Record:
    """Return the signed record that dog ``number`` publishes."""
    content = record.pack() if value is None else value
    slot = name or record.slot
    return Record(decision_records_key("t1"), slot, identity(number).public, 1, "team", 60.0, content).sign(
        identity(number)
    )


THREE = [member(1, 1.5), member(2, 0.5), member(3, 1.0)]


class DecisionRecordTests(SynchronousTestCase):
    def test_survives_the_wire(self) -> None:
        """A packed and signed decision record is unpacked unchanged.

        Its agent follows from the key of the signature.
        """
        record = replace(decided(1, THREE), token=7)
        self.assertEqual(parse_decision_record(record_of(1, record)), record)
        self.assertEqual([r.name for r in record.reports], ["dog2", "dog3", "dog1"])
        self.assertEqual(record.winner, THREE[1].uuid)
        self.assertEqual(record.standby, (THREE[2].uuid, THREE[0].uuid))

    def test_nobody_testifies_for_another(self) -> None:
        """If dog2 publishes a copy of dog1's decision record, it counts as a record of dog2."""
        copied = parse_decision_record(record_of(2, decided(1, THREE)))
        self.assertEqual(copied is not None and copied.agent, identity(2).node_id.hex())

    def test_many_reports_are_the_best_and_a_count(self) -> None:
        """A record contains all reports if there are at most thirty.

        Otherwise it contains the best eight reports and the number of all reports. The size of the record is limited.
        """
        for n, written in ((MAX_REPORTS, MAX_REPORTS), (MAX_REPORTS + 1, MAX_BEST_REPORTS), (500, MAX_BEST_REPORTS)):
            members = [member(i, float(i)) for i in range(1, n + 1)]
            record = decided(1, members)
            self.assertEqual((len(record.reports), record.reported), (written, n))
            self.assertEqual(parse_decision_record(record_of(1, record)), record)
        long = [replace(member(i, float(i)), name="\N{SNOWMAN}" * 90) for i in range(1, MAX_REPORTS + 1)]
        long += [replace(member(i, None), name="w" * 90) for i in range(100, 200)]
        consensus = Consensus(long[0].uuid, tuple(m.uuid for m in long), "d" * 90)
        given = ("t" * 64, 2**53, long[0], long, "r" * 90, "v" * 90, consensus, long[0].uuid, 0.1, 2**53)
        self.assertLessEqual(len(make_decision_record(*given).pack()), MAX_RECORD_BYTES)
        minded = [replace(m, battery=0.123, load=2**53, value=(1e9,) * 8, choice="\N{SNOWMAN}" * 64) for m in long]
        agreed = replace(consensus, value=(1e9 / 7,) * 8, choice="\N{SNOWMAN}" * 64)
        given = ("t" * 64, 2**53, minded[0], minded, "r" * 90, "v" * 90, agreed, long[0].uuid, 0.1, 2**53)
        packed = make_decision_record(*given, ReportView(READABLE)).pack()
        self.assertLessEqual(len(packed), MAX_RECORD_BYTES)

    def test_what_counted_is_told(self) -> None:
        """The record contains the values that the strategy read and the agreed value, but no other values."""
        members = [replace(member(1, 1.5), battery=0.4, load=3), replace(member(2, 0.5), choice="red", weight=2.0)]
        members.append(replace(member(3, 1.0), value=(1.0, 2.0)))
        found = Consensus(members[1].uuid, value=(1.0, 2.5), choice="red")
        given = ("t1", 1, members[0], members[1:], "any", "1", found, found.assigned_agent, 0.1, 0)
        record = parse_decision_record(record_of(1, make_decision_record(*given, ReportView(READABLE))))
        assert record is not None
        self.assertEqual((record.value, record.choice), ((1.0, 2.5), "red"))
        told = {r.name: r.more for r in record.reports}
        self.assertEqual(told["dog1"], "battery 40%, 2 other tasks")
        self.assertEqual((told["dog2"], told["dog3"]), ("for red, weight 2", "at (1.00, 2.00)"))
        self.assertEqual({r.more for r in make_decision_record(*given, ReportView()).reports}, {""})

    def test_hysteresis_is_told(self) -> None:
        """If hysteresis keeps the previous agent in action, the record explains this."""
        acting = [member(1, 1.0, EXECUTING), member(2, 0.95), member(3, None)]
        for assigned, words in (
            (1, "dog2 is the best, but not more than 10% better than dog1, which acts"),
            (2, "dog2 is more than 10% better than dog1, which acted before"),
        ):
            self.assertEqual(decided(3, acting, assigned=assigned).hysteresis, words)
        self.assertEqual(decided(1, THREE).hysteresis, "no agent acted before")
        found = Consensus(THREE[2].uuid, task="t1", reason="divided with 2 others among 3")
        shared = make_decision_record(
            "t1", 1, THREE[0], THREE[1:], "group_optimal", "1", found, found.assigned_agent, 0.1
        )
        self.assertEqual(shared.hysteresis, "no agent acted before; divided with 2 others among 3")
        open_ = Consensus(None, reason="no vote; more than half of 3 is needed")
        words = make_decision_record("t1", 1, THREE[0], THREE[1:], "weighted_vote", "1", open_, None, 0.1).hysteresis
        self.assertEqual(words, "no vote; more than half of 3 is needed")
        self.assertIn("no agent is better", decided(2, [member(1, 0.5, EXECUTING), member(2, 0.7)]).hysteresis)
        self.assertEqual(decided(1, [member(1, None)]).hysteresis, "no report is valid")

    def test_decoder_is_total(self) -> None:
        """Any value of a record is decoded as a decision record or None, without an exception."""
        good = decided(1, THREE)
        content = msgpack.unpackb(good.pack())
        bad: dict[str, list[object]] = {
            "name": [None, 7, "a\x1b[2J"],
            "epoch": [-1, 2**60, 1.5, True, "1", 2],
            "winner": ["ab", b"ab", None],
            "standby": [None, [b"x"], [1], [bytes(20)] * 9],
            "reports": [None, [[]], [[bytes(20), "a", float("nan")]], [[bytes(20), "a", -1.0]], [[b"", "a", 1.0]]],
            "silent": [None, [7], ["\n"]],
            "reported": [0, 99],
            "participants": [0, None],
            "value": [5, ["x"], [float("nan")], [0.0] * 9],
            "choice": [None, 7, "a\x1b[2J", "x" * 65],
            "more": [None, [7], ["\n"], ["a"] * 4],
        }
        for field, values in bad.items():
            for value in values:
                packed = msgpack.packb({**content, field: value})
                self.assertIsNone(parse_decision_record(record_of(1, good, packed)), f"{field} {value!r}")
        for raw in (b"", b"\xc1", b"\x90", msgpack.packb({}), bytes(MAX_RECORD_BYTES + 1)):
            self.assertIsNone(parse_decision_record(record_of(1, good, raw)))
        self.assertIsNone(parse_decision_record(replace(record_of(1, good), value=None)))
        self.assertIsNone(parse_decision_record(record_of(1, good, name="member")))
        self.assertIsNone(parse_decision_record(record_of(1, good, name=make_slot_name(good.epoch + 1))))
        rng = random.Random(5)
        for _ in range(500):
            crafted = bytearray(good.pack())
            for _ in range(rng.randint(1, 5)):
                crafted[rng.randrange(len(crafted))] = rng.randrange(256)
            parse_decision_record(record_of(1, good, bytes(crafted)))

    def test_name_of_another_spoils_nothing(self) -> None:
        """If a member's name contains control characters, they are omitted, and the record stays readable."""
        hostile = replace(member(2, 0.5), name="a\x1b[2J\ud800")
        record = parse_decision_record(record_of(1, decided(1, [hostile, member(1, 1.0)])))
        self.assertIsNotNone(record)
        self.assertEqual(record and record.reports[0].name, "a?[2J?")

    def test_of_many_the_best_tell(self) -> None:
        """In a group of at most thirty agents all write decision records; in a larger group the best eight do."""
        members = [member(i, float(i)) for i in range(1, MAX_REPORTS + 2)]
        self.assertTrue(all(decided(n, members[:MAX_REPORTS]).is_publisher for n in range(1, MAX_REPORTS + 1)))
        told = [record for n in range(1, MAX_REPORTS + 2) if (record := decided(n, members)).is_publisher]
        self.assertEqual([record.name for record in told], [f"dog{n}" for n in range(1, MAX_BEST_REPORTS + 1)])
