"""Apart: a call in a process of its own, so that what it takes of the machine's memory can be told from the rest."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import TypeVar

T = TypeVar("T")

LOOK_S = 0.5
"""Seconds between two looks whether it is to end."""


def apart(call: Callable[[], T], *quiet: type[Exception], is_stopped: Callable[[], bool] = lambda: False) -> T:
    """What ``call`` returns, or raises of ``quiet``; it sees this process as it is now, and changes nothing in it.

    When this process ``is_stopped``, the other one is told by SIGTERM, and does what this one would do then.  Raises
    ``RuntimeError`` where the process ends without a word; what went wrong stands on its standard error.
    """
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(there, call, quiet))
    process.start()
    there.close()
    while not here.poll(LOOK_S):
        if is_stopped():
            process.terminate()
    try:
        is_well, result = here.recv()
    except EOFError:
        process.join()
        raise RuntimeError(f"the process that measured ended with {process.exitcode}") from None
    process.join()
    if not is_well:
        raise result
    return result  # type: ignore[no-any-return]


def _answer(there: Connection, call: Callable[[], T], quiet: tuple[type[Exception], ...]) -> None:
    try:
        there.send((True, call()))
    except quiet as error:
        there.send((False, error))
