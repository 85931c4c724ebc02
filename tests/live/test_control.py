"""Tests of a real node, its control socket and the real ``swarm`` command, before and after a SIGKILL."""

from __future__ import annotations

import json

from tests.live.node import Node, NodeCase
from tests.live.until import until


class ControlTests(NodeCase):
    def joined(self, *flags: str) -> Node:
        """Return a node that has joined."""
        node = self.node(*(flags or ("--name", "a", "--store", "a.sqlite", "--team-key-file", self.key_file())))
        node.says("joined")
        return node

    def said(self, *words: str) -> str:
        """Run ``swarm WORDS``, which must succeed; return its output."""
        ran = self.swarm(*words)
        self.assertEqual((ran.returncode, ran.stderr), (0, ""), ran.stdout)
        return ran.stdout

    def test_shell_and_node_talk(self) -> None:
        """Values, tuples, keywords and methods work through the shell; the values survive a SIGKILL."""
        self.assertIn("no node runs", self.swarm("dht", "get", "a").stderr)
        node = self.joined()
        self.assertIn("1 replicas", self.said("dht", "put", "colour", "red"))
        (record,) = json.loads(self.said("dht", "get", "colour", "--json"))
        self.assertEqual((record["value"], record["sequence"] > 0), ("red", True))
        self.said("keyword", "publish", "red_target.jpg", "here")
        self.assertIn("here", self.said("keyword", "search", "target"))
        self.said("tuple", "put", "job", "7")
        self.assertEqual(self.said("tuple", "get", "job", "?int"), '"job" 7\n')
        self.assertEqual(self.swarm("tuple", "get", "job", "?int").returncode, 1)
        self.assertEqual(self.swarm("tuple", "get", "job", "?number").returncode, 2)

        node.kill()
        self.assertIn("does not answer (Connection refused); start the node", self.swarm("dht", "get", "colour").stderr)
        self.joined()
        until(lambda: not self.swarm("dht", "get", "colour").returncode)
        self.assertIn("red", self.said("dht", "get", "colour"))

    def test_operator_pushes_to_a_running_node(self) -> None:
        """A node that trusts its operator runs a pushed module, rolls it back, and keeps it after a SIGKILL."""
        node = self.joined()
        key = json.loads(self.said("deploy", "keys", "--json"))["a"]
        node.kill()
        table = f'[deployment]\nallow = true\noperators = ["{key}"]\nmodules = ["mine"]\n'
        settings = self.file(f'[node]\nname = "a"\nteam_key = "t"\nstore = "a.sqlite"\n{table}')
        node = self.joined("--config", settings)
        module = self.folder / "mine.py"
        for number in (1, 2):
            module.write_text(
                f"from middleware.consensus.strategies.nearest import Nearest as Strategy\nVERSION = {number}\n"
            )
            self.said("deploy", "push", str(module), "--name", "mine", "--kind", "strategy")
            self.shows(f"  a  {number} ")
        self.assertIn("rolled back from version 2", self.said("deploy", "rollback", "mine"))
        self.shows("  a  1 ")
        node.kill()
        self.joined("--config", settings)
        self.shows("  a  1 ")
        self.assertIn("the team has no task", self.swarm("why", "last").stderr)

    def shows(self, words: str) -> None:
        """Wait until the output of ``swarm deploy status`` contains these words."""
        until(lambda: words in self.swarm("deploy", "status").stdout)
