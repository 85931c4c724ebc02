"""Tests of ``TeamView`` with records that the test writes."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.directory.presence import DEVICES, Device
from middleware.entangled.identity import Identity, derive_node_id
from middleware.entangled.record import Record
from middleware.frontend.team_view import TeamView
from middleware.tasks.order import PAUSE, RESUME, Order
from middleware.tasks.task import CANCELLED, MEMBER, ORDER, RESULT, TASKS, Member, Result, Task, group_key

DOG = Identity(bytes(32))
UUID = derive_node_id(DOG.public).hex()
OLD = Task("old", "search", "Search", {"camera": {"width": 160}}, created=1.0)
NEW = Task("new", "search", "Search", created=2.0)


def record_of(key: bytes, name: str, value: bytes) -> Record:
    """Return an unsigned record of the dog."""
    return Record(key, name, DOG.public, 1, "team", 60.0, value, bytes(64))


class TeamViewTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.records: dict[bytes, list[Record]] = {}
        self.view = TeamView(lambda key: self.records.get(key, []))
        self.write(DEVICES, "dog1", Device(UUID, "dog1", capabilities={"camera": {"width": 80}}).pack())
        self.write(TASKS, "old", OLD.pack())
        self.write(TASKS, "new", NEW.pack())

    def write(self, key: bytes, name: str, value: bytes) -> None:
        """Add a record under ``key``."""
        self.records.setdefault(key, []).append(record_of(key, name, value))

    def test_newest_task_first(self) -> None:
        """Tasks are sorted by their creation time, the newest first."""
        self.assertEqual([task.task_id for task in self.view.tasks], ["new", "old"])

    def test_task_with_a_result_is_not_open(self) -> None:
        """A task with a result is closed, and its progress contains the outcome."""
        self.write(group_key("new"), RESULT, Result(CANCELLED, "vaio").pack())
        self.assertEqual([task.task_id for task in self.view.open_tasks], ["old"])
        outcome = self.view.find_progress(NEW).outcome
        assert outcome is not None
        self.assertEqual((outcome.outcome, outcome.by), (CANCELLED, "vaio"))

    def test_progress_has_the_agents_and_the_newest_order(self) -> None:
        """A task is paused from the order to pause until a newer order or the result of the task."""
        self.write(group_key("old"), MEMBER, Member(UUID, "dog1", "searching").pack())
        self.write(group_key("old"), ORDER, Order(PAUSE, "vaio", 1.0).pack())
        progress = self.view.find_progress(OLD)
        self.assertEqual(([member.name for member in progress.members], progress.paused_by), (["dog1"], "vaio"))
        for name, value in ((ORDER, Order(RESUME, "vaio", 2.0)), (RESULT, Result(CANCELLED, "vaio"))):
            self.records[group_key("old")][2:] = []
            self.write(group_key("old"), name, value.pack())
            self.assertEqual(self.view.find_progress(OLD).paused_by, "")

    def test_unable_names_devices_and_requirements(self) -> None:
        """A device without a required property is listed with the requirement that it does not meet."""
        self.assertEqual(list(self.view.find_unable_devices(OLD)), ["dog1"])
        self.assertEqual(self.view.find_unable_devices(NEW), {})

    def test_absent_device_has_the_beginning_of_its_uuid_as_name(self) -> None:
        """A device that has left has no record, so its name is the first 8 characters of its uuid."""
        self.assertEqual(self.view.find_name(UUID), "dog1")
        self.assertEqual(self.view.find_name("ab" * 32), "abababab")
        self.assertIsNone(self.view.find_record("ab" * 32))
