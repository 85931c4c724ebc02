"""Tests of ``webnode.routes.metrics``: metrics for Prometheus."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from tests.webnode.guests import Guests
from tests.webnode.memory import MemoryTeamControl
from webnode.app import create_app
from webnode.auth import User
from webnode.limits import AddressLimits
from webnode.services import Services
from webnode.state import format_state

DOG = {"uuid": "01", "name": 'do"g\n1', "joined": 1, "since": 5.0, "network": {"contacts": 3, "sent": 7}}


class MetricsTests(SynchronousTestCase):
    if find_spec("prometheus_client") is None:
        skip = "THE METRICS ARE NOT TESTED: missing prometheus-client (pip install -e '.[web]')"

    def setUp(self) -> None:
        self.limits = AddressLimits()
        self.services = Services(MemoryTeamControl(), Guests(), limits=self.limits)
        tasks = [{"id": "t1", "title": "Find", "created": 1.0, "status": "EXECUTING"}]
        state = format_state(
            [{**DOG, "status": "IDLE"}], tasks, {"t1": [{"uuid": "01", "name": "x", "cost": 1.0}]}, node="v"
        )
        self.client = create_app(lambda: state, self.services, wall=lambda: 9.5).test_client()

    def read(self) -> Any:
        answer = self.client.get("/metrics", headers={"Authorization": "Bearer viewer"})
        self.assertEqual((answer.status_code, answer.content_type), (200, "text/plain; version=0.0.4; charset=utf-8"))
        from prometheus_client.parser import text_string_to_metric_families

        families = text_string_to_metric_families(answer.get_data(as_text=True))
        return {
            (each.name, tuple(v for _, v in sorted(each.labels.items()))): each.value
            for family in families
            for each in family.samples
        }

    def test_tell_the_team(self) -> None:
        """The export contains the numbers of devices and tasks by status, the network counters, and the groups.

        A device name may contain any characters.
        """
        told = self.read()
        self.assertEqual(told["swarm_devices", ("IDLE",)], 1)
        self.assertEqual(told["swarm_tasks", ("EXECUTING",)], 1)
        name = 'do"g 1'
        self.assertEqual(told["swarm_device_contacts", (name, "01")], 3)
        self.assertEqual(told["swarm_device_datagrams_total", (name, "sent", "01")], 7)
        self.assertNotIn(("swarm_device_datagrams_total", (name, "dropped", "01")), told)
        self.assertEqual(told["swarm_group_members", ("t1",)], 1)
        self.assertEqual(told["swarm_page_time_seconds", ()], 9.5)

    def test_tell_the_page(self) -> None:
        """Connections are counted by kind, and requests by role and status.

        Requests for the metrics themselves are not counted.
        """
        self.limits.count("stream", "10.0.0.1", 2)
        self.services.audit.write(User("ann", "operator"), "h", "POST /x", "", "409 it left")
        told = self.read()
        self.assertEqual(told["swarm_page_connections", ("stream",)], 2)
        self.assertEqual(told["swarm_page_orders_total", ("operator", "409")], 1)
        self.assertEqual(self.read(), told)

    def test_tell_of_a_missing_library(self) -> None:
        """If the library is not installed, the response contains the command that installs it."""
        hidden = {
            name: sys.modules.pop(name) for name in list(sys.modules) if name.split(".")[0] == "prometheus_client"
        }
        sys.modules["prometheus_client"] = None  # type: ignore[assignment]
        self.addCleanup(sys.modules.update, hidden)
        self.addCleanup(sys.modules.pop, "prometheus_client")
        answer = self.client.get("/metrics?ticket=viewer")
        self.assertEqual(answer.status_code, 404)
        self.assertIn("swarm-node[web]", answer.get_json()["error"]["remedy"])
