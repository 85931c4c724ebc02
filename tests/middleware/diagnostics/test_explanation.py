"""Tests of ``middleware.diagnostics.explanation``, which combines the agents' decision records."""

from __future__ import annotations

import random
from dataclasses import replace

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.decision_record import MAX_BEST_REPORTS, MAX_REPORTS
from middleware.diagnostics.explanation import explain_decisions, format_explanation
from tests.middleware.consensus.test_decision_record import THREE, decided, member

OWN = [decided(n, THREE) for n in (1, 2, 3)]


class ExplanationTests(SynchronousTestCase):
    def test_all_agree(self) -> None:
        """If three agents have the same reports, they agree, and the explanation lists no differences."""
        (ruling,) = explain_decisions([decided(n, THREE) for n in (1, 2, 3)]).epochs
        self.assertEqual((ruling.chosen, ruling.agree, ruling.of), ("dog2", ("dog1", "dog2", "dog3"), 3))
        self.assertEqual(ruling.differ, ())
        text = format_explanation(explain_decisions([decided(n, THREE) for n in (1, 2, 3)]))
        self.assertTrue(text.startswith("epoch 1: dog2, 3 of 3 agree\n  by nearest 1 from reports "), text)

    def test_who_differs_and_in_what(self) -> None:
        """The explanation lists each agent whose winner, reports or version differ, with the difference."""
        missed = [THREE[0], THREE[2]]
        moved = [THREE[0], THREE[1], member(3, 1.25)]
        for other, what in (
            (decided(3, missed), "names dog3; knew no report of dog2"),
            (decided(3, moved), "knew dog3 at 1.25, not 1.00"),
            (decided(3, [*THREE, member(4, 9.0)]), "knew a report of dog4"),
            (decided(3, THREE, version="2"), "decided by nearest 2, not nearest 1"),
        ):
            (ruling,) = explain_decisions([decided(1, THREE), decided(2, THREE), other]).epochs
            self.assertEqual([(d.name, d.what) for d in ruling.differ], [("dog3", what)])
            self.assertEqual(ruling.chosen, "dog2")
        text = format_explanation(explain_decisions([decided(1, THREE), decided(2, THREE), decided(3, missed)]))
        self.assertIn("2 of 3 agree", text)
        self.assertIn("dog3 differs: names dog3; knew no report of dog2", text)

    def test_agreement_is_told(self) -> None:
        """The explanation contains the agreed choice.

        It lists each agent that agreed on a different value, with that value.
        """
        known = [
            replace(each, reports=(replace(each.reports[0], more="battery 40%"), *each.reports[1:])) for each in OWN
        ]
        agreed = [replace(each, choice="red") for each in known]
        text = format_explanation(explain_decisions(agreed))
        self.assertIn("\n  agreed on red\n", text)
        self.assertIn("0.50  *  battery 40%\n", text)
        (ruling,) = explain_decisions([*agreed[:2], replace(agreed[2], choice="", value=(1.0, 2.5))]).epochs
        self.assertEqual([(d.name, d.what) for d in ruling.differ], [("dog3", "agreed on (1.00, 2.50)")])
        odd = replace(OWN[2], digest="other", choice="red")
        (ruling,) = explain_decisions([*agreed[:2], odd]).epochs
        self.assertEqual([d.what for d in ruling.differ], ["knew dog2 with nothing more"])

    def test_silent_agent_is_named(self) -> None:
        """An agent that reported but has no decision record does not count as agreeing."""
        (ruling,) = explain_decisions([decided(1, THREE), decided(3, THREE)]).epochs
        self.assertEqual((len(ruling.agree), ruling.of), (2, 3))
        self.assertEqual([(d.name, d.what) for d in ruling.differ], [("dog2", "has no decision record")])

    def test_order_does_not_matter(self) -> None:
        """In any order of the decision records the explanation is the same and lists the newest epoch first."""
        records = [decided(n, THREE, epoch) for epoch in (1, 2, 3) for n in (1, 2, 3)]
        records[4] = decided(2, THREE[:1] + [THREE[1]], 2)
        expected = explain_decisions(records)
        self.assertEqual([ruling.epoch for ruling in expected.epochs], [3, 2, 1])
        rng = random.Random(2)
        for _ in range(10):
            rng.shuffle(records)
            self.assertEqual(explain_decisions(records), expected)

    def test_most_decide_whoever_dissents(self) -> None:
        """Two agents that agree outvote the third agent, for each of the three as dissenter."""
        for lone in (1, 2, 3):
            records = [decided(n, THREE, assigned=1 if n == lone else None) for n in (1, 2, 3)]
            (ruling,) = explain_decisions(records).epochs
            self.assertEqual((ruling.chosen, len(ruling.agree)), ("dog2", 2))
            self.assertEqual([(d.name, d.what) for d in ruling.differ], [(f"dog{lone}", "names dog1")])

    def test_even_votes_give_the_lowest(self) -> None:
        """If each of two agents names itself, the winner with the lower uuid counts, and one agent agrees."""
        first, second = decided(1, THREE, assigned=1), decided(2, THREE, assigned=2)
        (ruling,) = explain_decisions([first, second]).epochs
        self.assertEqual(ruling.winner, min(first.winner, second.winner))
        self.assertEqual(len(ruling.agree), 1)

    def test_nothing_decided(self) -> None:
        """Without decision records the explanation is empty. For an epoch without a winner the choice is ``nobody``."""
        self.assertEqual(format_explanation(explain_decisions([])), "")
        (ruling,) = explain_decisions([decided(1, [member(1, None)])]).epochs
        self.assertEqual((ruling.winner, ruling.chosen), ("", "nobody"))

    def test_of_many_the_best_are_asked(self) -> None:
        """In a group of more than thirty agents only the eight agents that write decision records are counted."""
        members = [member(i, float(i)) for i in range(1, MAX_REPORTS + 2)]
        told = [record for n in range(1, MAX_REPORTS + 2) if (record := decided(n, members)).is_publisher]
        (ruling,) = explain_decisions(told).epochs
        self.assertEqual((len(ruling.agree), ruling.of, ruling.differ), (MAX_BEST_REPORTS, MAX_BEST_REPORTS, ()))
