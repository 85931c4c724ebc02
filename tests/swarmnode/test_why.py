"""Tests of ``swarmnode.why``: the explanation of a decision and of a takeover."""

from __future__ import annotations

import json

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.tasks.task import Task
from swarmnode.control_client import Rejection
from swarmnode.simulated_team import SimulatedTeam
from swarmnode.why import main, select_task
from tests.swarmnode.shell import Shell, runtime_folder


class WhyTests(SynchronousTestCase):
    def setUp(self) -> None:
        runtime_folder(self, "vaio")
        self.team = SimulatedTeam(4)
        self.addCleanup(self.team.stop)
        self.shell = Shell(self.team, self.team.services["vaio"].assembly.node)

    def why(self, line: str) -> str:
        """Run ``swarm why LINE``, which must succeed; return its output."""
        code, output = self.shell.run(main, line.split())
        self.assertEqual((code, self.shell.said), (0, ""))
        return output

    def until(self, status: str) -> str:
        """Run the team until a dog has ``status``; return the name of that dog."""
        for _ in range(400):
            self.team.clock.advance(0.2)
            for device in self.team.state()["devices"]:
                if device["status"] == status:
                    return str(device["name"])
        self.fail(f"nobody was ever {status}")

    def test_takeover_is_explained(self) -> None:
        """The explanation covers the epochs of the first agent and of its successor: agreement, tokens and reports."""
        task = self.team.run_demo()
        first = self.until("EXECUTING")
        self.team.clock.advance(1.5)
        told = self.why(task[:5])
        self.assertIn(f"task {task}: Find the red target\n", told)
        self.assertIn(f"epoch 1: {first}, 3 of 3 agree, token 1\n", told)
        self.assertIn("by nearest 2 from reports ", told)
        self.team.kill(first)
        self.team.clock.advance(1.5)
        second = self.until("EXECUTING")
        self.team.clock.advance(1.5)
        told = self.why("last")
        self.assertIn(f"epoch 2: {second}, 2 of 2 agree, token 2\n", told)
        self.assertLess(told.index("epoch 2"), told.index("epoch 1"))
        self.assertIn(f"epoch 1: {first}, 3 of 3 agree", told)
        self.until("DONE")
        self.team.clock.advance(1.0)
        self.assertIn(f", completed by {second}\n", self.why(task))
        (newest, *_) = json.loads(self.why(f"{task} --json"))["epochs"]
        self.assertEqual((newest["chosen"], newest["of"], newest["rule"]), (second, 2, "nearest"))
        card = next(each for each in self.team.state()["tasks"] if each["id"] == task)
        self.assertEqual([(each["chosen"], each["agree"]) for each in card["why"]], [(second, 2), (first, 3)])

    def test_errors_by_name(self) -> None:
        """If there is no task or decision, or the id or node is unknown, one error line lists the known values."""
        self.assertEqual(self.shell.run(main, ["last"]), (1, ""))
        self.assertEqual(self.shell.said, "swarm why: the team has no task; assign one on the page of its web node\n")
        task = self.team.run_demo()
        self.team.clock.advance(1.0)
        code, output = self.shell.run(main, ["last"])
        self.assertEqual((code, output.splitlines()[-1]), (1, "no decision yet"))
        self.assertEqual(self.shell.run(main, ["zz"])[0], 1)
        self.assertEqual(self.shell.said, f"swarm why: no task id begins with 'zz'; the newest are {task}\n")
        self.assertEqual(self.shell.run(main, ["last", "--node", "nobody"])[0], 2)
        self.assertIn("no node 'nobody' runs", self.shell.said)

    def test_title_cannot_move_the_cursor(self) -> None:
        """Control characters in a task's title do not reach the terminal."""
        node = self.team.services["vaio"].assembly.node
        Deferred.fromCoroutine(node.submit(Task("evil", "search", "red\x1b[2J\n target")))
        self.team.clock.advance(1.0)
        self.assertTrue(self.shell.run(main, ["evil"])[1].startswith("task evil: red [2J  target\n"))

    def test_ids_cannot_move_the_cursor(self) -> None:
        """Control characters in the task ids of an error message do not reach the terminal."""
        node = self.team.services["vaio"].assembly.node
        for task_id in ("a\x1b[2J", "a\n"):
            Deferred.fromCoroutine(node.submit(Task(task_id, "search", "red")))
        self.team.clock.advance(1.0)
        self.assertEqual(self.shell.run(main, ["zz"])[0], 1)
        self.assertEqual(self.shell.said, "swarm why: no task id begins with 'zz'; the newest are a , a [2J\n")
        self.shell.run(main, ["a"])
        self.assertEqual(self.shell.said, "swarm why: 2 task ids begin with 'a': a , a [2J; enter more characters\n")

    def test_prefix(self) -> None:
        """An ambiguous prefix is rejected with the matching ids.

        A complete id matches even if it is a prefix of another.
        """
        tasks = [Task(name, "k", name, created=float(n)) for n, name in enumerate(("ab", "abc", "b"))]
        self.assertEqual(select_task("last", tasks).task_id, "b")
        self.assertEqual(select_task("ab", tasks).task_id, "ab")
        self.assertEqual(select_task("abc", tasks).task_id, "abc")
        error = self.assertRaises(Rejection, select_task, "a", tasks)
        self.assertEqual(str(error), "2 task ids begin with 'a': abc, ab; enter more characters")
        self.assertRaises(Rejection, select_task, "", tasks)
