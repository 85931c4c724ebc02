"""Test cases with real ``twistd`` processes and the real ``swarm`` command, in a temporary folder."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from twisted.trial.unittest import SynchronousTestCase

from tests.live.until import until

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 30.0


class Node:
    """A node in a child process; ``lines`` contains its output."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.lines: list[str] = []
        assert process.stdout is not None
        self._reader = threading.Thread(target=self.lines.extend, args=(process.stdout,), daemon=True)
        self._reader.start()

    def says(self, words: str) -> None:
        """Wait until the output contains ``words``; after a timeout, or when the node ends, fail with the output."""

        def is_said() -> bool:
            has_ended = not self._reader.is_alive()
            if any(words in line for line in list(self.lines)):
                return True
            if has_ended:
                raise AssertionError(f"the node ended before it said {words!r}: {''.join(self.lines)}")
            return False

        until(is_said, told=lambda: "".join(self.lines))

    def kill(self) -> None:
        """Kill the process if it runs."""
        self.process.kill()
        self.process.wait()
        self._reader.join()
        assert self.process.stdout is not None
        self.process.stdout.close()


class NodeCase(SynchronousTestCase):
    """A test of nodes on this machine, which have all their files in ``folder``."""

    def setUp(self) -> None:
        super().setUp()
        # The folders of Trial have paths that are too long for a socket.
        self.folder = Path(tempfile.mkdtemp()).resolve()
        self.addCleanup(shutil.rmtree, self.folder)
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("SWARM_")}
        here = {"XDG_RUNTIME_DIR": str(self.folder), "XDG_CONFIG_HOME": str(self.folder / "config")}
        self.environment = {**inherited, **here, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}

    def popen(self, *arguments: str, stderr: int = subprocess.PIPE) -> subprocess.Popen[str]:
        """Run ``twistd -n swarm-node ARGUMENTS``."""
        twistd = str(Path(sys.executable).parent / "twistd")
        command = [sys.executable, twistd, "-n", "--pidfile=", "swarm-node", *arguments]
        return subprocess.Popen(
            command, cwd=self.folder, env=self.environment, stdout=subprocess.PIPE, stderr=stderr, text=True
        )

    def node(self, *arguments: str) -> Node:
        """Return a node that is killed after the test."""
        node = Node(self.popen(*arguments, stderr=subprocess.STDOUT))
        self.addCleanup(node.kill)
        return node

    def file(self, text: str, name: str = "node") -> str:
        """Write a settings file and return its path."""
        path = self.folder / f"{name}.toml"
        path.write_text(text, encoding="utf-8")
        return str(path)

    def key_file(self) -> str:
        """Write a file with the secret of an open team and return its path."""
        path = self.folder / "team.key"
        path.touch(mode=0o600)
        path.write_text("t\n")
        return str(path)

    def swarm(self, *words: str) -> subprocess.CompletedProcess[str]:
        """Run ``swarm WORDS``."""
        program = "import sys; from swarmnode.command import main; sys.exit(main(sys.argv[1:]))"
        return subprocess.run(
            [sys.executable, "-c", program, *words],
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=60.0,
            check=False,
        )
