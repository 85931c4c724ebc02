"""Leash: runs a program that ends when whoever started it ends, a killed parent included.

``python -m sim.demo.leash FILE|-m MODULE [ARGUMENTS]`` runs the program in this very process, so its process id is the
one that was started.  The parent holds the other end of standard input and never writes; end of file there means that
the parent is gone.  A kernel closes that pipe however the parent died, which no signal handler could promise.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
import threading
import time

GRACE_S = 3.0
"""Seconds between the request to end (SIGTERM) and the end that cannot be refused."""


def _watch(descriptor: int) -> None:
    while os.read(descriptor, 4096):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE_S)
    os._exit(1)


def main() -> None:
    """Run the program that the command line names, on a leash."""
    if len(sys.argv) < 2 or sys.argv[1:] == ["-m"]:
        raise SystemExit("usage: python -m sim.demo.leash FILE|-m MODULE [ARGUMENTS]")
    leash = os.dup(0)
    os.set_inheritable(leash, False)
    threading.Thread(target=_watch, args=(leash,), name="leash", daemon=True).start()
    if sys.argv[1] == "-m":
        module = sys.argv[2]
        sys.argv = sys.argv[2:]
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    else:
        sys.argv = sys.argv[1:]
        runpy.run_path(sys.argv[0], run_name="__main__")


if __name__ == "__main__":
    main()
