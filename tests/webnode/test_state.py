"""Tests of ``webnode.state``."""

from __future__ import annotations

import json
import random
from dataclasses import asdict
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.decision_record import RecordedReport
from middleware.diagnostics.explanation import Difference, EpochExplanation, Explanation
from webnode.state import DepartedDevices, format_state, make_group_view


def device(number: int, **more: Any) -> dict[str, Any]:
    return {"uuid": f"{number:032x}", "name": f"dog{number}", "joined": number, "status": "IDLE", "since": 1.0, **more}


def member(number: int, cost: float | None, assigned: int | None) -> dict[str, Any]:
    named = "" if assigned is None else f"{assigned:032x}"
    return {"uuid": f"{number:032x}", "name": f"dog{number}", "status": "WAITING", "cost": cost, "assigned": named}


class StateTests(SynchronousTestCase):
    def test_order_by_joining(self) -> None:
        """Devices are listed in the order of joining, whatever the order of the records."""
        records = [device(1, joined=3), device(2, joined=1), device(3, joined=2), device(4, joined=2)]
        rng = random.Random(1)
        for _ in range(6):
            rng.shuffle(records)
            names = [view["name"] for view in format_state(records, [], {})["devices"]]
            self.assertEqual(names, ["dog2", "dog3", "dog4", "dog1"])

    def test_name_objective(self) -> None:
        """A device's objective is the title of its task, or the task's id if the task is unknown."""
        tasks = [{"id": "t1", "title": "Find it", "created": 5}]
        views = format_state([device(1, task="t1"), device(2, task="t9"), device(3)], tasks, {})["devices"]
        self.assertEqual([view["objective"] for view in views], ["Find it", "t9", ""])

    def test_tell_where_devices_are(self) -> None:
        """A position is in metres on the map or in degrees on the globe; any other value gives no position."""
        for said, told in (
            ({"x": 1, "y": -2.5, "heading": 0.5}, {"x": 1.0, "y": -2.5, "heading": 0.5}),
            ({"x": 1, "y": 2}, {"x": 1.0, "y": 2.0, "heading": None}),
            ({"lat": -90, "lon": 180, "accuracy": 0}, {"lat": -90.0, "lon": 180.0, "accuracy": 0.0}),
            ({"lat": 1, "lon": 2, "accuracy": -1}, {"lat": 1.0, "lon": 2.0, "accuracy": None}),
            *(({"x": x, "y": 1}, None) for x in ("1", None, float("nan"), float("inf"), 1e7, 10**400, True)),
            *((said, None) for said in ({}, None, [1, 2], {"y": 1}, {"lat": 91, "lon": 0}, {"lat": 0, "lon": 181})),
        ):
            (view,) = format_state([device(1, position=said)], [], {})["devices"]
            self.assertEqual(view["position"], told, said)

    def test_list_newest_task_first(self) -> None:
        """Tasks are listed newest first; a result contains the finishing device and the duration."""
        result = {"by": "dog2", "took": 41.5}
        tasks = [{"id": "a", "created": 1, "result": result, "status": "COMPLETED"}, {"id": "b", "created": 2}]
        views = format_state([], tasks, {})["tasks"]
        self.assertEqual([view["id"] for view in views], ["b", "a"])
        self.assertEqual(views[1]["result"], result)
        self.assertEqual([view["status"] for view in views], ["UNKNOWN", "COMPLETED"])

    def test_survive_unlawful_records(self) -> None:
        """Invalid records do not break the view, and do not reach the page."""
        bad: dict[str, Any] = {
            "uuid": "ab",
            "name": 7,
            "capabilities": [1],
            "network": {"sent": float("nan"), 3: 4},
            "messages": [["x"], 3, [float("inf"), "m"]],
            "roles": "edge",
            "joined": "1",
            "status": {},
            "since": None,
        }
        state = format_state(
            [bad, {}], [{"id": 5}, {"id": "t", "result": 3, "note": 1}], {"t": [{"cost": "near"}], "u": []}
        )
        json.dumps(state, allow_nan=False)
        self.assertEqual([view["name"] for view in state["devices"]], ["unnamed"])
        self.assertEqual(state["devices"][0]["messages"], [[0.0, "m"]])
        self.assertEqual([group["task"] for group in state["groups"]], ["t"])


class GroupTests(SynchronousTestCase):
    def test_agree(self) -> None:
        """If all members choose the same agent, that agent is assigned.

        Each cost is also given as a share of the highest cost.
        """
        view = make_group_view("t", "T", [member(3, 2.0, 2), member(1, 1.0, 2), member(2, 0.5, 2)])
        self.assertEqual((view["assigned"], view["agree"], view["of"]), ("dog2", 3, 3))
        self.assertEqual([each["share"] for each in view["members"]], [0.5, 0.25, 1.0])
        self.assertEqual((view["differ"], view["undecided"]), ([], []))

    def test_differ(self) -> None:
        """Members with a different choice, and undecided members, are listed.

        A member without a cost has no share of the highest cost.
        """
        view = make_group_view(
            "t", "T", [member(1, 1.0, 1), member(2, 0.5, 2), member(3, 0.7, 2), member(4, None, None)]
        )
        self.assertEqual((view["assigned"], view["agree"], view["of"]), ("dog2", 2, 4))
        self.assertEqual((view["differ"], view["undecided"]), (["dog1"], ["dog4"]))
        self.assertIsNone(view["members"][3]["share"])

    def test_decide_even_votes(self) -> None:
        """If the votes are equal, the lowest uuid is assigned, whatever the order of the members."""
        members = [member(1, 1.0, 2), member(2, 1.0, 1)]
        self.assertEqual(make_group_view("t", "T", members)["assigned"], "dog1")
        self.assertEqual(make_group_view("t", "T", members[::-1])["assigned"], "dog1")

    def test_be_undecided(self) -> None:
        """If no member has chosen an agent, no agent is assigned; zero costs cause no division by zero."""
        view = make_group_view("t", "T", [member(1, 0.0, None)])
        self.assertEqual((view["assigned"], view["agree"]), ("", 0))
        self.assertEqual(view["members"][0]["share"], 0.0)


class WhyTests(SynchronousTestCase):
    def test_rows_of_a_decision(self) -> None:
        """A decision has a row with a note for each reporting, silent or differing device."""
        reports = [RecordedReport("02" * 20, "dog2", 0.5), RecordedReport("01" * 20, "dog1", 1.5)]
        differ = (Difference("dog1", "names dog1"), Difference("dog4", "names dog1"))
        head = (2, "02" * 20, "dog2", ("dog2", "dog3"), 4, differ, "nearest", "1", "nobody acted before")
        ruling = EpochExplanation(*head, ("dog1",), "1a2b", 3, 2, tuple(reports), ("dog3",))
        (view,) = format_state([], [{"id": "t", "why": asdict(Explanation("t", (ruling,)))}], {})["tasks"]
        (why,) = view["why"]
        self.assertEqual((why["chosen"], why["agree"], why["of"], why["rule"]), ("dog2", 2, 4, "nearest 1"))
        self.assertEqual(
            [(row["name"], row["cost"], row["note"]) for row in why["rows"]],
            [
                ("dog2", 0.5, "goes"),
                ("dog1", 1.5, "differs: names dog1"),
                ("dog3", None, ""),
                ("dog4", None, "differs: names dog1"),
            ],
        )
        self.assertEqual(why["differ"], ["dog1", "dog4"])
        json.dumps(view, allow_nan=False)
        self.assertEqual(format_state([], [{"id": "t", "why": 7}], {})["tasks"][0]["why"], [])


class DepartedDevicesTests(SynchronousTestCase):
    def test_remember_for_a_minute(self) -> None:
        """A device that left is listed as gone, at its position in the list, for sixty seconds."""
        departed = DepartedDevices()
        both = [device(1), device(2, status="EXECUTING")]
        departed.update(both, 100.0)
        state = format_state(both[1:], [], {}, departed=departed.update(both[1:], 101.0))
        self.assertEqual([(v["name"], v["status"], v["gone"]) for v in state["devices"]][0], ("dog1", "GONE", 101.0))
        self.assertEqual([v["gone"] for v in departed.update(both[1:], 160.9)], [101.0])
        self.assertEqual(departed.update(both[1:], 161.0), [])

    def test_forget_when_back(self) -> None:
        """A device that returns is listed as present immediately; a second loss gets a new time of loss."""
        departed = DepartedDevices()
        departed.update([device(1)], 1.0)
        self.assertEqual(len(departed.update([], 2.0)), 1)
        self.assertEqual(departed.update([device(1)], 3.0), [])
        self.assertEqual([v["gone"] for v in departed.update([], 4.0)], [4.0])
