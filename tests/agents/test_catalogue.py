"""Tests of ``agents.catalogue``."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from agents.catalogue import DEMO_TASK, TASKS, create_task
from drivers.registry import describe
from middleware.consensus.strategy import load_strategy
from middleware.entangled.record import Record
from middleware.errors import UnknownTask
from middleware.tasks.task import TASKS as KEY
from middleware.tasks.task import find_unmet_requirements, parse_task


class CatalogueTests(SynchronousTestCase):
    def test_tasks_survive_the_wire(self) -> None:
        """Each predefined task survives encoding in a valid record, and its strategy exists."""
        for name in TASKS:
            task = create_task(name, "t1", 5.0)
            record = Record(KEY, "t1", bytes(32), 1, "team", 60.0, task.pack())
            self.assertEqual(parse_task(record), task)
            load_strategy(task.strategy)

    def test_yards_dog_can_do_what_it_is_made_for(self) -> None:
        """A simulated dog can do the demonstration, but lacks the gripper that fetching the ball requires."""
        capabilities = describe("sim", {}, "dog1").capabilities
        self.assertEqual(find_unmet_requirements(capabilities, TASKS[DEMO_TASK].requirements), [])
        self.assertEqual(find_unmet_requirements(capabilities, TASKS["turn-around"].requirements), [])
        self.assertEqual(
            find_unmet_requirements(capabilities, TASKS["fetch-the-ball"].requirements), ["has no gripper"]
        )

    def test_phone_can_watch_and_no_more(self) -> None:
        """A phone can watch the target, but cannot do the tasks that need a mobile base."""
        phone, dog = describe("phone", {}).capabilities, describe("sim", {}, "dog1").capabilities
        self.assertEqual(
            [find_unmet_requirements(each, TASKS["watch-target"].requirements) for each in (phone, dog)], [[], []]
        )
        self.assertIn("has no base2d", find_unmet_requirements(phone, TASKS[DEMO_TASK].requirements))
        self.assertIn("has no base2d", find_unmet_requirements(phone, TASKS["turn-around"].requirements))

    def test_unknown_name_lists_the_known(self) -> None:
        """An unknown task name is refused; the error lists the known names."""
        error = self.assertRaises(UnknownTask, create_task, "dance", "t1", 0.0)
        self.assertIn("'dance'; known tasks: fetch-the-ball, find-red-target, turn-around, watch-target", str(error))
