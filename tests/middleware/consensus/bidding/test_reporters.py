"""Tests of ``middleware.consensus.bidding.reporters``: which agents of a large group write reports, and when."""

from __future__ import annotations

import math
from dataclasses import replace

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.bidding.reporters import (
    ASSUMED_PRESENT_S,
    ENOUGH_RECORDS,
    LISTENING_S,
    MAX_SMALL_TEAM,
    RECORD_PAUSE_S,
    SETTLING_S,
    TURN_SPACING_S,
    Reporters,
    make_reporters,
)
from middleware.directory.presence import EXECUTING, SEARCHING, WAITING
from middleware.tasks.task import Member

MANY = 100
ME = Member("me", "dog", SEARCHING)
OTHERS = {f"other{n}" for n in range(ENOUGH_RECORDS)}


class ReportersTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.reporters = Reporters("me", 0.5)
        self.reporters.on_records((), MANY, 0.0)
        self.turn = LISTENING_S + 0.5 * MANY * TURN_SPACING_S

    def full(self) -> None:
        """Simulate that enough records of other agents exist."""
        self.reporters.on_records(OTHERS, MANY, 0.1)

    def test_all_write_in_a_small_team(self) -> None:
        """In a group of at most ``MAX_SMALL_TEAM`` participants each agent writes its report immediately."""
        self.reporters.on_records(OTHERS, MAX_SMALL_TEAM, 0.0)
        self.assertEqual((self.reporters.is_partial(0.0), self.reporters.is_known(0.0)), (False, True))
        self.assertEqual(self.reporters.compute_due(ME, 0.0), 0.0)
        self.reporters.on_written(ME, 0.0)
        self.assertEqual(self.reporters.compute_due(replace(ME, why="waits"), 0.1), 0.1)

    def test_turn_comes_while_there_are_few(self) -> None:
        """In a larger group an agent that is not chosen writes at its turn, unless enough others have written."""
        self.reporters.on_records(OTHERS, MAX_SMALL_TEAM + 1, 0.0)
        self.assertEqual((self.reporters.is_partial(0.0), self.reporters.compute_due(ME, 0.0)), (True, math.inf))
        reporters = Reporters("me", 0.5)
        reporters.on_records((), MANY, 0.0)
        self.assertAlmostEqual(reporters.compute_due(ME, 0.0), self.turn)
        reporters.on_records(OTHERS, MANY, 0.2)
        self.assertEqual(reporters.compute_due(ME, 50.0), math.inf)
        self.assertFalse(reporters.is_known(50.0))

    def test_gone_ones_are_replaced(self) -> None:
        """When records disappear, the turns start again."""
        self.full()
        self.reporters.on_records(sorted(OTHERS)[1:], MANY, 10.0)
        self.assertAlmostEqual(self.reporters.compute_due(ME, 10.0), 10.0 + self.turn)

    def test_small_group_of_a_large_team(self) -> None:
        """If only few records exist after all turns, the group counts as small, and each agent writes immediately."""
        over = LISTENING_S + MANY * TURN_SPACING_S + SETTLING_S
        self.assertEqual([self.reporters.is_partial(over - 0.01), self.reporters.is_partial(over)], [True, False])
        self.assertEqual(self.reporters.compute_due(ME, over), over)

    def test_who_is_announced_writes(self) -> None:
        """An agent that the council announces writes immediately, even if enough records exist."""
        self.full()
        self.reporters.on_announcement(["a", "me"], 5.0)
        self.assertEqual(
            (self.reporters.compute_due(ME, 5.0), self.reporters.is_known(5.0), self.reporters.has_announcement),
            (5.0, True, True),
        )

    def test_who_acts_writes(self) -> None:
        """An agent that acts, has a token or is assigned writes immediately."""
        self.full()
        for told in (replace(ME, status=EXECUTING), replace(ME, token=3), replace(ME, assigned="me")):
            self.assertEqual(self.reporters.compute_due(told, 5.0), 5.0)

    def test_record_of_a_former_life_is_replaced(self) -> None:
        """A record that this agent wrote before a restart is replaced by a record with the current state."""
        self.reporters.on_records({*OTHERS, "me"}, MANY, 1.0)
        self.assertEqual((self.reporters.compute_due(ME, 1.0), self.reporters.is_written), (1.0, True))

    def test_few_changes_are_written(self) -> None:
        """A change of status, cost or availability is written immediately, a new assigned agent after a pause.

        Any other change is written only if the record of this agent is needed.
        """
        self.full()
        self.reporters.on_written(ME, 1.0)
        self.assertEqual(self.reporters.compute_due(ME, 9.0), math.inf)
        self.assertEqual(self.reporters.compute_due(replace(ME, status=WAITING), 1.1), 1.1)
        self.assertEqual(self.reporters.compute_due(replace(ME, cost=2.0), 1.1), 1.1)
        self.assertEqual(self.reporters.compute_due(replace(ME, available=False), 1.1), 1.1)
        self.assertEqual(self.reporters.compute_due(replace(ME, assigned="a"), 1.1), 1.0 + RECORD_PAUSE_S)
        self.assertEqual(self.reporters.compute_due(replace(ME, why="waits"), 1.1), math.inf)
        self.reporters.on_announcement(["me"], 1.1)
        self.assertEqual(self.reporters.compute_due(replace(ME, why="waits"), 1.2), 1.0 + RECORD_PAUSE_S)

    def test_announced_ones_are_believed_for_a_while(self) -> None:
        """An announced agent counts as present until its record is due, even if it is announced repeatedly."""
        self.reporters.on_announcement(["a"], 1.0)
        self.reporters.on_announcement(["a", "b"], 1.9)
        late = 1.0 + ASSUMED_PRESENT_S
        self.assertEqual(
            [self.reporters.is_assumed_present("a", late - 0.01), self.reporters.is_assumed_present("a", late)],
            [True, False],
        )
        self.assertEqual(
            [self.reporters.is_assumed_present("b", late), self.reporters.is_assumed_present("c", late)], [True, False]
        )

    def test_places_are_spread(self) -> None:
        """The agent farthest from the key has the first turn, and the nearest agent the last."""
        key = bytes(20)
        self.assertEqual(make_reporters("00" * 20, key).place, 1.0)
        self.assertAlmostEqual(make_reporters("ff" * 20, key).place, 0.0)
        self.assertAlmostEqual(make_reporters("80" + "00" * 19, key).place, 0.5)
