"""Main program of the process in which ``process_strategy`` runs a third-party strategy."""

from __future__ import annotations

import importlib
import os
import resource
import signal
import struct
import sys
import traceback
from typing import Any, BinaryIO

import msgpack

from middleware.consensus.remote_strategy import run_call as answer_of

LENGTH_PREFIX = struct.Struct("!I")
MEMORY_BYTES = 512 * 1024 * 1024
MAX_TRACE_CHARACTERS = 4000


def _send(out: BinaryIO, is_ok: bool, content: Any) -> None:
    try:
        packed = bytes(msgpack.packb([is_ok, content]))
    except Exception as error:  # not serialisable
        packed = bytes(
            msgpack.packb([False, f"the result of the strategy is not a plain value: {error}"[:MAX_TRACE_CHARACTERS]])
        )
    out.write(LENGTH_PREFIX.pack(len(packed)) + packed)
    out.flush()


def main() -> None:
    """Serve calls until the input is closed, or until a call exceeds its time limit and SIGALRM ends the process."""
    import_path, limit_s = sys.argv[1], float(sys.argv[2])
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # keep the output of the strategy separate from the results
    pipe = sys.stdin.buffer
    signal.signal(
        signal.SIGALRM, signal.SIG_DFL
    )  # the default action ends this process, even if its parent no longer exists
    try:
        module, _, attribute = import_path.partition(":")
        strategy = getattr(importlib.import_module(module), attribute)()
    except BaseException:  # third-party code may raise anything
        _send(out, False, traceback.format_exc()[-MAX_TRACE_CHARACTERS:])
        return
    _send(out, True, None)
    while len(head := pipe.read(LENGTH_PREFIX.size)) == LENGTH_PREFIX.size:
        method, arguments = msgpack.unpackb(pipe.read(LENGTH_PREFIX.unpack(head)[0]))
        signal.setitimer(signal.ITIMER_REAL, limit_s)
        try:
            answer = answer_of(strategy, method, arguments)
        except BaseException:  # third-party code may raise anything
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            _send(out, False, traceback.format_exc()[-MAX_TRACE_CHARACTERS:])
        else:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            _send(out, True, answer)


if __name__ == "__main__":
    main()
