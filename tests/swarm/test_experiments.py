"""Tests of whole teams in memory: the experiments of the thesis, tasks, membership and faults."""

from __future__ import annotations

import math

from agents.catalogue import create_task
from drivers.link import MemoryLink
from middleware.tasks.task import Task
from sim.demo.experiment import REACHED_GAP_M
from sim.demo.trials import run_trial
from swarmnode.simulated_team import SimulatedTeam
from tests.swarm.case import LOOK_S, TeamCase


class ExperimentTests(TeamCase):
    def test_nearest_dog_reaches_the_target(self) -> None:
        """Experiment 1: all dogs find the target and agree on the nearest dog, which reaches the target."""
        for seed in (2, 3):
            outcome = run_trial(SimulatedTeam, 1, seed)
            self.assertEqual(outcome.broken, [], seed)
            self.assertTrue(outcome.held and outcome.found and outcome.agreed and outcome.right, seed)

    def test_another_dog_takes_over_within_two_seconds(self) -> None:
        """Experiment 2: the acting dog is killed, and another dog moves within 2 s and reaches the target.

        The lease of a killed dog remains valid for at least a second, so a faster takeover would mean that the lease
        was released or ignored.
        """
        for seed in (1, 2):
            outcome = run_trial(SimulatedTeam, 2, seed)
            self.assertEqual(outcome.broken, [], seed)
            assert outcome.takeover is not None
            self.assertGreater(outcome.takeover, 0.9, seed)
            self.assertLessEqual(outcome.takeover, 2.0, seed)
            self.assertNotEqual(outcome.by, outcome.killed)


class TaskTests(TeamCase):
    def test_task_that_nobody_can_do_stays_open_and_says_why(self) -> None:
        """A task with a requirement that no device meets stays open; its note lists the missing capabilities."""
        team = self.start_team()
        answer = team.control.assign("fetch-the-ball")
        team.clock.advance(5.0)
        task = self.task(team)
        self.assertEqual((answer["able"], task["status"]), ([], "OPEN"))
        for part in ("vaio has no base2d", "dog1 has no gripper", "dog2 has no gripper", "dog3 has no gripper"):
            self.assertIn(part, task["note"])
        self.assertEqual(set(self.statuses(team).values()), {"IDLE"})

    def test_device_is_done_or_idle_until_its_next_task(self) -> None:
        """After a task the dog that finished it is DONE and the other dogs are IDLE, until all join the next task."""
        team = self.start_team()
        team.control.assign("turn-around")
        shown: list[dict[str, str]] = []

        def is_done() -> bool:
            shown.append(self.statuses(team))
            return bool(self.task(team)["status"] == "COMPLETED")

        self.until(team, is_done)
        for _ in range(10):
            team.clock.advance(LOOK_S)
            shown.append(self.statuses(team))
        by = self.task(team)["result"]["by"]
        self.assertEqual({name for row in shown for name, status in row.items() if status == "DONE"}, {by})
        wanted = {name: "DONE" if name == by else "IDLE" for name in self.statuses(team)}
        for _ in range(100):
            self.assertEqual(self.statuses(team), wanted)
            team.clock.advance(LOOK_S)
        team.control.assign("turn-around")
        self.until(team, lambda: self.statuses(team)[by] not in ("DONE", "IDLE"), 3.0)
        self.until(team, lambda: self.task(team)["status"] == "COMPLETED")

    def test_tasks_are_done_one_after_the_other(self) -> None:
        """A task that arrives while a dog is busy is executed afterwards."""
        team = self.start_team()
        team.control.assign("turn-around")
        team.clock.advance(0.2)
        team.control.assign("turn-around")
        self.until(team, lambda: [t["status"] for t in team.state()["tasks"]] == ["COMPLETED", "COMPLETED"])

    def test_urgent_task_has_the_bodies_first(self) -> None:
        """A task of higher priority preempts a preemptible task, which is resumed and completed afterwards."""
        team = self.start_team()
        turn = Task("slow", "turn-around", "Slow", parameters={"turns": 3.0}, waiting_period=1.0, preemptible=True)
        self.submit(team, turn)
        self.until(team, lambda: bool(self.executing(team)))
        team.clock.advance(2.0)
        urgent = Task("fast", "turn-around", "Fast", waiting_period=1.0, priority=5, created=1.0)
        self.submit(team, urgent)
        shown: list[dict[str, str]] = []

        def is_done(name: str) -> bool:
            rows = {row["id"]: row["status"] for row in team.state()["tasks"]}
            shown.append(rows)
            return rows.get(name) == "COMPLETED"

        self.until(team, lambda: is_done("fast"))
        self.assertNotIn("COMPLETED", [rows["slow"] for rows in shown])
        self.assertIn("ASSIGNED", [rows["slow"] for rows in shown])
        self.until(team, lambda: is_done("slow"))

    def test_paused_task_rests_until_it_is_resumed(self) -> None:
        """While a task is paused, no dog moves and the page shows which operator paused it.

        After the resume it completes.
        """
        team = self.start_team()
        team.run_demo()
        self.until(team, lambda: bool(self.executing(team)))
        task_id = self.task(team)["id"]
        team.control.pause(task_id)
        team.clock.advance(1.0)
        self.assertEqual(self.moving(team), [])
        task = self.task(team)
        self.assertEqual((task["status"], task["paused"]), ("ASSIGNED", True))
        self.assertIn("paused by vaio", {*self.lines(team, "dog1")})
        team.clock.advance(5.0)
        self.assertEqual(self.task(team)["status"], "ASSIGNED")
        team.control.resume(task_id)
        self.until(team, lambda: self.task(team)["status"] == "COMPLETED")

    def test_deadline_fails_the_task_and_says_so(self) -> None:
        """A task that misses its deadline fails for all devices, and the page shows the reason."""
        team = self.start_team()
        task = Task("late", "find-target", "Late", created=team.clock.seconds(), deadline=4.0)
        self.submit(team, task)
        self.until(team, lambda: self.task(team)["status"] == "FAILED", 6.0)
        self.assertIn("past its deadline of 4 s", self.task(team)["note"])
        team.clock.advance(0.5)
        self.assertEqual(set(self.statuses(team).values()) - {"DONE"}, {"IDLE"})

    def test_cancel_stops_the_robot(self) -> None:
        """A cancelled task ends on all devices within half a second: no dog moves, and all are IDLE."""
        team = self.start_team()
        team.run_demo()
        self.until(team, lambda: bool(self.executing(team)))
        team.clock.advance(1.0)
        self.assertTrue(self.moving(team))
        team.control.cancel(self.task(team)["id"])
        team.clock.advance(0.5)
        self.assertEqual(self.moving(team), [])
        self.assertEqual(self.task(team)["status"], "CANCELLED")
        self.assertEqual(set(self.statuses(team).values()), {"IDLE"})

    def test_moved_target_is_reached(self) -> None:
        """If the target moves while a dog walks to it, the task completes only when a dog has reached the target."""
        team = self.start_team()
        team.run_demo()
        self.until(team, lambda: bool(self.executing(team)))
        team.clock.advance(1.0)
        old = team.simulator.world.target
        assert old is not None
        x, y = 3.0 - old.x, 2.4 - old.y
        dogs = team.simulator.world.dogs.values()
        if min(math.hypot(dog.x - x, dog.y - y) for dog in dogs) < 0.4:
            x, y = x, old.y
        team.simulator.world.place_target(x, y)
        self.until(team, lambda: self.task(team)["status"] == "COMPLETED")
        self.assertLessEqual(self.gap(team, self.task(team)["result"]["by"]), REACHED_GAP_M)


class MembershipTests(TeamCase):
    def test_task_assigned_to_one_dog_draws_in_those_that_come(self) -> None:
        """Two dogs that join later take part in a running task; all three dogs report, and agree on the same dog."""
        team = self.start_team(dogs=("dog1",))
        team.run_demo()
        team.clock.advance(1.0)
        self.assertEqual([m["name"] for m in team.state()["groups"][0]["members"]], ["dog1"])
        for name in ("dog2", "dog3"):
            team.add_node(name)
            team.clock.advance(1.0)
        names = [m["name"] for m in team.state()["groups"][0]["members"]]
        self.assertEqual(names, ["dog1", "dog2", "dog3"])

        def all_agree() -> bool:
            group = team.state()["groups"][0]
            return bool(group["assigned"]) and group["agree"] == group["of"] == 3

        self.until(team, all_agree)
        self.until(team, lambda: self.task(team)["status"] == "COMPLETED")

    def test_others_spread_when_one_leaves(self) -> None:
        """After a loss the waiting dog moves around the target, away from the acting dog, without a collision."""
        team = self.start_team(1)
        team.scatter(3)
        team.run_demo()
        self.until(team, lambda: bool(self.executing(team)))
        first = self.executing(team)[0]
        team.clock.advance(0.5)
        team.kill(first)
        rest = [name for name in team.DOGS if name != first]
        world, bumps = team.simulator.world, team.simulator.world.collisions
        target = world.target
        assert target is not None

        def seen_from_target() -> float:
            one, other = (math.atan2(world.dogs[n].y - target.y, world.dogs[n].x - target.x) for n in rest)
            return abs(math.remainder(one - other, math.tau))

        before = seen_from_target()
        posts: set[object] = set()

        def is_done() -> bool:
            posts.update(member["post"] for member in team.state()["groups"][0]["members"])
            return bool(self.task(team)["status"] == "COMPLETED")

        self.until(team, is_done)
        self.assertGreater(seen_from_target(), before + math.radians(15))
        self.assertEqual(world.collisions, bumps)
        self.assertTrue(posts - {None})
        self.assertNotEqual(self.task(team)["result"]["by"], first)

    def test_newcomer_takes_over_only_if_it_is_clearly_better(self) -> None:
        """A dog that joins during a task takes over only if it is much nearer to the target."""
        for place, takes_over in (((1.5, 0.75), True), ((2.8, 2.2), False)):
            team = self.start_team(6, dogs=("dog1",))
            world = team.simulator.world
            world.move_dog("dog2", 2.8, 0.2, 0.0)
            world.move_dog("dog1", 0.3, 0.3, 0.0)
            world.move_dog("dog3", *place, math.pi / 2)
            self.submit(team, create_task("find-red-target", "t", 0.0))
            world.place_target(1.5, 1.3)
            self.until(team, lambda team=team: self.executing(team) == ["dog1"])  # type: ignore[misc]
            team.add_node("dog3")
            self.until(team, lambda team=team: self.task(team)["status"] == "COMPLETED")  # type: ignore[misc]
            self.assertEqual(self.task(team)["result"]["by"], "dog3" if takes_over else "dog1")

    def test_dog_alone_finishes(self) -> None:
        """A single dog completes the task alone."""
        team = self.start_team(dogs=("dog2",))
        team.run_demo()
        self.until(team, lambda: self.task(team)["status"] == "COMPLETED")
        self.assertEqual(self.task(team)["result"]["by"], "dog2")
        self.assertLessEqual(self.gap(team, "dog2"), REACHED_GAP_M)

    def test_winner_that_died_is_still_named(self) -> None:
        """While the decision still assigns a dead dog, the page shows the dog's name, not its id."""
        team = self.start_team()
        team.run_demo()
        self.until(team, lambda: bool(self.executing(team)))
        first = self.executing(team)[0]
        team.clock.advance(0.5)
        team.kill(first)
        shown = set()
        for _ in range(200):
            team.clock.advance(0.01)
            shown.add(team.state()["groups"][0]["assigned"])
        self.assertTrue(shown <= set(team.DOGS), shown)

    def test_killed_dog_says_nothing_more(self) -> None:
        """A killed node sends no further datagram, not even the release of its lease; its robot stops."""
        team = self.start_team()
        team.run_demo()
        self.until(team, lambda: bool(self.executing(team)))
        first = self.executing(team)[0]
        team.clock.advance(0.5)
        counters = team.switchboard.counters
        before = counters["sent"], counters["unsent"]
        team.kill(first)
        self.assertEqual((counters["sent"], counters["unsent"]), before)
        team.clock.advance(0.5)
        self.assertFalse(team.simulator.world.dogs[first].is_moving)

    def test_disconnected_dog_comes_back(self) -> None:
        """A dog that leaves for 5 s is GONE, and a different dog does its task; the dog returns as the same device."""
        team = self.start_team()
        team.run_demo()
        self.until(team, lambda: bool(self.executing(team)))
        first = self.executing(team)[0]
        before = self.device(team, first)
        team.control.disconnect(before["uuid"], 5.0)
        self.until(team, lambda: self.device(team, first)["status"] == "GONE", 2.0)
        self.assertFalse(team.simulator.world.dogs[first].is_moving)
        self.until(team, lambda: self.executing(team) not in ([], [first]), 3.0)
        self.until(team, lambda: self.device(team, first)["status"] not in ("GONE", "absent"), 6.0)
        after = self.device(team, first)
        self.assertEqual(after["uuid"], before["uuid"])
        self.until(team, lambda: self.task(team)["status"] == "COMPLETED")

    def test_at_no_time_do_two_dogs_walk_to_the_target(self) -> None:
        """While a dog is lost and returns, at most one dog holds a lease at any time."""
        team = self.start_team(4)
        team.run_demo()
        killed = ""
        while self.task(team)["status"] not in ("COMPLETED", "FAILED"):
            self.assertLess(team.clock.seconds(), 120.0)
            team.clock.advance(0.02)
            leases = []
            for name, service in team.services.items():
                engagement = getattr(service.assembly.agent, "engagement", None)
                if (
                    engagement is not None
                    and engagement.lease_client is not None
                    and engagement.lease_client.lease is not None
                ):
                    leases.append(name)
            self.assertLessEqual(len(leases), 1, leases)
            if leases and not killed and team.clock.seconds() > 8.0:
                killed = leases[0]
                team.services[killed].leave_for(4.0)
        self.assertTrue(killed)


class LinkConditionTests(TeamCase):
    def test_loss_of_a_fifth_still_completes(self) -> None:
        """With 20 % packet loss the team finds the target, and one dog reaches it."""
        team = self.start_team(2, loss=0.2)
        team.run_demo()
        self.until(team, lambda: self.task(team)["status"] == "COMPLETED")
        self.assertGreater(team.switchboard.counters["lost"], 100)
        self.assertLessEqual(self.gap(team, self.task(team)["result"]["by"]), REACHED_GAP_M)

    def test_garbage_on_a_robots_link_costs_frames_only(self) -> None:
        """Invalid bytes on the link from a robot are counted and skipped, and the task is completed."""
        team = self.start_team()
        driver = team.services["dog1"].assembly.driver
        assert driver is not None
        connector = team.connectors["dog1"]
        link = next(one for one in connector.links if isinstance(one, MemoryLink))
        garbage = [bytes([n % 256]) * 37 for n in range(0, 256, 5)] + [b"\xff" * 400, b"\x00" * 400]
        team.run_demo()
        for piece in garbage:
            assert link.receiver is not None
            link.receiver.data_received(piece)
            team.clock.advance(0.1)
        self.assertGreater(driver.diagnostics()["bad_frames"], 0)
        self.assertEqual(driver.state, "ready")
        self.until(team, lambda: self.task(team)["status"] == "COMPLETED")

    def test_broken_link_of_the_dog_on_its_way_moves_another(self) -> None:
        """If the acting node loses the link to its robot, a different dog takes over the task."""
        team = self.start_team()
        team.run_demo()
        self.until(team, lambda: bool(self.executing(team)))
        first = self.executing(team)[0]
        connector = team.connectors[first]
        connector.is_open = False
        connector.cut()
        self.until(team, lambda: self.executing(team) not in ([], [first]), 20.0)
        self.until(team, lambda: self.task(team)["status"] == "COMPLETED")
        self.assertNotEqual(self.task(team)["result"]["by"], first)
