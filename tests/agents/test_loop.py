"""Tests of ``agents.loop``: the agent that connects its node and its robot, in a small team in memory."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.task import deferLater
from twisted.trial.unittest import SynchronousTestCase

from agents.loop import Agent
from drivers.driver import Permit
from drivers.errors import NotEnabled
from drivers.reading import Action, Frame, Observation
from middleware.consensus.lease.lease_client import Lease
from middleware.errors import UnknownStrategy
from middleware.tasks.task import TASKS, Task
from swarmnode.simulated_team import SimulatedTeam


class LoopTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.team = SimulatedTeam(11, dogs=("dog1", "dog2"))
        self.addCleanup(self.team.stop)
        self.agent = self.agent_of("dog1")

    def agent_of(self, name: str) -> Agent:
        """Return the agent of a dog."""
        agent = self.team.services[name].assembly.agent
        assert isinstance(agent, Agent)
        return agent

    def submit(self, **fields: Any) -> None:
        """Submit a task with these fields directly to the node, bypassing the operator's page and its catalogue."""
        task = Task(**{"task_id": "t1", "kind": "turn-around", "title": "Odd", **fields})
        node = self.team.services["vaio"].assembly.node
        Deferred.fromCoroutine(node.submit(task))
        self.team.clock.advance(1.0)

    def device(self, name: str) -> dict[str, Any]:
        """Return the device with this name from the page's state."""
        return next(dict(row) for row in self.team.state()["devices"] if row["name"] == name)

    def lines(self, name: str) -> list[str]:
        """Return the messages of a device."""
        return [text for _, text in self.device(name)["messages"]]

    def test_age_of_a_picture(self) -> None:
        """The age of a camera frame is the time that it spent in the robot plus the time since its arrival."""
        agent = self.team.services["dog1"].assembly.agent
        assert isinstance(agent, Agent)
        ages: list[float] = []
        uuid = self.team.services["dog1"].assembly.node.uuid
        self.team.control.stream_camera(uuid, lambda seq, jpeg, age: ages.append(age) if jpeg == b"seen" else None)
        self.team.clock.advance(0.2)
        frame = Frame(900, 1, 1, b"seen", 4.7)
        agent._on_observation(Observation(self.team.clock.seconds() - 0.2, 5.0, {}, {}, frame))
        self.team.clock.advance(0.05)
        (age,) = ages
        self.assertLess(abs(age - 0.5), 0.01)

    def test_no_command_before_the_motors_are_on(self) -> None:
        """An agent with a task sends no command before its robot's motors are enabled."""
        self.submit()
        refused: list[str] = []
        self.team.add_node("dog3")
        driver: Any = self.team.services["dog3"].assembly.driver
        act = driver.act

        def watched(action: Action, permit: Permit) -> Action:
            try:
                done: Action = act(action, permit)
                return done
            except NotEnabled as error:
                refused.append(str(error))
                raise

        enable = driver.enable
        driver.act = watched
        driver.enable = lambda: deferLater(self.team.clock, 1.5, enable)  # a robot that starts slowly
        self.team.clock.advance(1.3)
        self.assertIsNot(self.agent_of("dog3").engagement, None)
        self.assertFalse(self.agent_of("dog3")._robot.is_enabled)
        self.team.clock.advance(2.0)
        self.assertTrue(self.agent_of("dog3")._robot.is_enabled)
        self.assertEqual(refused, [])

    def test_motors_are_asked_for_until_they_are_on(self) -> None:
        """If the connection breaks while the motors start, the agent enables the motors again after it reconnects."""
        self.team.add_node("dog3")
        service = self.team.services["dog3"]
        connector = self.team.connectors["dog3"]
        driver: Any = service.assembly.driver
        while driver.state == "connecting" or not connector.links:
            self.team.clock.advance(0.0005)
        connector.cut()
        self.team.clock.advance(3.0)
        self.team.control.assign("turn-around")
        self.team.clock.advance(1.0)
        self.assertTrue(self.agent_of("dog3")._robot.is_enabled)
        self.assertIsNot(self.agent_of("dog3").engagement, None)

    def test_switched_off_robot_takes_no_part(self) -> None:
        """A robot with disabled motors still sends observations, but takes no task until they are enabled again."""
        self.submit(kind="find-target")
        self.team.clock.advance(3.0)
        driver = self.team.services["dog1"].assembly.driver
        assert driver is not None
        driver.disable()
        self.team.clock.advance(1.0)
        engagement = self.agent.engagement
        assert engagement is not None
        for _ in range(40):
            self.assertEqual((engagement.me.available, engagement.me.cost), (False, None))
            self.team.clock.advance(0.05)
        driver.enable()
        self.team.clock.advance(1.0)
        self.assertTrue(engagement.me.available)

    def test_every_motion_of_the_task_is_under_a_lease(self) -> None:
        """Each motion command of a task carries the token and deadline of the agent's valid lease."""
        bad: list[object] = []
        count = 0
        for name in ("dog1", "dog2"):
            agent = self.agent_of(name)
            driver: Any = agent._robot.driver

            def watched(action: Action, permit: Permit, agent: Agent = agent, act: Any = driver.act) -> Action:
                nonlocal count
                if any(action.values()):
                    count += 1
                    engagement = agent.engagement
                    lease = (
                        None if engagement is None or engagement.lease_client is None else engagement.lease_client.lease
                    )
                    if lease != Lease("t1", permit.token, permit.deadline):
                        bad.append((action, permit, lease))
                done: Action = act(action, permit)
                return done

            driver.act = watched
        self.submit()
        self.team.clock.advance(8.0)
        self.assertGreater(count, 20)
        self.assertEqual(bad, [])
        self.assertEqual(self.team.state()["tasks"][0]["status"], "COMPLETED")

    def test_only_who_did_it_is_done(self) -> None:
        """After the task the assigned agent becomes DONE; the other agent becomes IDLE without becoming DONE."""
        self.submit()
        ends: dict[str, list[str]] = {"dog1": [], "dog2": []}
        for name, statuses in ends.items():
            presence = self.team.services[name].assembly.node.presence
            change = presence.change

            def watched(statuses: list[str] = statuses, change: Any = change, **changes: Any) -> None:
                if "status" in changes:
                    statuses.append(changes["status"])
                change(**changes)

            presence.change = watched  # type: ignore[method-assign]
        self.team.clock.advance(8.0)
        by = self.team.state()["tasks"][0]["result"]["by"]
        self.assertEqual(ends.pop(by)[-1], "DONE")
        (other,) = ends.values()
        self.assertEqual((other[-1], other.count("DONE")), ("IDLE", 0))

    def test_task_without_a_behaviour_is_left_and_said(self) -> None:
        """A task with an unknown kind or invalid parameters adds a message to the device; the next task is executed."""
        self.submit(kind="os:system")
        self.assertIn("no behaviour for tasks of kind 'os:system'", self.lines("dog1")[-1])
        self.submit(task_id="t2", created=1.0, kind="find-target", parameters={"target_radius": 0.0})
        self.assertIn("invalid parameters", self.lines("dog1")[-1])
        self.submit(task_id="t3", created=2.0)
        self.team.clock.advance(8.0)
        states = {each["id"]: each["status"] for each in self.team.state()["tasks"]}
        self.assertEqual(states["t3"], "COMPLETED")

    def test_strategy_is_never_imported_from_a_task(self) -> None:
        """A strategy of the form ``module:name`` is refused, both in a submission and in a record of another node."""
        node = self.team.services["vaio"].assembly.node
        task = Task("t0", "turn-around", "Odd", strategy="os:system")
        self.failureResultOf(Deferred.fromCoroutine(node.submit(task)), UnknownStrategy)
        for odd in (task, replace(task, task_id="t2", created=1.0, strategy="loudest")):
            node.entangled.put(TASKS, odd.task_id, odd.pack(), "team")
            self.team.clock.advance(1.0)
            self.assertIn(f"unknown strategy {odd.strategy!r}", self.lines("dog1")[-1])

    def test_old_task_that_is_done_is_not_begun_again(self) -> None:
        """A dog that joins after the end of a task does not execute the task."""
        self.submit()
        self.team.clock.advance(8.0)
        self.team.add_node("dog3")
        self.team.clock.advance(3.0)
        self.assertEqual(self.device("dog3")["status"], "IDLE")
        self.assertEqual(self.agent_of("dog3")._task_queue.open_ids, set())

    def test_task_is_taken_up_when_nobody_could_tell_at_first(self) -> None:
        """If no node replies to a query for the reports on a task, the agent repeats the query until a node replies."""
        agent = self.agent_of("dog1")
        node = agent._node
        get, tries = node.entangled.get, []

        def silent(key: bytes, concern: str = "majority") -> Any:
            tries.append(key)
            return (
                get(key)
                if len(tries) > 2
                else node.entangled.endpoint.discover(node.entangled.contact.address._replace(port=9), 0.1)
            )

        node.entangled.get = silent  # type: ignore[method-assign]
        self.submit()
        self.team.clock.advance(2.0)
        self.assertGreaterEqual(len(tries), 3)
        self.assertIsNot(agent.engagement, None)

    def test_robot_that_the_yard_does_not_have_is_said(self) -> None:
        """A device whose robot does not exist shows an error, and the other devices complete the task."""
        self.team.add_node("dog3", tables={"driver": {"kind": "sim", "options": {"robot": "ghost", "camera_fps": 0.0}}})
        self.team.clock.advance(2.0)
        self.assertIn("has no robot: no robot is named 'ghost'", self.lines("dog3")[-1])
        self.submit(waiting_period=2.0)
        self.team.clock.advance(12.0)
        self.assertEqual(self.team.state()["tasks"][0]["status"], "COMPLETED")
        self.assertNotEqual(self.team.state()["tasks"][0]["result"]["by"], "dog3")

    def test_stopped_agent_stands_still(self) -> None:
        """When an agent stops, it stops its moving robot."""
        self.submit()
        self.team.clock.advance(1.0)
        moving = [dog.name for dog in self.team.simulator.world.dogs.values() if dog.is_moving]
        self.assertEqual(len(moving), 1)
        stopped = self.agent_of(moving[0]).stopService()
        self.team.clock.advance(0.3)
        self.assertFalse(self.team.simulator.world.dogs[moving[0]].is_moving)
        self.successResultOf(stopped)
