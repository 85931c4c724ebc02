"""Tests of whole nodes: a team in virtual time on a switchboard."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred

from middleware.directory.presence import DEVICES, Device, parse_devices
from middleware.entangled.errors import NoAnswer, Refused
from middleware.entangled.network.switchboard import LinkConditions
from middleware.entangled.record import Record
from middleware.node import SwarmNode
from middleware.tasks.task import (
    COMPLETED,
    TASKS,
    Member,
    Result,
    Task,
    find_outcome,
    group_key,
    parse_member,
    parse_task,
)
from tests.fleet import FleetCase, SwarmTeam

TASK = Task("t1", "search", "Find it")
ROUGH = LinkConditions(delay_s=0.01, jitter_s=0.01, loss=0.3)


class SwarmNodeTests(FleetCase):
    def names(self, fleet: SwarmTeam, place: int = 0) -> list[tuple[str, int]]:
        """Return the names and numbers of the devices, as one node lists them."""
        records = self.done(fleet, fleet.nodes[place].entangled.get(DEVICES), 2.0)
        return [(device.name, device.joined) for device, _ in parse_devices(records)]

    def submitted(self, fleet: SwarmTeam, task: Task = TASK) -> Task:
        return self.done(fleet, Deferred.fromCoroutine(fleet.nodes[0].submit(task)), 5.0)

    def asked(self, fleet: SwarmTeam, method: str, *arguments: object) -> Deferred[Any]:
        to = fleet.nodes[0].entangled.contact
        return fleet.nodes[1].entangled.endpoint.ask(to, method, *arguments, changes=True)

    def test_order_of_joining(self) -> None:
        """Devices are numbered in the order of joining, and every node sees the same numbers."""
        fleet = self.swarm(4)
        expected = [(f"dog{n}", n + 1) for n in range(4)]
        for place in range(4):
            self.assertEqual(self.names(fleet, place), expected)

    def test_joining_at_the_same_moment(self) -> None:
        """Devices that join at the same time get different numbers, also under loss."""
        for n, seed, weather, seconds in (
            (21, 1, LinkConditions(0.005), 1.0),
            (5, 2, LinkConditions(0.005, 0.005), 20.0),
            (5, 3, ROUGH, 20.0),
            (3, 4, LinkConditions(delay_s=0.01, loss=0.5), 40.0),
        ):
            fleet = self.swarm(n, seed, weather, pause=0.0)
            fleet.run(seconds)
            places = [node.presence.device.joined for node in fleet.nodes]
            self.assertEqual(len({place for place in places if place > 0}), n, places)

    def test_place_is_kept(self) -> None:
        """A device that changes its presence keeps its number, and its messages reach all nodes."""
        fleet = self.swarm(2)
        fleet.nodes[1].presence.add_message(5.0, "hello")
        fleet.run(1.0)
        records = self.done(fleet, fleet.nodes[0].entangled.get(DEVICES), 1.0)
        device = parse_devices(records)[1][0]
        self.assertEqual((device.joined, device.messages, device.address), (2, ((5.0, "hello"),), "10.0.0.1:7001"))

    def test_vanish_and_leave(self) -> None:
        """A device disappears immediately if its node stops, and within its lease if its node fails."""
        fleet = self.swarm(4)
        told: list[list[Record]] = []
        fleet.nodes[0].watch_devices(told.append)
        fleet.run(1.0)
        fleet.nodes[3].stopService()
        fleet.run(0.05)
        self.assertEqual(len(told[-1]), 3)
        fleet.nodes[2].stop_silently()
        fleet.run(1.25)
        self.assertEqual(len(told[-1]), 2)

    def test_task_and_its_end(self) -> None:
        """All nodes see a task with its council; reports disappear with their nodes, but the result stays."""
        fleet = self.swarm(4)
        task = self.submitted(fleet)
        self.assertEqual(len(task.council), 3)
        seen: list[Task | None] = []
        fleet.nodes[3].watch_tasks(lambda records: seen.extend(map(parse_task, records)))
        group: list[list[Record]] = []
        fleet.nodes[3].watch_group("t1", group.append, keep=True)
        heard: list[tuple[list[str], Result | None]] = []
        places = [node.join_group(task, lambda *news: None) for node in fleet.nodes[1:3]]
        places.append(
            fleet.nodes[3].join_group(task, lambda members, end: heard.append(([m.name for m in members], end)))
        )
        for node, place in zip(fleet.nodes[1:3], places, strict=False):
            place.report(Member(node.uuid, node.presence.device.name, "WAITING", 1.0))
        fleet.run(1.0)
        self.assertEqual(seen, [task])
        self.assertEqual(
            [member.name for r in group[-1] if (member := parse_member(r))],
            ["dog1", "dog2"]
            if fleet.nodes[1].entangled.identity.public < fleet.nodes[2].entangled.identity.public
            else ["dog2", "dog1"],
        )
        self.assertEqual((sorted(heard[-1][0]), heard[-1][1]), (["dog1", "dog2"], None))
        places[0].withdraw()
        client = fleet.nodes[2].make_lease_client(task, lambda: None, 0)
        client.claim()
        fleet.run(2.0)
        proof = self.done(fleet, client.close_task(0), 1.0)
        client.release()
        self.done(fleet, places[1].conclude(Result(COMPLETED, "dog2", 3.0, 1), proof), 1.0)
        fleet.nodes[2].stop_silently()
        fleet.run(2.0)
        self.assertEqual(find_outcome(task, group[-1]), Result(COMPLETED, "dog2", 3.0, 1))
        self.assertEqual(heard[-1], ([], Result(COMPLETED, "dog2", 3.0, 1)))
        self.assertEqual(len(group[-1]), 1)
        self.assertEqual(fleet.nodes[3].store.get(group_key("t1")), group[-1])
        self.assertEqual(len(fleet.nodes[3].store.get(TASKS)), 1)

    def test_strange_tasks(self) -> None:
        """A claim for a task with an invalid TTL or council is rejected without an exception."""
        fleet = self.swarm(2)
        task = self.submitted(fleet)
        for strange in (replace(task, lease_ttl=999.0), replace(task, lease_ttl=1), replace(task, council=())):
            for node in fleet.nodes:
                client = node.make_lease_client(strange, lambda: None, 0)
                client.claim()
                fleet.run(0.3)
                client.release()
                fleet.run(1.0)
        self.assertEqual(self.flushLoggedErrors(), [])

    def test_claims_from_the_wire(self) -> None:
        """Lease requests with an invalid name, configuration, ballot, token, duration or council are rejected."""
        fleet = self.swarm(2)
        good = ["t", 1, 1, 1.0]
        wrong: list[tuple[int, Any]] = [(0, "t" * 65), (0, 5), (1, 0), (2, -1), (2, 2**62), (2, True)]
        wrong += [(3, 0.0), (3, 61.0), (3, "1")]
        for method, *question in (
            *(("lease.prepare", *good[:place], bad, *good[place + 1 :]) for place, bad in wrong),
            ("lease.prepare", "t", 1, 1, float("nan")),
            ("lease.propose", "t", 1, 1, 0, 1.0),
            ("lease.release", "t", -1, 0.0),
            ("lease.release", "t", 1, -0.1),
            ("lease.release", "t", 1, 61.0),
            ("lease.freed", "t", 0, float("nan")),
            ("lease.close", "t", 1, -1),
            ("lease.change", "t", 1, 1, [], 0, False),
            ("lease.change", "t", 1, 1, [[b"k", "h", 0]], 0, False),
            ("lease.change", "t", 1, 1, [], 0, 1),
            ("lease.install", "t", 2, [b"?"], 0, 0, 1.0),
            ("lease.install", "t", 2, [], 0, 0, 0.0),
        ):
            asked = self.asked(fleet, method, *question)
            fleet.run(0.1)
            self.failureResultOf(asked, Refused)

    def test_operator(self) -> None:
        """A message from an operator is delivered and shown.

        A device replies to a disconnect order and then executes it.
        """
        fleet = self.swarm(2)
        texts: list[str] = []
        gone: list[float] = []
        fleet.nodes[0].on_message(texts.append)
        fleet.nodes[0].on_disconnect(gone.append)
        self.assertEqual(self.done(fleet, self.asked(fleet, "device.message", "come"), 0.5), "delivered")
        self.assertEqual(texts, ["come"])
        self.assertEqual(fleet.nodes[0].presence.device.messages[-1][1], "operator: come")
        self.assertEqual(self.done(fleet, self.asked(fleet, "device.disconnect", 5), 0.5), "leaving")
        self.assertEqual(gone, [5.0])
        for method, bad in (
            ("device.message", ""),
            ("device.message", "x" * 201),
            ("device.disconnect", 0),
            ("device.disconnect", float("nan")),
            ("device.disconnect", 3601.0),
        ):
            asked = self.asked(fleet, method, bad)
            fleet.run(0.1)
            self.failureResultOf(asked, Refused)

    def test_stopped_before_the_wish(self) -> None:
        """A node that stops right after a disconnect order leaves no timer."""
        fleet = self.swarm(2)
        gone: list[float] = []
        fleet.nodes[0].on_disconnect(gone.append)
        self.asked(fleet, "device.disconnect", 5)
        fleet.nodes[0].presence.add_message(1.0, "late")
        fleet.run(0.02)
        fleet.nodes[0].stopService()
        fleet.run(1.0)
        self.assertEqual(gone, [])

    def test_contact_of(self) -> None:
        """``contact_of`` returns the announced address of a device, or None if this address is invalid."""
        fleet = self.swarm(1)
        node: SwarmNode = fleet.nodes[0]
        rows = {
            "10.0.0.1:7001": True,
            "": False,
            "x": False,
            ":7001": False,
            "h:0": False,
            "h:70000": False,
            "h:²": False,
        }
        for address, is_contact in rows.items():
            value = Device(node.uuid, "dog", address=address).pack()
            record = Record(DEVICES, "dog", node.entangled.identity.public, 1, "leased", 1.0, value, bytes(64))
            self.assertEqual(node.find_contact(record) is not None, is_contact, address)
        self.assertIsNone(node.find_contact(replace(record, value=b"?")))

    def test_too_much_to_say(self) -> None:
        """If the presence of a device does not fit into a record, an error is logged, and the node continues to run."""
        fleet = self.swarm(1)
        fleet.nodes[0].presence.change(capabilities={"arm": {"kind": "x" * 2000}})
        fleet.run(1.0)
        self.assertEqual(len(self.flushLoggedErrors()), 1)
        asked = fleet.nodes[0].record_result("t", Result(COMPLETED, "dog0"))
        asked.addErrback(lambda failure: failure.trap(NoAnswer))
