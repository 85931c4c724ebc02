"""Tests of the group of a task whose agents also send bids to the council."""

from __future__ import annotations

from dataclasses import replace

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.bidding.group import Group, OnMembers, TaskMembers
from middleware.consensus.report_view import ReportView
from middleware.consensus.strategy import Report
from middleware.tasks.task import Member, Result, Task
from tests.fleet import FleetCase, SwarmTeam


def member(uuid: str, cost: float | None) -> Member:
    """Return a participant's record."""
    return Member(uuid, uuid, "WAITING", cost)


def costs(members: list[Member]) -> dict[str, float | None]:
    """Return the cost of each participant's bid."""
    return {m.uuid: m.cost for m in members}


class TaskMembersTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.task_members = TaskMembers()
        self.task_members.update_present([member("a", 3.0), member("b", None)])

    def test_announced_bids_count(self) -> None:
        """A bid that is announced after the agent's record counts; an agent that is not present has no bid."""
        self.task_members.update_announced([Report("b", 1.0), Report("c", 0.5)])
        self.assertEqual(costs(self.task_members.list_members()), {"a": 3.0, "b": 1.0})

    def test_later_record_counts(self) -> None:
        """A record that changes after the announcement overrides the announced bid, also by withdrawing it."""
        self.task_members.update_announced([Report("a", 2.0), Report("b", 1.0)])
        self.task_members.update_present([member("a", None), member("b", None)])
        self.assertEqual(costs(self.task_members.list_members()), {"a": None, "b": 1.0})

    def test_announced_bids_tell_all_that_is_read(self) -> None:
        """All fields of an announced bid that the strategy reads are used.

        A record that changes later overrides them.
        """
        task_members = TaskMembers(ReportView(("choice", "weight")))
        task_members.update_present([member("a", 3.0), member("b", 2.0)])
        task_members.update_announced(
            [Report("a", 3.0, choice="red", weight=2.0, battery=0.1), Report("b", 2.0, weight=-1.0)]
        )
        told = {m.uuid: (m.choice, m.weight, m.battery) for m in task_members.list_members()}
        self.assertEqual(told, {"a": ("red", 2.0, 1.0), "b": ("", 1.0, 1.0)})
        task_members.update_present([replace(member("a", 3.0), choice="blue"), member("b", 2.0)])
        self.assertEqual(task_members.list_members()[0].choice, "blue")

    def test_who_left_bids_nothing(self) -> None:
        """The announced bid of an agent is dropped when the agent leaves, and does not count when the agent returns."""
        self.task_members.update_announced([Report("b", 1.0)])
        self.task_members.update_present([member("a", 3.0)])
        self.task_members.update_present([member("a", 3.0), member("b", None)])
        self.assertEqual(costs(self.task_members.list_members()), {"a": 3.0, "b": None})
        self.task_members.update_present([member("a", 3.0)])
        self.task_members.update_announced([Report("b", 1.0)])
        self.assertEqual(self.task_members.list_awaited(), [])

    def test_announced_before_the_record(self) -> None:
        """If a bid is announced before the agent's record arrives, the bid counts as soon as the record has arrived.

        A later change of the record overrides the bid.
        """
        self.task_members.update_announced([Report("c", 0.5)])
        self.assertEqual(self.task_members.list_awaited(), [Report("c", 0.5)])
        here = [member("a", 3.0), member("b", None)]
        self.task_members.update_present([*here, member("c", None)])
        self.assertEqual((costs(self.task_members.list_members())["c"], self.task_members.list_awaited()), (0.5, []))
        self.task_members.update_present([*here, member("c", 0.7)])
        self.assertEqual(costs(self.task_members.list_members())["c"], 0.7)

    def test_newest_announcement_alone_awaits(self) -> None:
        """An agent that the newest announcement omits is not awaited; its later record counts."""
        self.task_members.update_announced([Report("c", 0.5), Report("d", 0.6)])
        self.task_members.update_present([member("a", 3.0), member("d", None)])
        self.task_members.update_announced([Report("a", 2.0)])
        self.assertEqual(self.task_members.list_awaited(), [])
        self.assertEqual(costs(self.task_members.list_members()), {"a": 2.0, "d": None})


class GroupTests(FleetCase):
    """Tests of a ``Group`` that also bids."""

    def setUp(self) -> None:
        super().setUp()
        self.heard: dict[int, list[dict[str, float | None]]] = {place: [] for place in range(3)}

    def groups(self, fleet: SwarmTeam) -> list[Group]:
        """Return the groups of the first three nodes, for a new task."""
        task = Task("job", "find", "Find it", waiting_period=0.5)
        task = self.done(fleet, Deferred.fromCoroutine(fleet.nodes[0].submit(task)))
        self.assertEqual(len(task.council), 3)
        groups = [fleet.nodes[place].join_group(task, self.hearing(place)) for place in range(3)]
        for place, group in enumerate(groups):
            group.report(member(fleet.nodes[place].uuid, None))
        fleet.run(1.0)
        return groups

    def hearing(self, place: int) -> OnMembers:
        """Return a callback that stores the members that are reported to the node with index ``place``."""

        def heard(members: list[Member], outcome: Result | None) -> None:
            self.heard[place].append(costs(members))

        return heard

    def test_bids_come_by_the_council(self) -> None:
        """A bid that the council announces counts even without a record of the agent."""
        fleet = self.swarm(4)
        groups = self.groups(fleet)
        uuid = fleet.nodes[1].uuid
        bidding = groups[1]._bidding
        assert bidding is not None
        bidding.report(Report(uuid, 2.5))
        fleet.run(1.0)
        self.assertEqual([self.heard[place][-1][uuid] for place in range(3)], [2.5, 2.5, 2.5])

    def test_records_and_bids_agree(self) -> None:
        """A report is written as a record and sent as a bid; withdrawing the report removes both."""
        fleet = self.swarm(4)
        groups = self.groups(fleet)
        uuids = [fleet.nodes[place].uuid for place in range(3)]
        for place, group in enumerate(groups):
            group.report(member(uuids[place], 1.0 + place))
        fleet.run(2.0)
        groups[0].report(member(uuids[0], None))
        fleet.run(2.0)
        for place in range(3):
            self.assertEqual(self.heard[place][-1], {uuids[0]: None, uuids[1]: 2.0, uuids[2]: 3.0})

    def test_who_leaves_is_not_heard_of(self) -> None:
        """When a member leaves, the other members remove it, and it gets no further reports."""
        fleet = self.swarm(4)
        groups = self.groups(fleet)
        for place, group in enumerate(groups):
            group.report(member(fleet.nodes[place].uuid, 1.0 + place))
        fleet.run(2.0)
        groups[0].leave()
        groups[0].withdraw()
        before = len(self.heard[0])
        fleet.run(2.0)
        self.assertEqual(len(self.heard[0]), before)
        self.assertNotIn(fleet.nodes[0].uuid, self.heard[1][-1])
