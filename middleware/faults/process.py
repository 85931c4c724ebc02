"""Kill or freeze the process of a node."""

from __future__ import annotations

import os
import signal
import subprocess


class OwnProcess:
    """The process that runs this code."""

    def kill(self) -> None:
        """Kill the process by SIGKILL, so it can neither send nor write anything."""
        os.kill(os.getpid(), signal.SIGKILL)

    def freeze(self, seconds: float) -> None:
        """Stop by SIGSTOP; a child process sends SIGCONT after ``seconds``, because a stopped process has no timers."""
        wake = f"sleep {seconds:.3f}; kill -CONT {os.getpid()}"
        quiet = subprocess.DEVNULL
        # The child has a separate session, so a signal to this process group does not stop it.
        subprocess.Popen(["/bin/sh", "-c", wake], stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True)
        os.kill(os.getpid(), signal.SIGSTOP)
