"""Tests of ``webnode.faults`` and its routes: injected faults and the takeover time."""

from __future__ import annotations

import logging
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from middleware.faults.kinds import KINDS
from swarmnode.simulated_team import SimulatedTeam
from tests.webnode.memory import MemoryFaults, MemoryTeamControl
from webnode.app import create_app
from webnode.auth import OpenSessions
from webnode.errors import Refusal
from webnode.event_log import EventLog
from webnode.faults import SHOWN_S, FaultControl
from webnode.services import Services
from webnode.state import format_state


class FaultControlTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.team = SimulatedTeam(4, faults=True)
        self.addCleanup(self.team.stop)
        self.node = self.team.services["vaio"].assembly.node
        self.control = FaultControl(self.node, self.team.clock.seconds)
        self.team.clock.advance(2.0)

    def uuid(self, name: str) -> str:
        """Return the uuid of a device."""
        return self.team.services[name].assembly.node.uuid

    def cause(self, uuid: str, kind: str, seconds: float = 4.0, amount: float | None = None) -> Any:
        """Request a fault and wait two seconds; return the refusal, or None."""
        came: list[Any] = []
        self.control.inject(uuid, kind, seconds, amount).addCallbacks(came.append, lambda f: came.append(f.value))
        for _ in range(40):
            if came:
                break
            self.team.clock.advance(0.05)
        return came[0]

    def acting(self) -> str:
        """Return the uuid of the acting device."""
        for _ in range(200):
            self.team.clock.advance(0.05)
            for device in self.team.state()["devices"]:
                if device["status"] == "EXECUTING":
                    return str(device["uuid"])
        self.fail("nobody ever acted")

    def test_learn_what_can_fail(self) -> None:
        """The possible faults of each device are listed; an unknown device has none."""
        self.assertEqual(list(self.control.get_kinds(self.uuid("dog1"))), list(KINDS))
        self.assertNotIn("battery", self.control.get_kinds(self.uuid("vaio")))
        self.assertEqual(list(self.control.get_kinds("00" * 20)), [])
        self.assertIsNone(self.cause(self.uuid("dog1"), "kill"))
        self.team.clock.advance(5.0)
        self.assertEqual(list(self.control.get_kinds(self.uuid("dog1"))), list(KINDS))
        self.assertEqual(self.cause(self.uuid("dog1"), "loss").problem, "the device has left the network")
        self.team.clock.advance(20.0)
        self.assertIsNone(self.cause(self.uuid("dog1"), "loss"))

    def test_takeover_clock(self) -> None:
        """After a fault in the acting device the takeover time stops below two seconds; the successor is listed."""
        self.team.control.assign("turn-around")
        lost = self.acting()
        self.assertIsNone(self.cause(lost, "radio"))
        self.team.clock.advance(0.6)
        (row,) = self.control.list_active()
        self.assertEqual((row["uuid"], row["kind"], row["takeover_s"], row["watched"]), (lost, "radio", None, True))
        self.team.clock.advance(2.0)
        (row,) = self.control.list_active()
        self.assertLess(float(str(row["takeover_s"])), 2.0)
        self.assertIn(row["to"], {"dog1", "dog2", "dog3"} - {row["name"]})
        self.assertTrue(0.0 < float(str(row["left_s"])) < 2.0)
        self.team.clock.advance(4.0 + SHOWN_S)
        self.assertEqual(self.control.list_active(), [])

    def test_idle_device(self) -> None:
        """A fault in an idle device has no takeover time."""
        self.assertIsNone(self.cause(self.uuid("dog2"), "loss", 4.0, 0.3))
        (row,) = self.control.list_active()
        self.assertEqual((row["task"], row["watched"], row["amount"]), ("", False, 0.3))

    def test_refuse(self) -> None:
        """Invalid amounts give status 400, impossible faults and lost devices 409, a silent device 504."""
        dog = self.uuid("dog3")
        for uuid, kind, amount, status, field in (
            (dog, "loss", 7.0, 400, "amount"),
            (dog, "radio", 0.5, 400, "amount"),
            (self.uuid("vaio"), "battery", None, 409, "kind"),
            ("00" * 20, "loss", None, 409, "device"),
        ):
            refusal = self.cause(uuid, kind, 4.0, amount)
            assert isinstance(refusal, Refusal), kind
            self.assertEqual((refusal.status, refusal.field), (status, field))
        self.team.block_datagrams("dog3")
        refusal = self.cause(dog, "loss")
        self.assertEqual((refusal.status, refusal.problem), (504, "dog3 does not answer"))
        self.assertEqual(self.control.list_active(), [])

    def test_only_where_allowed(self) -> None:
        """For a device that does not allow faults, the error contains the setting that allows them."""
        plain = SimulatedTeam(4, dogs=("dog1",))
        self.addCleanup(plain.stop)
        control = FaultControl(plain.services["vaio"].assembly.node, plain.clock.seconds)
        plain.clock.advance(2.0)
        dog = plain.services["dog1"].assembly.node.uuid
        self.assertEqual(list(control.get_kinds(dog)), [])
        refusal = self.failureResultOf(control.inject(dog, "kill", 4.0, None), Refusal).value
        self.assertIn("allow = true", refusal.remedy)


class RouteTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.faults: MemoryFaults | None = MemoryFaults("kill", "loss")
        self.event_log = EventLog()
        self.open(self.faults)

    def open(self, faults: MemoryFaults | None) -> None:
        """Serve the page for a dog that allows these faults."""
        state = format_state([{"uuid": "01", "name": "dog1", "joined": 1}], [], {}, node="vaio")
        services = Services(MemoryTeamControl(), OpenSessions(), event_log=self.event_log, faults=faults)
        app = create_app(lambda: state, services, wall=lambda: 1e9)
        app.logger.setLevel(logging.CRITICAL + 1)
        self.client = app.test_client()

    def test_cause_and_tell(self) -> None:
        """A fault is accepted with status 202, added to the event log, and listed together with the possible faults."""
        answer = self.client.post("/api/v1/devices/01/faults", json={"kind": "loss", "amount": 0.3})
        self.assertEqual((answer.status_code, answer.get_json()), (202, {"id": "01", "kind": "loss", "seconds": 15.0}))
        assert self.faults is not None
        self.assertEqual(self.faults.injected, [("01", "loss", 15.0, 0.3)])
        self.assertEqual([(each.uuid, each.at) for each in self.event_log.list_since(0)], [("01", 1e9)])
        told = self.client.get("/api/v1/faults").get_json()
        self.assertEqual(told["can"], {"01": ["kill", "loss"]})
        self.assertEqual([kind["kind"] for kind in told["kinds"]], list(KINDS))
        self.assertEqual([row["kind"] for row in told["active"]], ["loss"])

    def test_refuse(self) -> None:
        """Invalid requests are rejected with the invalid field and have no effect."""
        for path, body, code, field in (
            ("01", {}, 400, "kind"),
            ("01", {"kind": "fly"}, 400, "kind"),
            ("01", {"kind": "loss", "seconds": 0}, 400, "seconds"),
            ("01", {"kind": "loss", "seconds": 601}, 400, "seconds"),
            ("01", {"kind": "loss", "amount": "much"}, 400, "amount"),
            ("02", {"kind": "loss"}, 404, "device"),
        ):
            answer = self.client.post(f"/api/v1/devices/{path}/faults", json=body)
            self.assertEqual((answer.status_code, answer.get_json()["error"]["field"]), (code, field), body)
        assert self.faults is not None
        self.assertEqual(self.faults.injected, [])

    def test_node_without_faults(self) -> None:
        """A node without fault injection lists no faults; its error contains the setting that enables them."""
        self.open(None)
        self.assertEqual(self.client.get("/api/v1/faults").get_json(), {"kinds": [], "can": {}, "active": []})
        answer = self.client.post("/api/v1/devices/01/faults", json={"kind": "kill"})
        self.assertEqual(answer.status_code, 409)
        self.assertIn("allow = true", answer.get_json()["error"]["remedy"])
