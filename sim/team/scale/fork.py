"""Run a call in a separate process, so that its memory can be measured separately."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import TypeVar

T = TypeVar("T")

POLL_S = 0.5
"""Interval in seconds at which ``is_stopped`` is called."""


def run_in_fork(call: Callable[[], T], *quiet: type[Exception], is_stopped: Callable[[], bool] = lambda: False) -> T:
    """Return the result of ``call``, or raise its exception if that is one of ``quiet``; the call runs in a fork.

    When ``is_stopped`` returns True, the fork gets a SIGTERM, and handles it as this process would.  Raises
    ``RuntimeError`` if the fork ends without a result; its standard error has the cause.
    """
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_send_result, args=(there, call, quiet))
    process.start()
    there.close()
    while not here.poll(POLL_S):
        if is_stopped():
            process.terminate()
    try:
        is_well, result = here.recv()
    except EOFError:
        process.join()
        raise RuntimeError(f"the measuring process ended with exit code {process.exitcode}") from None
    process.join()
    if not is_well:
        raise result
    return result  # type: ignore[no-any-return]


def _send_result(there: Connection, call: Callable[[], T], quiet: tuple[type[Exception], ...]) -> None:
    try:
        there.send((True, call()))
    except quiet as error:
        there.send((False, error))
