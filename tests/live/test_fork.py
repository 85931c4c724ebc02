"""Tests of calls in child processes."""

from __future__ import annotations

import os
import signal
from select import select
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from sim.team.scale.fork import run_in_fork


class Ended(Exception):
    """Raised when a signal arrives."""


def ended(*signal: Any) -> None:
    """Raise ``Ended`` when a signal arrives."""
    raise Ended


class ForkTests(SynchronousTestCase):
    def test_returns_and_raises(self) -> None:
        """Results and exceptions of the call reach the parent; changes of variables do not."""
        changed: list[int] = []

        def call() -> int:
            changed.append(os.getpid())
            return changed[0]

        self.assertNotEqual(run_in_fork(call), os.getpid())
        self.assertEqual(changed, [])
        with self.assertRaisesRegex(ValueError, "none"):
            run_in_fork(lambda: int("none"), ValueError)

    def test_ends_without_a_word(self) -> None:
        """If a child process ends without a result, the call raises an error that contains the exit code."""
        with self.assertRaisesRegex(RuntimeError, "exit code 7"):
            run_in_fork(lambda: os._exit(7))

    def test_ended_with_who_waits_for_it(self) -> None:
        """If the waiting parent is interrupted, the child is interrupted too, and its exception reaches the parent."""
        ready, told = os.pipe()
        self.addCleanup(os.close, ready)
        self.addCleanup(os.close, told)

        def call() -> None:
            signal.signal(signal.SIGTERM, ended)
            os.write(told, b".")
            signal.pause()

        with self.assertRaises(Ended):
            run_in_fork(call, Ended, is_stopped=lambda: bool(select([ready], [], [], 0.0)[0]))
