"""Plug: the process of a node, killed or frozen by itself, for faults on purpose."""

from __future__ import annotations

import os
import signal
import subprocess


class ProcessPlug:
    """This process."""

    def kill(self) -> None:
        """End at once: nothing is said, nothing is written."""
        os.kill(os.getpid(), signal.SIGKILL)

    def freeze(self, seconds: float) -> None:
        """Stand still; a child that is started before wakes us, for who stands still hears no alarm."""
        wake = f"sleep {seconds:.3f}; kill -CONT {os.getpid()}"
        quiet = subprocess.DEVNULL
        # A session of its own: what stops our group is not to stop it, too.
        subprocess.Popen(["/bin/sh", "-c", wake], stdin=quiet, stdout=quiet, stderr=quiet, start_new_session=True)
        os.kill(os.getpid(), signal.SIGSTOP)
