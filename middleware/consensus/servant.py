"""Servant: the other end of ``worker``, the process in which a strategy of somebody else runs."""

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

from middleware.consensus.remote import answer as answer_of

LENGTH = struct.Struct("!I")
MEMORY = 512 * 1024 * 1024
MAX_TRACE = 4000


def _say(out: BinaryIO, is_well: bool, content: Any) -> None:
    try:
        packed = bytes(msgpack.packb([is_well, content]))
    except Exception as error:  # an answer of anything
        packed = bytes(msgpack.packb([False, f"its answer is no plain value: {error}"[:MAX_TRACE]]))
    out.write(LENGTH.pack(len(packed)) + packed)
    out.flush()


def main() -> None:
    """Answer until nobody asks any more, or an answer takes so long that nobody waits for it."""
    place, patience = sys.argv[1], float(sys.argv[2])
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what the strategy prints is no answer
    into = sys.stdin.buffer
    signal.signal(signal.SIGALRM, signal.SIG_DFL)  # ends the process, also should its parent be dead
    try:
        module, _, attribute = place.partition(":")
        strategy = getattr(importlib.import_module(module), attribute)()
    except BaseException:  # the module of somebody else may do anything
        _say(out, False, traceback.format_exc()[-MAX_TRACE:])
        return
    _say(out, True, None)
    while len(head := into.read(LENGTH.size)) == LENGTH.size:
        method, arguments = msgpack.unpackb(into.read(LENGTH.unpack(head)[0]))
        signal.setitimer(signal.ITIMER_REAL, patience)
        try:
            answer = answer_of(strategy, method, arguments)
        except BaseException:  # the strategy of somebody else may raise anything
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            _say(out, False, traceback.format_exc()[-MAX_TRACE:])
        else:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            _say(out, True, answer)


if __name__ == "__main__":
    main()
