"""Tests of ``webnode.event_log``."""

from __future__ import annotations

from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from tests.webnode.guests import Guests
from tests.webnode.memory import MemoryTeamControl
from webnode.app import create_app
from webnode.event_log import EventLog
from webnode.services import Services
from webnode.state import DepartedDevices, State, format_state


def uuid(number: int) -> str:
    return f"{number:032x}"


def dog(number: int, status: str = "IDLE", task: str = "", **more: Any) -> dict[str, Any]:
    return {"uuid": uuid(number), "name": f"dog{number}", "joined": number, "status": status, "task": task, **more}


def job(status: str, **more: Any) -> dict[str, Any]:
    return {"id": "t1", "title": "Find it", "created": 1.0, "status": status, **more}


class EventLogTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.event_log = EventLog()
        self.departed = DepartedDevices()
        self.heard = 0

    def saw(self, now: float, *devices: dict[str, Any], tasks: Any = (), groups: Any = None, **more: Any) -> list[str]:
        """Record the state of a team of these devices, with ``more`` merged into the state; return the new entries."""
        gone = self.departed.update(devices, now)
        state: State = {**format_state(devices, tasks, groups or {}, departed=gone, node="vaio"), **more}
        self.event_log.record_state(state, now)
        return self.told()

    def told(self) -> list[str]:
        entries = self.event_log.list_since(self.heard)
        self.heard = entries[-1].n if entries else self.heard
        return [entry.text for entry in entries]

    def test_begin_with_who_is_here(self) -> None:
        """The event log begins with its start and the present devices; an unchanged state adds nothing."""
        self.assertEqual(
            self.saw(1.0, dog(1), dog(2)),
            ["vaio starts to observe", "dog1 is here, number 1: idle", "dog2 is here, number 2: idle"],
        )
        self.assertEqual(self.saw(2.0, dog(1), dog(2)), [])

    def test_tell_of_devices(self) -> None:
        """Each status change, message, loss and return of a device is logged once."""
        self.saw(1.0, dog(1, messages=[[0.5, "ready"]]))
        told = self.saw(2.0, dog(1, "SEARCHING", "t1", messages=[[0.5, "ready"], [1.5, "seen"]]))
        self.assertEqual(told, ["dog1: idle → searching", "dog1: seen"])
        self.assertEqual(self.saw(3.0), ["dog1 is gone"])
        self.assertEqual(self.saw(4.0), [])
        self.assertEqual(self.saw(5.0, dog(1)), ["dog1 is back: idle"])

    def test_tell_of_tasks(self) -> None:
        """A task is logged from its start to its end, with the finishing device and the duration."""
        self.saw(1.0)
        self.assertEqual(self.saw(2.0, tasks=[job("OPEN")]), ["Find it: open"])
        self.assertEqual(self.saw(3.0, tasks=[job("OPEN", paused=True)]), ["Find it: paused"])
        self.assertEqual(self.saw(3.5, tasks=[job("OPEN", note="no device is here")]), ["Find it: resumed"])
        self.assertEqual(self.saw(3.6, tasks=[job("OPEN", note="nobody can")]), ["Find it: nobody can"])
        done = job("COMPLETED", result={"by": "dog2", "took": 13.24})
        self.assertEqual(self.saw(4.0, tasks=[done]), ["Find it: open → completed by dog2 in 13.2 s"])
        self.assertEqual(self.event_log.list_since(0)[-1].seconds, 13.24)

    def test_tell_of_consensus(self) -> None:
        """An agreement of all members is logged once with the bids, but not before all members have decided."""
        first = {**dog(1), "cost": 1.04, "assigned": uuid(2)}
        second = {**dog(2), "cost": 0.62, "assigned": ""}
        self.saw(1.0)
        self.assertEqual(self.saw(2.0, groups={"t1": [first, second]}), [])
        agreed = {"t1": [first, {**second, "assigned": uuid(2)}]}
        self.assertEqual(self.saw(3.0, groups=agreed), ["2 of 2 agree on dog2 (dog1 1.04 m, dog2 0.62 m)"])
        self.assertEqual(self.saw(4.0, groups=agreed), [])

    def test_tell_of_no_consensus_on_what_is_over(self) -> None:
        """After the end of a task the remaining reports are not logged as an agreement."""
        bids = [{**dog(n), "cost": float(n), "assigned": uuid(1)} for n in (1, 2)]
        self.saw(1.0, tasks=[job("EXECUTING")])
        self.assertEqual(len(self.saw(2.0, tasks=[job("EXECUTING")], groups={"t1": bids})), 1)
        for status in ("COMPLETED", "FAILED", "CANCELLED"):
            told = self.saw(3.0, tasks=[job(status)], groups={"t1": bids[1:]})
            self.assertEqual([line for line in told if "agree" in line], [], status)

    def test_tell_of_halting(self) -> None:
        """The stop and the release of the whole team are logged."""
        self.saw(1.0)
        self.assertEqual(self.saw(2.0, halted=True), ["the team is halted"])
        self.assertEqual(self.saw(3.0, halted=False), ["the team is released"])

    def takeover(self) -> list[tuple[str, str, float | None]]:
        kinds = ("takeover", "handover")
        return [
            (entry.kind, entry.uuid, entry.seconds) for entry in self.event_log.list_since(0) if entry.kind in kinds
        ]

    def test_time_a_takeover(self) -> None:
        """A takeover lasts from the loss of the acting device until another device acts."""
        tasks = [job("EXECUTING")]
        self.saw(1.0, dog(1, "EXECUTING", "t1"), dog(2, "WAITING", "t1"), tasks=tasks)
        self.saw(10.0, dog(2, "WAITING", "t1"), tasks=tasks)
        self.saw(10.6, dog(2, "ASSIGNED", "t1"), tasks=tasks)
        told = self.saw(11.3, dog(2, "EXECUTING", "t1"), tasks=tasks)
        self.assertIn("dog2 takes over Find it from dog1: 1.3 s", told)
        self.assertEqual(self.takeover(), [("takeover", uuid(2), 1.3)])
        # The lost device returns and waits; that is not a takeover.
        self.saw(20.0, dog(1, "WAITING", "t1"), dog(2, "EXECUTING", "t1"), tasks=tasks)
        self.assertEqual(len(self.takeover()), 1)

    def test_time_a_takeover_from_the_fault(self) -> None:
        """After an injected fault the takeover time counts from the injection, not from the loss that follows."""
        tasks = [job("EXECUTING")]
        both = dog(1, "EXECUTING", "t1"), dog(2, "WAITING", "t1")
        self.saw(1.0, *both, tasks=tasks)
        self.event_log.record_fault(uuid(1), "radio", 9.0)
        self.assertEqual(self.told(), ["dog1: radio (injected fault)"])
        self.saw(10.0, both[1], tasks=tasks)
        self.saw(10.5, dog(2, "EXECUTING", "t1"), tasks=tasks)
        self.assertEqual(self.takeover(), [("takeover", uuid(2), 1.5)])

    def test_take_no_handover_for_a_takeover(self) -> None:
        """If the acting device changes without a loss, or long after a fault, a handover without a time is logged."""
        tasks = [job("EXECUTING")]
        self.saw(1.0, dog(1, "EXECUTING", "t1"), dog(2, "WAITING", "t1"), tasks=tasks)
        self.event_log.record_fault(uuid(1), "skew", 2.0)
        self.saw(70.0, dog(1, "EXECUTING", "t1"), dog(2, "WAITING", "t1"), tasks=tasks)
        self.saw(71.0, dog(1, "WAITING", "t1"), dog(2, "EXECUTING", "t1"), tasks=tasks)
        self.assertEqual(self.takeover(), [("handover", uuid(2), None)])
        # A second device that acts at the same time has replaced no device.
        self.saw(72.0, dog(1, "EXECUTING", "t1"), dog(2, "EXECUTING", "t1"), tasks=tasks)
        self.assertEqual(len(self.takeover()), 1)

    def test_forget_a_loss_that_mends(self) -> None:
        """If a lost device returns and continues, its loss is forgotten.

        If a different device acts later, a handover without a time is logged.
        """
        tasks = [job("EXECUTING")]
        self.saw(1.0, dog(1, "EXECUTING", "t1"), tasks=tasks)
        self.saw(2.0, tasks=tasks)
        self.saw(2.5, dog(1, "EXECUTING", "t1"), tasks=tasks)
        self.saw(9.0, dog(1, "IDLE"), dog(2, "EXECUTING", "t1"), tasks=tasks)
        self.assertEqual(self.takeover(), [("handover", uuid(2), None)])

    def test_keep_so_many(self) -> None:
        """Only the newest entries are kept; their numbers increase, and they can be filtered by device or task."""
        self.event_log = EventLog(max_entries=3)
        self.saw(1.0, dog(1), dog(2), tasks=[job("OPEN")])
        self.assertEqual([entry.n for entry in self.event_log.list_since(0)], [2, 3, 4])
        self.assertEqual([entry.n for entry in self.event_log.list_since(3)], [4])
        self.assertEqual([entry.n for entry in self.event_log.list_since(0, uuid(2))], [3])
        self.assertEqual([entry.n for entry in self.event_log.list_since(0, "t1")], [4])

    def test_ask_by_http(self) -> None:
        """A viewer reads all entries, entries after a number, or entries of one device.

        An invalid number is rejected.
        """
        self.saw(1.0, dog(1), dog(2))
        app = create_app(
            lambda: format_state([], [], {}), Services(MemoryTeamControl(), Guests(), event_log=self.event_log)
        )
        client = app.test_client()

        def asked(query: str) -> Any:
            return client.get(f"/api/v1/events?ticket=viewer{query}", headers={"Host": "localhost"}).get_json()

        self.assertEqual([entry["n"] for entry in asked("")], [1, 2, 3])
        self.assertEqual(asked("&after=2")[0]["text"], "dog2 is here, number 2: idle")
        self.assertEqual([entry["n"] for entry in asked(f"&about={uuid(1)}")], [2])
        self.assertEqual(asked("&after=x")["error"]["field"], "after")
