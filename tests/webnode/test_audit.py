"""Tests of ``webnode.audit``: the log of changes, in a file that survives restarts of the node."""

from __future__ import annotations

import json
import stat
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from tests.webnode.guests import Guests
from tests.webnode.memory import MemoryTeamControl
from webnode.app import create_app
from webnode.audit import MAX_LINES, QUIET_S, AuditLog
from webnode.auth import User
from webnode.services import Services
from webnode.state import format_state

ANN = User("ann", "operator", "ab12")
NOBODY = User()


class AuditTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.now = 1000.0
        self.path = Path(self.mktemp())

    def audit(self, max_bytes: int = 1 << 20) -> AuditLog:
        return AuditLog(self.path, lambda: self.now, max_bytes)

    def test_keep_each_line(self) -> None:
        """Each change is one line of JSON with time, user, address, route, target and outcome, in a private file."""
        self.audit().write(ANN, "10.0.0.9", "POST /x/{uuid}", "01\n\x1b[2J", "202")
        (line,) = self.path.read_text().splitlines()
        told = {"at": 1000.0, "who": "ann", "role": "operator", "from": "10.0.0.9", "session": "ab12"}
        self.assertEqual(
            json.loads(line), {**told, "route": "POST /x/{uuid}", "target": "01\n\x1b[2J", "outcome": "202"}
        )
        self.assertEqual(stat.S_IMODE(self.path.stat().st_mode), 0o600)

    def test_outlive_the_node(self) -> None:
        """After a restart earlier lines are returned, newest first; invalid lines are skipped."""
        first = self.audit()
        for number in range(3):
            first.write(ANN, "h", "POST /x", str(number), "202")
        with self.path.open("a") as file:
            file.write("no JSON\n[]\n")
        again = self.audit()
        again.write(ANN, "h", "POST /x", "3", "202")
        self.assertEqual([line["target"] for line in again.list_newest(3)], ["3", "2", "1"])
        self.assertEqual(again.get_counts(), {("operator", "202"): 1})

    def test_stay_within_its_room(self) -> None:
        """A full file is rotated: the two files together stay below twice the limit, and the newest lines remain."""
        audit = self.audit(2000)
        for number in range(200):
            audit.write(ANN, "h", "POST /x", str(number), "202")
        aside = self.path.with_name(f"{self.path.name}.1")
        self.assertLessEqual(self.path.stat().st_size, 2000)
        self.assertLessEqual(aside.stat().st_size, 2000)
        self.assertIn('"199"', self.path.read_text())
        self.assertEqual(len(audit.list_newest(1000)), MAX_LINES)

    def test_let_nobody_flood_it(self) -> None:
        """Repeated requests of an unknown user give one line per minute with a count; other lines remain."""
        audit = self.audit()
        audit.write(ANN, "h", "POST /x", "", "202")
        for _ in range(1000):
            audit.write(NOBODY, "10.0.0.9", "POST /api/v1/session", "", "429 too many")
        audit.write(NOBODY, "10.0.0.8", "POST /api/v1/session", "", "429 too many")
        self.now += QUIET_S
        audit.write(NOBODY, "10.0.0.9", "POST /api/v1/session", "", "429 too many")
        lines = audit.list_newest(99)
        self.assertEqual([line.get("repeated", 0) for line in lines], [999, 0, 0, 0])
        self.assertEqual(lines[-1]["who"], "ann")
        self.assertEqual(audit.get_counts()["anyone", "429"], 1002)

    def test_go_on_without_a_file(self) -> None:
        """Without a file, or if the file cannot be written, the newest lines are still available."""
        self.path = Path(self.mktemp()) / "missing" / "audit"
        audit = self.audit()
        for number in range(2):
            audit.write(ANN, "h", "POST /x", str(number), "202")
        self.assertEqual(len(audit.list_newest(9)), 2)
        in_memory = AuditLog()
        in_memory.write(ANN, "h", "POST /x", "", "202")
        self.assertEqual(len(in_memory.list_newest(9)), 1)


class AuditRouteTests(SynchronousTestCase):
    def test_tell_operators(self) -> None:
        """An operator can read the requested number of lines, newest first; a viewer cannot read any."""
        state = format_state([], [], {}, node="vaio")
        client = create_app(lambda: state, Services(MemoryTeamControl(), Guests())).test_client()
        bearer = {"Authorization": "Bearer operator"}
        for _ in range(3):
            client.post("/api/v1/demo", json={}, headers=bearer)
        told = client.get("/api/v1/audit?count=2", headers=bearer).get_json()
        self.assertEqual([line["route"] for line in told], ["POST /api/v1/demo"] * 2)
        self.assertEqual(
            (told[0]["who"], told[0]["session"], told[0]["outcome"]), ("operator", "id of operator", "202")
        )
        self.assertEqual(client.get("/api/v1/audit", headers={"Authorization": "Bearer viewer"}).status_code, 403)
        for count in ("0", "x", "1e9", "1.5"):
            self.assertEqual(client.get(f"/api/v1/audit?count={count}", headers=bearer).status_code, 400)
