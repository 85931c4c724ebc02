"""Node: real ``twistd`` processes and the real ``swarm`` command, in a folder of their own."""

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
    """A node in a process of its own; ``lines`` are what it has said."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.lines: list[str] = []
        assert process.stdout is not None
        self._reader = threading.Thread(target=self.lines.extend, args=(process.stdout,), daemon=True)
        self._reader.start()

    def says(self, words: str) -> None:
        """Wait until it has said so; fails with what it said instead, at once where it has ended."""

        def is_said() -> bool:
            has_ended = not self._reader.is_alive()
            if any(words in line for line in list(self.lines)):
                return True
            if has_ended:
                raise AssertionError(f"the node ended before it said {words!r}: {''.join(self.lines)}")
            return False

        until(is_said, told=lambda: "".join(self.lines))

    def kill(self) -> None:
        """End it at once, where it runs."""
        self.process.kill()
        self.process.wait()
        self._reader.join()
        assert self.process.stdout is not None
        self.process.stdout.close()


class NodeCase(SynchronousTestCase):
    """Nodes of this machine, which keep all that they keep in ``folder``."""

    def setUp(self) -> None:
        super().setUp()
        # Trial's own folders are deeper than the path of a socket may be.
        self.folder = Path(tempfile.mkdtemp()).resolve()
        self.addCleanup(shutil.rmtree, self.folder)
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("SWARM_")}
        here = {"XDG_RUNTIME_DIR": str(self.folder), "XDG_CONFIG_HOME": str(self.folder / "config")}
        self.environment = {**inherited, **here, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"}

    def popen(self, *arguments: str, stderr: int = subprocess.PIPE) -> subprocess.Popen[str]:
        """``twistd -n swarm-node ARGUMENTS``."""
        twistd = str(Path(sys.executable).parent / "twistd")
        command = [sys.executable, twistd, "-n", "--pidfile=", "swarm-node", *arguments]
        return subprocess.Popen(
            command, cwd=self.folder, env=self.environment, stdout=subprocess.PIPE, stderr=stderr, text=True
        )

    def node(self, *arguments: str) -> Node:
        """A node that ends with the test."""
        node = Node(self.popen(*arguments, stderr=subprocess.STDOUT))
        self.addCleanup(node.kill)
        return node

    def file(self, text: str, name: str = "node") -> str:
        """A settings file."""
        path = self.folder / f"{name}.toml"
        path.write_text(text, encoding="utf-8")
        return str(path)

    def key_file(self) -> str:
        """A file with the secret of an open team."""
        path = self.folder / "team.key"
        path.touch(mode=0o600)
        path.write_text("t\n")
        return str(path)

    def swarm(self, *words: str) -> subprocess.CompletedProcess[str]:
        """``swarm WORDS``."""
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
