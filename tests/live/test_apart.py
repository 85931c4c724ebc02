"""Calls in processes of their own."""

from __future__ import annotations

import os

from twisted.trial.unittest import SynchronousTestCase

from sim.team.scale.apart import apart


class ApartTests(SynchronousTestCase):
    def test_returns_and_raises(self) -> None:
        """What a call returns and raises arrives here, and what it changes does not."""
        changed: list[int] = []

        def call() -> int:
            changed.append(os.getpid())
            return changed[0]

        self.assertNotEqual(apart(call), os.getpid())
        self.assertEqual(changed, [])
        with self.assertRaisesRegex(ValueError, "none"):
            apart(lambda: int("none"), ValueError)

    def test_ends_without_a_word(self) -> None:
        """A process that ends before it has answered is told of, with its exit code."""
        with self.assertRaisesRegex(RuntimeError, "ended with 7"):
            apart(lambda: os._exit(7))
