"""Attack S22: push code to a node as an author that is not an operator, or no longer one."""

from __future__ import annotations

import sys
from dataclasses import replace

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.admission.membership_file import MemoryMembership
from middleware.deployment.module_store import MemoryModuleStore
from middleware.entangled.control.socket_path import prepare_path
from middleware.node import SwarmNode
from middleware.tasks.task import Task
from swarmnode.deploy import main
from swarmnode.simulated_team import SimulatedTeam
from tests.swarmnode.shell import Shell, runtime_folder

CANARY = "swarm_canary"
SOURCE = f"""
import sys
from middleware.consensus.strategies.nearest import Nearest
sys.modules["{CANARY}"] = sys


class Strategy(Nearest):
    pass
"""
WALK = """
class Behaviour:
    cost = 1.0
    def __init__(self, parameters, rng): self.left = parameters["steps"]
    def look(self, seen, now): self.progress = 1.0 / (1.0 + self.left)
    def search(self, now): return {}
    def hold(self, now): return {}
    def execute(self, context):
        self.left -= 1
        return {"base.vx": 0.05, "base.vy": 0.0, "base.wz": 0.3} if self.left > 0 else None
"""
IN_FORCE = 10.0


class PushedCodeTests(SynchronousTestCase):
    """A closed team with a laptop as its first node, and a dog.

    ``author`` pushes modules, and the dog's settings list the author's key.
    """

    def setUp(self) -> None:
        self.folder = runtime_folder(self, "author")
        self.addCleanup(sys.modules.pop, CANARY, None)
        self.team = SimulatedTeam(11, dogs=())
        self.team._names += ("author", "second")
        self.addCleanup(self.team.stop)
        self.module_store = MemoryModuleStore()

    def join(self, name: str, *roles: str) -> SwarmNode:
        """Add a member to which the operator granted these roles."""
        membership = self.team.operator.create_membership(
            name, roles, self.team.clock.seconds(), self.team._member_rng, self.team._secret
        )
        self.team._memberships[name] = MemoryMembership(membership)
        self.team.add_node(name)
        self.team.clock.advance(1.0)
        return self.team.services[name].assembly.node

    def allow(self, *authors: SwarmNode) -> SwarmNode:
        """Start the dog with the keys of these authors in its settings."""
        keys = [author.entangled.identity.public.hex() for author in authors]
        allowed = {"allow": True, "operators": keys, "modules": ["best"]}
        self.team.add_node("dog1", {"deployment": allowed}, self.module_store)
        self.team.clock.advance(1.0)
        return self.team.services["dog1"].assembly.node

    def push(self, author: SwarmNode, source: str = SOURCE, kind: str = "strategy") -> int:
        """Push a module at the author's node; return the exit code of the command."""
        path = self.folder / "best.py"
        path.write_text(source)
        shell = Shell(self.team, author)
        code, _ = shell.run(main, ["push", str(path), "--name", "best", "--kind", kind])
        self.team.clock.advance(2.0)
        return int(code)

    def revoke(self, node: SwarmNode, name: str) -> None:
        """Revoke a member at the laptop."""
        packed = self.team.operator.revoke(node.entangled.identity.public, name, self.team.clock.seconds())
        team = self.team.services["vaio"].assembly.node.team
        assert team is not None
        told = self.team_told(team.publish(packed))
        self.assertEqual(told, "revoke")
        self.team.clock.advance(IN_FORCE)

    def submit(self, steps: int) -> None:
        """Submit a task for the pushed behaviour, which ends after ``steps`` steps."""
        task = Task("t1", "deployed:best", "Walk", parameters={"steps": steps}, requirements={"base2d": {}})
        task = replace(task, created=self.team.clock.seconds())
        self.team_told(self.team.services["vaio"].assembly.node.submit(task))

    def pose(self) -> tuple[float, ...]:
        (robot,) = [each for each in self.team.get_true_state()["dogs"] if each["name"] == "dog1"]
        return tuple(round(robot[key], 4) for key in ("x", "y", "heading"))

    def team_told(self, work: object) -> object:
        done = Deferred.fromCoroutine(work)  # type: ignore[arg-type,var-annotated]
        self.team.clock.advance(1.0)
        return self.successResultOf(done)

    def shown(self) -> str:
        """Return the state of the dog's module on the page."""
        (device,) = [each for each in self.team.state()["devices"] if each["name"] == "dog1"]
        return str(device["deployed"].get("best", ""))

    def assert_nothing_runs(self, dog: SwarmNode) -> None:
        """Check that the code of the module has not run, and that tasks cannot use it."""
        self.assertEqual((dict(dog.deployed), CANARY in sys.modules), ({}, False))

    def test_gateway_does_not_push(self) -> None:
        """A gateway may write in the namespaces of operators but cannot run code, even if the dog lists its key."""
        author = self.join("author", "gateway")
        dog = self.allow(author)
        self.assertNotEqual(self.push(author), 0)
        self.assert_nothing_runs(dog)
        self.assertEqual(self.shown(), "")

    def test_device_and_viewer_do_not_push(self) -> None:
        """A device or a viewer cannot run code, even if the dog lists its key by mistake."""
        authors = [self.join("author", "device"), self.join("second", "viewer")]
        dog = self.allow(*authors)
        for author in authors:
            self.push(author)
            self.assert_nothing_runs(dog)

    def test_revoked_operator_stops_running(self) -> None:
        """A module stops when its operator is revoked, and tasks can no longer use it."""
        author = self.join("author", "operator")
        dog = self.allow(author)
        self.assertEqual(self.push(author), 0)
        self.assertEqual(list(dog.deployed), [("strategy", "best")])
        sys.modules.pop(CANARY)
        self.revoke(author, "author")
        self.assert_nothing_runs(dog)
        self.assertIn("refused", self.shown())

    def test_revoked_operator_is_not_loaded_again(self) -> None:
        """A restarted node does not load the stored module of a revoked operator."""
        author = self.join("author", "operator")
        dog = self.allow(author)
        self.push(author)
        self.assertEqual(len(self.module_store.contents), 1)
        sys.modules.pop(CANARY)
        self.revoke(author, "author")
        self.team.services["dog1"].leave_for(1.0)
        self.team.clock.advance(5.0)
        dog = self.team.services["dog1"].assembly.node
        self.assert_nothing_runs(dog)

    def test_another_operator_follows_a_revoked_one(self) -> None:
        """A revoked operator's module does not block the next operator's module, whatever its version is."""
        author, second = self.join("author", "operator"), self.join("second", "operator")
        dog = self.allow(author, second)
        self.push(author)
        self.revoke(author, "author")
        prepare_path("author").unlink()
        prepare_path("second").touch()
        self.assertEqual(self.push(second, SOURCE + "# two\n"), 0)
        self.assertEqual(list(dog.deployed), [("strategy", "best")])

    def test_behaviour_does_its_task(self) -> None:
        """An operator's behaviour moves the robot and completes the task."""
        author = self.join("author", "operator")
        self.allow(author)
        self.push(author, WALK, "behaviour")
        before = self.pose()
        self.submit(60)
        self.team.clock.advance(15.0)
        self.assertNotEqual(self.pose(), before)
        self.assertEqual([task["status"] for task in self.team.state()["tasks"]], ["COMPLETED"])

    def test_robot_stands_when_its_author_is_revoked(self) -> None:
        """A robot stops when the author of its behaviour is revoked."""
        author = self.join("author", "operator")
        dog = self.allow(author)
        self.push(author, WALK, "behaviour")
        self.submit(10**6)
        self.team.clock.advance(10.0)
        before = self.pose()
        self.team.clock.advance(2.0)
        self.assertNotEqual(self.pose(), before)
        self.revoke(author, "author")
        before = self.pose()
        self.team.clock.advance(5.0)
        self.assertEqual((self.pose(), dict(dog.deployed)), (before, {}))

    def test_author_and_digest_are_shown(self) -> None:
        """For a running and for a rejected module, the page shows the author's name and key, and the digest."""
        author = self.join("author", "operator")
        dog = self.allow(author)
        self.push(author)
        record = dog.presence.device.deployed["best"]
        key = author.entangled.identity.public.hex()
        for part in ("author", key[:8], record.split()[1][:8]):
            self.assertIn(part, self.shown())
        self.push(author, SOURCE + "1 / 0\n")
        self.assertIn("refused", self.shown())
        self.assertEqual(self.shown().count(key[:8]), 2)
