"""Tests of the loss of the acting dog in a whole team in memory, for each cause of ``make bench-takeover``."""

from __future__ import annotations

import random

from twisted.trial.unittest import SynchronousTestCase

from benchmarks.takeover.cause import Cause, TakeoverObserver, Trial
from benchmarks.takeover.report import draw_svg, format_table
from benchmarks.takeover.virtual import run_trial
from middleware.directory.presence import EXECUTING
from middleware.tasks.task import COMPLETED, Result
from swarmnode.simulated_team import SimulatedTeam
from tests.swarm.case import TeamCase


class TakeoverTests(TeamCase):
    def test_each_way_to_be_lost(self) -> None:
        """After each kind of loss another dog completes the task within 2.5 s, and two dogs never move simultaneously.

        A frozen dog does nothing after the thaw. A dog that cannot reach the others stops before another dog moves. A
        robot without a link to its node stops by itself.
        """
        seeds = {Cause.POLITE_LEAVE: (2,), Cause.LOST_LINK: (1, 2, 3)}
        for cause in (each for each in Cause if each is not Cause.TRIPLE_KILL):
            for seed in seeds.get(cause, (1,)):
                one = run_trial(cause, seed)
                self.assertTrue(one.has_passed, one)
                self.assertNotEqual(one.by, one.lost)
                self.assertLess(one.takeover or 99.0, 2.5, one)

    def test_dog_and_page_at_once(self) -> None:
        """If the acting dog and the node that serves the page are lost simultaneously, another dog takes over.

        The seeds are chosen so that both lost nodes would be in a council of three members, which would lose its
        majority.
        """
        for seed in (6, 7):
            team = self.start_team(seed, others=("pi",))
            team.run_demo()
            first = self.moving_for_it(team, "")
            for gone in (first, SimulatedTeam.BOOTSTRAP):
                team.kill(gone)
            started_at = team.clock.seconds()
            self.assertNotEqual(self.moving_for_it(team, first), first)
            self.assertLess(team.clock.seconds() - started_at, 3.0, seed)

    def moving_for_it(self, team: SimulatedTeam, besides: str) -> str:
        """Return the first dog except ``besides`` that holds a lease and moves."""

        def going() -> list[str]:
            acting = [
                name
                for name in team.DOGS
                if (part := getattr(team.services[name].assembly.agent, "engagement", None)) is not None
                and part.me.status == EXECUTING
            ]
            return [name for name in self.moving(team) if name in acting and name != besides]

        self.until(team, lambda: bool(going()), 60.0)
        return going()[0]


class TakeoverObserverTests(SynchronousTestCase):
    def judge(self, cause: Cause = Cause.CRASH) -> TakeoverObserver:
        """Return an observer of the loss of dog1 at 100 s; its limit is 25 s, and it observes for 1 s after the end."""
        return TakeoverObserver(cause, 1, "dog1", 100.0, random.Random(1), 25.0, 1.0)

    def test_counts_from_the_loss(self) -> None:
        """The takeover ends when another dog moves.

        Simultaneous motion and motion of the lost dog are counted separately.
        """
        judge = self.judge()
        looks = [["dog1"], [], ["dog2"], ["dog1", "dog2"], ["dog1"], ["dog3"]]
        for number, moving in enumerate(looks, start=1):
            judge.record(100.0 + number, moving, None)
        self.assertEqual(judge.make_trial(), Trial("crash", 1, "dog1", "", False, 3.0, 1, 2))

    def test_goes_on_after_the_end(self) -> None:
        """A trial is over a second after the result, or at the time limit."""
        judge = self.judge()
        self.assertFalse(judge.is_over(124.9))
        self.assertTrue(judge.is_over(125.0))
        for now in (103.0, 103.5):
            judge.record(now, ["dog2"], Result(COMPLETED, "dog2"))
        self.assertFalse(judge.is_over(103.9))
        self.assertTrue(judge.is_over(104.0))
        self.assertEqual(judge.make_trial(), Trial("crash", 1, "dog1", "dog2", True, 3.0, 0, 0))

    def test_thaws_the_frozen_once(self) -> None:
        """A trial thaws only a frozen dog, and only once; the trial does not end before the thaw."""
        judge = self.judge(Cause.FREEZE)
        self.assertFalse(judge.is_over(999.0))
        self.assertEqual([judge.take_thaw(now) for now in (102.9, 105.1, 105.2)], [False, True, False])
        self.assertTrue(judge.is_over(999.0))
        self.assertFalse(self.judge().take_thaw(105.1))


class ReportTests(SynchronousTestCase):
    def trials(self, *seconds: float | None) -> list[Trial]:
        """Return crash trials with these takeover times."""
        return [Trial("crash", n, "dog1", "dog2", s is not None, s, 0, 0) for n, s in enumerate(seconds)]

    def test_table_says_who_held_and_whether_the_target_is_reached(self) -> None:
        """The line of each cause contains the counts and percentiles, and whether the target is met."""
        line = format_table(self.trials(1.0, 1.2, 1.4, None)).splitlines()[1].split()
        self.assertEqual(line[:7], ["crash", "4", "3", "1.20", "1.40", "1.40", "1.40"])
        self.assertEqual(line[-1], "yes")
        self.assertTrue(format_table(self.trials(1.0, 2.1)).endswith("no"))

    def test_zombie_is_no_success(self) -> None:
        """A trial fails if the lost dog moves after the takeover, or if the lost dog completes the task."""
        self.assertFalse(Trial("freeze", 1, "dog1", "dog2", True, 1.0, 0, 1).has_passed)
        self.assertFalse(Trial("freeze", 1, "dog1", "dog1", True, 1.0, 0, 0).has_passed)

    def test_picture_has_a_bar_for_each_tenth(self) -> None:
        """The histogram has a bar for each tenth of a second; the largest bin has the highest bar."""
        picture = draw_svg(self.trials(1.01, 1.02, 1.55))
        self.assertIn('height="60.0"', picture)
        self.assertIn('height="30.0"', picture)
