"""Tests of ``swarmnode.deploy`` and of deployment on a whole team: three simulated dogs and the laptop's shell."""

from __future__ import annotations

import json
from dataclasses import replace

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from agents.catalogue import DEMO_TASK, TASKS
from middleware.consensus.decision_record import DecisionRecord, decision_records_key, parse_decision_record
from middleware.deployment.module_store import MemoryModuleStore
from middleware.entangled.identity import derive_node_id
from swarmnode.deploy import main
from swarmnode.simulated_team import SimulatedTeam
from tests.swarmnode.shell import Shell, runtime_folder

FARTHEST = '''
"""The agent with the longest way goes: nobody wants that, so nobody takes it for the default."""
from middleware.consensus.strategy import Consensus, digest_of, standing

RAN = True


class Strategy:
    name = "farthest"

    def find(self, contacts):
        order = sorted({r.agent: r for r in contacts}.values(), key=lambda r: (-r.cost, r.agent))
        names = [r.agent for r in order]
        return Consensus(names[0], tuple(names[1:]), digest_of(order)) if names else Consensus(None)

    def improves(self, current, offer, hysteresis):
        return False

    def merge(self, a, b):
        return standing((*a, *b))
'''


class DeployTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.folder = runtime_folder(self)
        self.team = SimulatedTeam(11, dogs=())
        self.addCleanup(self.team.stop)
        self.laptop = self.team.services["vaio"].assembly.node
        self.shell = Shell(self.team, self.laptop)
        self.shelves = {name: MemoryModuleStore() for name in self.team.DOGS}

    def let_in(self, *modules: str, refusing: str = "") -> None:
        """Start the dogs, each with its own module store.

        All except ``refusing`` accept ``modules`` from the laptop.
        """
        allowed = {"allow": True, "operators": [self.laptop.entangled.identity.public.hex()], "modules": list(modules)}
        for name in self.team.DOGS:
            tables = {} if name == refusing else {"deployment": allowed}
            self.team.add_node(name, tables, self.shelves[name])
            self.team.clock.advance(0.5)

    def swarm(self, line: str) -> str:
        """Run ``swarm deploy LINE``, which must succeed; return its output."""
        code, output = self.shell.run(main, line.split())
        self.assertEqual((code, self.shell.said), (0, ""))
        return output

    def refused(self, line: str) -> str:
        """Run ``swarm deploy LINE``, which must fail; return its error output."""
        code, _ = self.shell.run(main, line.split())
        self.assertTrue(code in (1, 2))
        return self.shell.said

    def file(self, text: str) -> str:
        path = self.folder / "module.py"
        path.write_text(text)
        return str(path)

    def push(self, text: str = FARTHEST, name: str = "farthest", more: str = "") -> str:
        """Push a strategy, and wait until the team has received it."""
        told = self.swarm(f"push {self.file(text)} --name {name} --kind strategy {more}")
        self.team.clock.advance(2.0)
        return told

    def messages(self, name: str) -> str:
        device = self.team.services[name].assembly.node.presence.device
        return " | ".join(text for _, text in device.messages)

    def deployed(self) -> dict[str, str]:
        """Return the version that each device runs, according to the page."""
        devices = self.team.state()["devices"]
        return {d["name"]: d["deployed"].get("farthest", "") for d in devices if d["name"] != "vaio"}

    def verdicts(self, strategy: str, seconds: float) -> list[DecisionRecord]:
        """Submit a task with a strategy; return the decision records of the dogs."""
        task = replace(
            TASKS[DEMO_TASK], task_id=f"t{self.team.clock.seconds():.0f}", strategy=strategy, waiting_period=30.0
        )
        task = replace(task, created=self.team.clock.seconds())
        submitted = Deferred.fromCoroutine(self.laptop.submit(task))
        self.team.simulator.world.scatter(3)
        self.team.clock.advance(3.0)
        self.team.control.move_target(1.5, 1.2)
        self.team.clock.advance(seconds)
        self.assertEqual(self.successResultOf(submitted).task_id, task.task_id)
        records = self.team.control.read(decision_records_key(task.task_id))
        return [verdict for each in records if (verdict := parse_decision_record(each)) is not None]

    def test_team_runs_what_is_pushed(self) -> None:
        """All three dogs load a pushed strategy, report its version, and use it for the next task."""
        self.let_in("farthest")
        told = self.push()
        self.assertIn("pushed strategy farthest 1 ", told)
        self.assertEqual({label[:2] for label in self.deployed().values()}, {"1 "})
        status = self.swarm("status")
        self.assertIn("farthest  strategy  1 ", status)
        self.assertEqual(status.count("dog"), 3)
        verdicts = self.verdicts("deployed:farthest", 30.0)
        self.assertEqual({v.rule for v in verdicts}, {"deployed:farthest"})
        self.assertEqual({v.version[:2] for v in verdicts}, {"1 "})
        first = min(verdicts, key=lambda v: v.epoch)
        costs = {report.agent: report.cost for report in first.reports}
        self.assertEqual(first.winner, max(costs, key=lambda agent: costs[agent]))

    def test_node_with_deployment_off_refuses_by_name(self) -> None:
        """A dog that does not allow deployment loads nothing.

        Its report explains why it cannot take part in the task.
        """
        self.let_in("farthest", refusing="dog3")
        self.push()
        self.assertEqual(self.deployed()["dog3"], "")
        self.assertNotIn("farthest", self.messages("dog3"))
        self.assertIn("dog3  -", self.swarm("status"))
        self.verdicts("deployed:farthest", 2.0)
        self.assertIn("strategy 'deployed:farthest' is not deployed on this node", self.messages("dog3"))
        self.assertNotIn("is not deployed", self.messages("dog1"))

    def test_rollback_and_next_version(self) -> None:
        """A rollback restores version 1. Afterwards versions up to 2 are rejected; version 3 replaces both."""
        self.let_in("farthest")
        self.push()
        first = self.deployed()
        self.push(FARTHEST + "# two\n")
        self.assertEqual({label[:2] for label in self.deployed().values()}, {"2 "})
        self.assertIn("rolled back from version 2: strategy farthest 1 ", self.swarm("rollback farthest"))
        self.team.clock.advance(2.0)
        self.assertEqual(self.deployed(), first)
        self.assertIn("2 was withdrawn", self.swarm("status"))
        self.assertIn("no version before 1", self.refused("rollback farthest"))
        self.assertIn(
            "not higher than 2", self.refused(f"push {self.file(FARTHEST)} --name farthest --kind strategy --version 2")
        )
        self.push(FARTHEST + "# three\n")
        self.assertEqual({label[:2] for label in self.deployed().values()}, {"3 "})

    def test_wrong_commands(self) -> None:
        """Invalid commands are rejected before anything is sent.

        For a syntax error the line in the module is printed.
        """
        self.let_in("farthest")
        path = self.file("def f(:\n")
        self.assertIn("line 1", self.refused(f"push {path} --name farthest --kind strategy"))
        self.assertIn("cannot read", self.refused("push /nowhere --name farthest --kind strategy"))
        self.assertIn("does not match", self.refused(f"push {path} --name Far/thest --kind strategy"))
        self.assertIn("no module 'farthest' was pushed; pushed modules: none", self.refused("rollback farthest"))
        big = self.file("#" * 300_000)
        self.assertIn("bytes", self.refused(f"push {big} --name farthest --kind strategy"))
        self.push()
        again = f"push {self.file(FARTHEST)} --name farthest --kind behaviour"
        self.assertIn("is a strategy", self.refused(again))
        self.assertIn("no module 'nearest' was pushed; pushed modules: farthest", self.refused("rollback nearest"))
        self.assertEqual(self.swarm("status").count("farthest"), 1)

    def test_keys_and_json(self) -> None:
        """``keys`` prints the public key of each device; the hash of the key is the device's uuid.

        ``--json`` prints one line.
        """
        self.let_in("farthest")
        keys = json.loads(self.swarm("keys --json"))
        devices = {d["name"]: d["uuid"] for d in self.team.state()["devices"]}
        self.assertEqual({name: derive_node_id(bytes.fromhex(key)).hex() for name, key in keys.items()}, devices)
        self.push()
        (row,) = json.loads(self.swarm("status --json"))
        self.assertEqual((row["name"], row["version"], row["by"]), ("farthest", 1, "vaio"))
        self.assertEqual(sorted(row["devices"]), ["dog1", "dog2", "dog3", "vaio"])
        self.assertEqual(json.loads(self.swarm(f"push {self.file('1')} --name o --kind strategy --json"))["version"], 1)
        # Control characters in strings from a device do not reach the terminal.
        self.team.services["dog1"].assembly.node.presence.change(deployed={"farthest": "1\x1b[2J\nx"})
        self.team.clock.advance(1.0)
        self.assertIn("\n  dog1  1 [2J x\n", self.swarm("status"))
