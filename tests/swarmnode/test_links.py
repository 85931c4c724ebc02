"""Tests of ``swarm links``: the paths to a node's peers."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.diagnostics.node_diagnostics import ENDING_S, describe_links, describe_team
from middleware.entangled.control.link_quality import compute_quality
from middleware.entangled.errors import Refused
from swarmnode.links import main
from swarmnode.simulated_team import SimulatedTeam
from tests.swarmnode.shell import Shell, runtime_folder

FAR = {"id": "cd" * 20, "address": f"~{'cd' * 20}:1", "way": "carried", "by": "ef" * 20, "for": 150.0, "relayed": True}
NEAR = {"id": "ef" * 20, "address": "192.168.1.9:8484", "way": "lan", "by": "", "for": 7500.0, "relayed": False}


class LinksTests(SynchronousTestCase):
    """Tests of the command."""

    def setUp(self) -> None:
        runtime_folder(self, "vaio")
        self.links: Any = [{**NEAR, "times": [0.002] * 10}, {**FAR, "times": [0.08] * 9 + [None]}]

    def ask(self, path: Path, request: dict[str, Any]) -> Iterator[dict[str, Any]]:
        """Return the reply of the node, without records."""
        yield {"answer": self.links if request["verb"] == "links" else []}

    def run_it(self, *words: str) -> tuple[int, str]:
        """Run the command and return exit code and output."""
        out = io.StringIO()
        return main(words, out, self.ask), out.getvalue()

    def test_worst_first(self) -> None:
        """Each peer has a line with score, path, measurements and duration; the peer with the lowest score is first."""
        score = compute_quality([0.08] * 9 + [None], True).score
        self.assertLess(score, 100)
        code, printed = self.run_it()
        self.assertEqual(
            (code, printed.splitlines()),
            (
                0,
                [
                    f"cdcdcdcdcd  {score:3}/100  relayed by efefefefef  80.0 ms, jitter 0.0 ms, 10 % lost, for 2 min",
                    "efefefefef  100/100  LAN                    2.0 ms, jitter 0.0 ms, 0 % lost, for 2 h",
                ],
            ),
        )

    def test_silent_peer(self) -> None:
        """A peer that does not reply has the score 0, and the exit code is 1."""
        self.links = [{**NEAR, "way": "none", "for": None, "times": [None] * 10}]
        self.assertEqual(self.run_it(), (1, "efefefefef    0/100  no path yet  does not reply\n"))

    def test_no_peer(self) -> None:
        """If a node has no peers, the output suggests the next command."""
        self.links = []
        self.assertEqual(self.run_it(), (0, "this node has no peers; run swarm doctor to see why\n"))

    def test_json(self) -> None:
        """With --json the output is one line with the same values."""
        code, printed = self.run_it("--json")
        rows = json.loads(printed)["links"]
        self.assertEqual((code, [row["way"] for row in rows], rows[1]["score"]), (0, ["carried", "lan"], 100))
        self.assertEqual((rows[0]["loss"], rows[0]["by"], rows[0]["for"]), (0.1, "ef" * 20, 150.0))

    def test_real_node(self) -> None:
        """A running node lists its peers by their device names."""
        team = SimulatedTeam(3)
        self.addCleanup(team.stop)
        shell = Shell(team, team.services["vaio"].assembly.node)
        code, printed = shell.run(main, [])
        self.assertEqual((code, shell.said), (0, ""))
        for name in ("dog1", "dog2", "dog3"):
            self.assertRegex(printed, rf"(?m)^{name}\s+100/100  this machine  \d.* 0 % lost, for \d+ s$")


class TeamTests(SynchronousTestCase):
    """A node of a closed team reports the members and the refused nodes."""

    def setUp(self) -> None:
        self.team = SimulatedTeam(5, dogs=("dog1", "dog2"))
        self.addCleanup(self.team.stop)
        self.laptop = self.team.services["vaio"].assembly.node
        self.dog = self.team.services["dog1"].assembly.node

    def tell(self, statement: bytes) -> None:
        """Distribute a statement that is signed by the operator."""
        assert self.laptop.team is not None
        self.laptop.later(0.0, lambda: Deferred.fromCoroutine(self.laptop.team.publish(statement)))  # type: ignore[union-attr]
        self.team.clock.advance(3.0)

    def test_members(self) -> None:
        """The output contains the kind of the team, its public fingerprint, and its members with their roles."""
        told = describe_team(self.laptop)
        assert self.laptop.team is not None
        self.assertEqual((told["kind"], told["me"]), ("closed", self.laptop.uuid))
        self.assertEqual(bytes.fromhex(told["fingerprint"]), self.laptop.entangled.endpoint.admission.fingerprint)
        self.assertEqual([member["name"] for member in told["members"]], ["dog1", "dog2", "vaio"])
        self.assertEqual(told["members"][0]["uuid"], self.dog.uuid)
        self.assertFalse(told["is_ending"] or any(member["is_ending"] for member in told["members"]))
        self.assertTrue(told["is_renewable"] and all(member["is_renewable"] for member in told["members"]))

    def test_ending_certificate(self) -> None:
        """A certificate that expires within two weeks is listed first and marked."""
        dog = self.team.services["dog2"].assembly.node
        begin = int(self.team.clock.seconds()) + 1
        public = dog.entangled.identity.public
        self.tell(self.team.operator.grant(public, "dog2", ("device",), begin, int(ENDING_S) - 60))
        told = describe_team(self.laptop)
        found = [(member["name"], member["is_ending"]) for member in told["members"]]
        self.assertEqual(found, [("dog2", True), ("dog1", False), ("vaio", False)])
        self.assertEqual((told["is_ending"], describe_team(dog)["is_ending"]), (False, True))
        self.assertEqual([member["is_renewable"] for member in told["members"]], [False, True, True])

    def test_refusals(self) -> None:
        """The nodes that refuse a revoked node report the refusal with a remedy, and so does the revoked node."""
        self.tell(self.team.operator.revoke(self.dog.entangled.identity.public, "dog1", self.team.clock.seconds()))
        self.team.clock.advance(3.0)
        ours, theirs = describe_links(self.laptop)["refusals"], describe_links(self.dog)["refusals"]
        self.assertIn(("dog1", "we", "revoked"), [(each["who"], each["side"], each["code"]) for each in ours])
        self.assertIn(("they", "revoked"), [(each["side"], each["code"]) for each in theirs])
        self.assertIn("admit the node again with a new code", ours[0]["reason"])
        self.assertNotIn("dog1", [member["name"] for member in describe_team(self.laptop)["members"]])

    def test_refused_call(self) -> None:
        """If the caller's role does not allow a call, the called node reports the call."""
        asked = self.dog.entangled.call(self.laptop.entangled.contact, "device.message", "sit", changes=True)
        self.team.clock.advance(1.0)
        self.failureResultOf(asked, Refused)
        (told,) = describe_links(self.laptop)["refusals"]
        self.assertEqual((told["who"], told["side"], told["code"], told["count"]), ("dog1", "call", "role", 1))
        self.assertIn("; ask the operator for another role", told["reason"])
