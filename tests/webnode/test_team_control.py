"""Tests of ``webnode.team_control``: the replies of devices to requests, in a small team in memory."""

from __future__ import annotations

from collections.abc import Callable
from operator import itemgetter
from typing import Any

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from agents.catalogue import DEMO_TASK, TASKS
from middleware.frontend.client import LOOKUP_S, TeamClient
from middleware.tasks.task import TASKS as ALL_TASKS
from swarmnode.simulated_team import SimulatedTeam
from webnode.errors import Refusal
from webnode.team_control import ANSWER_LIMIT_S, PLACE_TARGET_S, TeamControl


class TeamControlTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.team = SimulatedTeam(3, dogs=("dog1", "dog2"))
        self.addCleanup(self.team.stop)
        self.control = self.team.control

    def uuid(self, name: str) -> str:
        """Return the uuid of a device."""
        return str(self.team.services[name].assembly.node.uuid)

    def refusal(self, asked: Deferred[Any], seconds: float = ANSWER_LIMIT_S + 0.2) -> Refusal:
        """Return the error of a failed request."""
        self.team.clock.advance(seconds)
        refusal = self.failureResultOf(asked, Refusal).value
        assert isinstance(refusal, Refusal)
        return refusal

    def test_say_who_has_a_message(self) -> None:
        """A message to all devices returns its recipients, and the reason for each device that did not receive it."""
        told = self.control.send_message("", "sit")
        self.team.clock.advance(0.1)
        self.assertEqual(self.successResultOf(told), {"delivered": ["dog1", "dog2", "vaio"], "failed": {}})
        self.team.block_datagrams("dog2")
        told = self.control.send_message("", "stay")
        self.team.clock.advance(ANSWER_LIMIT_S + 0.2)
        answer = self.successResultOf(told)
        self.assertEqual(answer["delivered"], ["dog1", "vaio"])
        self.assertEqual(list(answer["failed"]), ["dog2"])

    def test_device_that_vanishes_is_told(self) -> None:
        """If a device fails during a request, the error reaches the page within the page's time limit."""
        orders: list[tuple[Any, Any]] = [(self.control.send_message, "sit"), (self.control.disconnect, 5.0)]
        for order, what in orders:
            uuid = self.uuid("dog2")
            self.team.kill("dog2")
            refusal = self.refusal(order(uuid, what))
            self.assertEqual((refusal.field, refusal.status), ("device", 409))
            self.assertEqual(refusal.problem, "dog2 left during the request")
            self.team.add_node("dog2")
            self.team.clock.advance(3.0)

    def test_device_that_is_silent_is_told(self) -> None:
        """A device that is present but does not reply gives status 504."""
        presence = self.team.services["dog2"].assembly.node
        presence.entangled.endpoint.expose("device.message", lambda peer, text: Deferred(), changes=True)
        refusal = self.refusal(self.control.send_message(self.uuid("dog2"), "sit"))
        self.assertEqual((refusal.status, refusal.problem), (504, "dog2 did not answer"))

    def test_device_that_says_no_is_told(self) -> None:
        """A device's refusal is forwarded with its own text; an unknown uuid is reported as a lost device."""
        refusal = self.refusal(self.control.send_message(self.uuid("dog2"), "x" * 300))
        self.assertEqual(refusal.status, 409)
        self.assertIn("dog2 refused: a message is a text of 1 to 200 characters", refusal.problem)
        self.assertIn("has left the network", self.refusal(self.control.disconnect("ab" * 16, 5.0)).problem)

    def test_disconnect_is_answered_before_it_leaves(self) -> None:
        """A device replies to the request to disconnect before it disconnects."""
        gone = self.control.disconnect(self.uuid("dog2"), 5.0)
        self.team.clock.advance(0.03)
        self.assertEqual(self.successResultOf(gone), "leaving")
        self.team.state()
        self.team.clock.advance(2.0)
        self.assertEqual([row["status"] for row in self.team.state()["devices"] if row["name"] == "dog2"], ["GONE"])

    def test_preview(self) -> None:
        """The preview lists able devices, and refused devices with reasons, and assigns nothing."""
        preview = self.control.preview("find-red-target")
        self.assertEqual([(row["name"], row["busy"]) for row in preview["able"]], [("dog1", ""), ("dog2", "")])
        self.assertIn("vaio", preview["refused"])
        self.assertIsNone(preview["likely"])
        self.assertEqual(self.team.state()["tasks"], [])
        self.assertEqual(self.assertRaises(Refusal, self.control.preview, "fly").status, 404)

    def test_preview_of_a_group(self) -> None:
        """A task in a group is previewed together with the group's open tasks that have the same requirements."""
        wishes = [("turn-around", "yard"), ("find-red-target", "yard"), ("turn-around", "attic"), ("turn-around", "")]
        ids = [self.control.assign(name, group=group)["id"] for name, group in wishes]
        self.team.clock.advance(1.0)
        first = self.team.state()["tasks"]
        title = next(row["title"] for row in first if row["id"] == ids[0])
        self.assertEqual(self.control.preview("turn-around", "yard")["together"], [{"id": ids[0], "title": title}])
        self.assertEqual(self.control.preview("turn-around", "cellar")["together"], [])
        self.assertEqual(self.control.preview("turn-around")["together"], [])
        self.control.cancel(ids[0])
        self.team.clock.advance(1.0)
        self.assertEqual(self.control.preview("turn-around", "yard")["together"], [])

    def test_preview_by_what_is_reported(self) -> None:
        """While an equal task is running, the preview shows busy devices and the nearest device.

        It uses the reports of the devices on the running task.
        """
        self.team.run_demo()
        for _ in range(60):
            self.team.clock.advance(0.5)
            preview = self.control.preview("find-red-target")
            if preview["likely"]:
                break
        (group,) = self.team.state()["groups"]
        costs = {row["name"]: row["cost"] for row in group["members"] if row["cost"] is not None}
        self.assertEqual(preview["likely"], min(costs, key=lambda name: costs[name]))
        title = self.team.state()["tasks"][0]["title"]
        self.assertEqual({row["busy"] for row in preview["able"]}, {title})
        self.assertIsNone(self.control.preview("turn-around")["likely"])

    def test_target_comes_without_the_node_that_ordered_it(self) -> None:
        """If the web node fails after it started the demonstration, the simulator still places the target."""
        self.team.run_demo()
        self.team.clock.advance(1.0)
        self.assertIsNone(self.team.get_true_state()["target"])
        self.team.kill("vaio")
        self.team.clock.advance(PLACE_TARGET_S)
        self.assertIsNotNone(self.team.get_true_state()["target"])

    def test_lift_a_robot(self) -> None:
        """A robot is moved to the given place; for an occupied place the simulator's error is returned."""
        moved = self.control.move_robot("dog1", 1.0, 1.0, 0.5)
        self.team.clock.advance(0.1)
        self.assertIsNone(moved.addCallback(lambda _: None).result)
        dog = self.team.get_true_state()["dogs"][0]
        self.assertLess(abs(dog["x"] - 1.0) + abs(dog["y"] - 1.0), 0.05)
        refusal = self.refusal(self.control.move_robot("dog2", 1.0, 1.0, 0.5), 0.1)
        self.assertEqual((refusal.field, refusal.status), ("dog2", 409))
        self.assertIn("dog1 stands at", refusal.problem)


class RepeatedWishTests(SynchronousTestCase):
    """One request that is sent to two web nodes."""

    def setUp(self) -> None:
        self.team = SimulatedTeam(3, dogs=("dog1", "dog2"), others=("pi",))
        self.addCleanup(self.team.stop)
        self.control = self.team.control
        self.reserve = TeamControl(TeamClient(self.team.services["pi"].assembly.node), TASKS, DEMO_TASK)
        self.team.clock.advance(1.0)

    def test_wish_that_is_repeated_elsewhere(self) -> None:
        """A request that another web node has executed is not executed again, even if this node has not heard of it."""
        wishes: list[Callable[[TeamControl], Any]] = [
            lambda control: control.assign("find-red-target", 2, "yard", task_id="a1").addCallback(itemgetter("id")),
            lambda control: control.run_demo("b2"),
        ]
        owner = self.team.services["vaio"].assembly.node.entangled.contact.public
        for wish, task_id in zip(wishes, ("a1", "b2"), strict=True):
            self.team.block_datagrams("pi")
            first = wish(self.control)
            self.team.clock.advance(1.0)
            self.team.switchboard.heal()
            self.assertNotIn(task_id, [record.name for record in self.reserve.read(ALL_TASKS)])
            again = wish(self.reserve)
            self.team.clock.advance(LOOKUP_S)
            self.assertEqual((self.successResultOf(first), self.successResultOf(again)), (task_id, task_id))
            owners = [record.owner for record in self.control.read(ALL_TASKS) if record.name == task_id]
            self.assertEqual(owners, [owner])
        statuses = sorted(task["status"] for task in self.team.state()["tasks"])
        self.assertEqual(statuses, ["ASSIGNED", "CANCELLED"])

    def test_wish_that_the_first_node_died_of(self) -> None:
        """If the first node fails before the request has an effect, the next node executes the request in time."""
        self.team.kill("vaio")
        wish = self.reserve.assign("turn-around", task_id="a1")
        self.team.clock.advance(LOOKUP_S + 0.1)
        self.assertEqual(self.successResultOf(wish)["id"], "a1")
        self.assertEqual([r.name for r in self.reserve.read(ALL_TASKS)], ["a1"])
