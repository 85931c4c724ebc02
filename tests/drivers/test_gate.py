"""Tests of ``drivers.gate``."""

from __future__ import annotations

import math

from twisted.trial.unittest import SynchronousTestCase

from drivers.driver import Permit
from drivers.errors import StaleCommand
from drivers.gate import LATE, LOWER, Gate


class GateTests(SynchronousTestCase):
    """The gate checks the token and deadline of each command."""

    def test_lets_the_same_and_higher_tokens_through(self) -> None:
        """Commands with an equal or a higher token are accepted."""
        gate = Gate()
        for token in (1, 1, 4):
            gate.admit(Permit(token, 2.0), now=1.0)
        self.assertEqual((gate.token, gate.deadline), (4, 2.0))

    def test_refuses_a_lower_token_and_keeps_the_deadline(self) -> None:
        """A command with a lower token is refused, and the deadline does not change."""
        gate = Gate()
        gate.admit(Permit(4, 2.0), now=1.0)
        error = self.assertRaises(StaleCommand, gate.admit, Permit(3, 9.0), 1.5)
        self.assertIn("token 3 is lower than token 4", str(error))
        self.assertEqual(gate.deadline, 2.0)

    def test_refuses_deadlines_that_are_no_future(self) -> None:
        """A command with a deadline that is not a finite future time is refused, and its token is not stored."""
        gate = Gate()
        for deadline in (1.0, 0.5, math.inf, math.nan):
            self.assertRaises(StaleCommand, gate.admit, Permit(7, deadline), 1.0)
        self.assertIsNone(gate.token)

    def test_says_when_to_stop(self) -> None:
        """A motion is over at its deadline; without a motion, nothing is over."""
        gate = Gate()
        self.assertFalse(gate.is_motion_over(5.0))
        gate.admit(Permit(1, 2.0), now=1.0)
        self.assertFalse(gate.is_motion_over(1.999))
        self.assertTrue(gate.is_motion_over(2.0))

    def test_keeps_fencing_after_it_was_closed(self) -> None:
        """A stop ends the motion, but an old token is still refused."""
        gate = Gate()
        gate.admit(Permit(4, 2.0), now=1.0)
        gate.end_motion()
        self.assertFalse(gate.is_motion_over(3.0))
        self.assertRaises(StaleCommand, gate.admit, Permit(3, 9.0), 3.0)

    def test_learns_from_a_gate_further_down(self) -> None:
        """If the robot reports a higher token, the gate stores it, and then refuses commands with lower tokens."""
        gate = Gate()
        for token, known in ((0, None), (7, 7), (5, 7)):
            gate.learn(token)
            self.assertEqual(gate.token, known)
        self.assertRaises(StaleCommand, gate.admit, Permit(6, 2.0), 1.0)
        gate.admit(Permit(7, 2.0), now=1.0)

    def test_counts_by_name(self) -> None:
        """Accepted commands are counted, and refused commands are counted by reason."""
        gate = Gate()
        gate.admit(Permit(4, 2.0), now=1.0)
        for token, deadline in ((3, 2.0), (2, 2.0), (9, 0.5)):
            self.assertRaises(StaleCommand, gate.admit, Permit(token, deadline), 1.0)
        self.assertEqual((gate.accepted, gate.refused), (1, {LOWER: 2, LATE: 1}))
