"""A real node asked through its control socket by the real ``swarm`` command, before and after a SIGKILL."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from tests.live.until import until

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 30.0


class ControlTests(SynchronousTestCase):
    def setUp(self) -> None:
        # Trial's own folders are deeper than the path of a socket may be.
        self.runtime = Path(tempfile.mkdtemp())
        self.addCleanup(shutil.rmtree, self.runtime)
        inherited = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        self.environment = {**inherited, "XDG_RUNTIME_DIR": str(self.runtime), "PYTHONPATH": str(ROOT)}

    def start(self, *flags: str) -> subprocess.Popen[bytes]:
        """A node that has joined."""
        twistd = str(Path(sys.executable).parent / "twistd")
        key = self.runtime / "team.key"
        key.touch(mode=0o600)
        key.write_text("t\n")
        flags = flags or ("--name", "a", "--store", "a.sqlite", "--team-key-file", str(key))
        command = [sys.executable, twistd, "-n", "--pidfile=", "swarm-node", *flags]
        child = subprocess.Popen(
            command, cwd=self.runtime, env=self.environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        self.addCleanup(child.wait)
        self.addCleanup(child.kill)
        assert child.stdout is not None
        self.addCleanup(child.stdout.close)
        for line in child.stdout:
            if b"joined" in line:
                return child
        self.fail("the node ended")

    def swarm(self, *words: str) -> subprocess.CompletedProcess[str]:
        """``swarm WORDS``."""
        program = "import sys; from swarmnode.command import main; sys.exit(main(sys.argv[1:]))"
        return subprocess.run(
            [sys.executable, "-c", program, *words],
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )

    def said(self, *words: str) -> str:
        """What ``swarm WORDS`` prints, without trouble."""
        ran = self.swarm(*words)
        self.assertEqual((ran.returncode, ran.stderr), (0, ""), ran.stdout)
        return ran.stdout

    def test_shell_and_node_talk(self) -> None:
        """Values, tuples, keywords and methods through the shell; a SIGKILL later the values are there again."""
        self.assertIn("no node runs", self.swarm("dht", "get", "a").stderr)
        child = self.start()
        self.assertIn("1 replicas", self.said("dht", "put", "colour", "red"))
        (record,) = json.loads(self.said("dht", "get", "colour", "--json"))
        self.assertEqual((record["value"], record["sequence"] > 0), ("red", True))
        self.said("keyword", "publish", "red_target.jpg", "here")
        self.assertIn("here", self.said("keyword", "search", "target"))
        self.said("tuple", "put", "job", "7")
        self.assertEqual(self.said("tuple", "get", "job", "?int"), '"job" 7\n')
        self.assertEqual(self.swarm("tuple", "get", "job", "?int").returncode, 1)
        self.assertEqual(self.swarm("tuple", "get", "job", "?number").returncode, 2)

        child.kill()
        child.wait()
        self.assertIn("does not answer (Connection refused); start it", self.swarm("dht", "get", "colour").stderr)
        self.start()
        until(lambda: not self.swarm("dht", "get", "colour").returncode)
        self.assertIn("red", self.said("dht", "get", "colour"))

    def test_operator_pushes_to_a_running_node(self) -> None:
        """A node that trusts its own operator runs what is pushed, shows it, goes back, and has it after a SIGKILL."""
        child = self.start()
        key = json.loads(self.said("deploy", "keys", "--json"))["a"]
        child.kill()
        child.wait()
        settings = self.runtime / "a.toml"
        table = f'[deployment]\nallow = true\noperators = ["{key}"]\nmodules = ["mine"]\n'
        settings.write_text(f'[node]\nname = "a"\nteam_key = "t"\nstore = "a.sqlite"\n{table}')
        child = self.start("--config", str(settings))
        module = self.runtime / "mine.py"
        for number in (1, 2):
            module.write_text(
                f"from middleware.consensus.strategies.nearest import Nearest as Strategy\nVERSION = {number}\n"
            )
            self.said("deploy", "push", str(module), "--name", "mine", "--kind", "strategy")
            self.shows(f"  a  {number} ")
        self.assertIn("went back", self.said("deploy", "rollback", "mine"))
        self.shows("  a  1 ")
        child.kill()
        child.wait()
        self.start("--config", str(settings))
        self.shows("  a  1 ")
        self.assertIn("the team has no task", self.swarm("why", "last").stderr)

    def shows(self, words: str) -> None:
        """Wait until ``swarm deploy status`` says so."""
        until(lambda: words in self.swarm("deploy", "status").stdout)
