"""Tests of ``agents.execution``: continuing a task under an unchanged token, progress, and the stall limit."""

from __future__ import annotations

from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from agents.behaviour import STAND
from agents.context import Context
from agents.execution import Execution
from middleware.consensus.strategy import Consensus


class Digger:
    """A behaviour that records its contexts and reports its progress."""

    def __init__(self, progress: object = 0.0) -> None:
        self.progress = progress
        self.contexts: list[Context] = []

    def execute(self, context: Context) -> Any:
        """Record the context."""
        self.contexts.append(context)
        return STAND


class ExecutionTests(SynchronousTestCase):
    def execution(self, digger: Digger, limit: float = 0.0) -> Execution:
        """Return an execution of this behaviour."""
        return Execution(digger, limit)  # type: ignore[arg-type]

    def test_same_token_goes_on(self) -> None:
        """Under an unchanged token the context has ``is_resumed`` set; under a new token it does not."""
        digger = Digger()
        execution = self.execution(digger)
        for now, token in ((1.0, 5), (2.0, 5), (3.0, 6), (4.0, 6)):
            execution.step(now, token, now + 1.0)
        called_with = [(c.now, c.token, c.deadline, c.began, c.is_resumed) for c in digger.contexts]
        self.assertEqual(called_with[0], (1.0, 5, 2.0, 1.0, False))
        self.assertEqual(called_with[1], (2.0, 5, 3.0, 1.0, True))
        self.assertEqual([row[3:] for row in called_with[2:]], [(3.0, False), (3.0, True)])

    def test_agreement_is_told(self) -> None:
        """The agreed value reaches the behaviour; under the same token it stays until a new value is agreed."""
        digger = Digger()
        execution = self.execution(digger)
        for token, choice, value in ((5, "red", (1.0, 2.0)), (5, "", ()), (5, "blue", ()), (6, "", ())):
            execution.step(0.0, token, 9.0, Consensus("a", choice=choice, value=value))
        called_with = [(context.choice, context.value) for context in digger.contexts]
        self.assertEqual(called_with, [("red", (1.0, 2.0)), ("red", (1.0, 2.0)), ("blue", ()), ("", ())])

    def test_progress_is_told_in_quarters(self) -> None:
        """Progress is rounded to quarters; an invalid value becomes None."""
        for value, expected in ((0.0, 0.0), (0.3, 0.25), (0.75, 0.75), (7.0, 1.0), (-1, 0.0), ("much", None)):
            self.assertEqual(self.execution(Digger(value)).step(0.0, 1, 1.0).progress, expected, value)
        self.assertIsNone(self.execution(Digger(float("nan"))).step(0.0, 1, 1.0).progress)

    def test_who_is_kept_from_it_does_not_stall(self) -> None:
        """Time between two steps, for example while the team is stopped, does not count as time without progress."""
        execution = self.execution(Digger(), 2.0)
        for moment in (0.0, 0.5, 1.0, 61.0, 61.5):
            execution.step(moment, 1, 99.0)
            self.assertFalse(execution.has_stalled(moment), moment)
        execution.step(62.2, 1, 99.0)
        self.assertTrue(execution.has_stalled(62.2))

    def test_stall(self) -> None:
        """An execution without progress for ``limit`` seconds has stalled, and remains so for the same time."""
        digger = Digger()
        execution = self.execution(digger, 2.0)
        for tenth in range(30):
            digger.progress = tenth / 30
            execution.step(tenth / 10, 1, 9.0)
            self.assertFalse(execution.has_stalled(tenth / 10))
        for tenth in range(30, 53):
            execution.step(tenth / 10, 1, 9.0)
        self.assertTrue(execution.has_stalled(5.2))
        self.assertFalse(execution.has_stalled(7.2))
