"""Tests of ``middleware.consensus.report_view``, which selects the fields of members that a strategy reads."""

from __future__ import annotations

from dataclasses import replace

from twisted.trial.unittest import SynchronousTestCase

from middleware.consensus.guarded_strategy import GuardedStrategy
from middleware.consensus.report_view import ReportView, make_view
from middleware.consensus.strategies.nearest import Nearest
from middleware.consensus.strategy import BUILT_IN, READABLE, Report, digest_of, load_strategy
from middleware.tasks.task import Member

FULL = Member(
    "a", "dog", "WAITING", 2.5, load=3, battery=0.5, value=(1.0, 2.0), choice="red", weight=2.0, electorate=5.0
)


class ReportViewTests(SynchronousTestCase):
    def test_only_what_is_read_is_shown(self) -> None:
        """A strategy gets only the fields that it declares, or all fields if it declares no fields."""
        self.assertEqual(make_view(Nearest()).make_report(FULL), Report("a", 2.5))
        self.assertEqual(ReportView(("battery", "load")).make_report(FULL), Report("a", 2.5, battery=0.5, load=2.0))
        whole = Report("a", 2.5, value=(1.0, 2.0), choice="red", weight=2.0, electorate=5.0, battery=0.5, load=2.0)
        self.assertEqual(make_view(object()).make_report(FULL), whole)
        self.assertEqual(make_view(GuardedStrategy(load_strategy("average"))).reads, ("value", "weight"))

    def test_odd_wishes_are_none(self) -> None:
        """Unknown fields in the declaration of a strategy are ignored."""

        class Odd(Nearest):
            reads: tuple[str, ...] = ("cost", "battery", "uuid")

        self.assertEqual(make_view(Odd()).reads, ("battery",))
        Odd.reads = 5  # type: ignore[assignment]
        self.assertEqual(make_view(Odd()).reads, READABLE)

    def test_record_and_bid_are_one_report(self) -> None:
        """A member's record and its bid give the same report, with the same digest."""
        for name in BUILT_IN:
            view = make_view(load_strategy(name))
            bid = view.make_report(FULL)
            assert bid is not None
            heard = view.apply_report(Member("a", "dog", "WAITING", load=3), bid)
            self.assertEqual(view.make_report(heard), bid, name)
        whole = make_view(object())
        coarse = whole.make_report(replace(FULL, battery=1, weight=2, value=(1, 2)))
        fine = whole.make_report(replace(FULL, battery=1.0, weight=2.0, value=(1.0, 2.0)))
        assert coarse is not None and fine is not None
        self.assertEqual(digest_of([coarse]), digest_of([fine]))

    def test_bid_that_is_unlawful_changes_nothing(self) -> None:
        """A bid with an invalid number, position or text does not change the values of the record."""
        view = make_view(object())
        for bad in (
            Report("a", float("nan")),
            Report("a", 1.0, battery=1.5),
            Report("a", 1.0, value=("x",)),  # type: ignore[arg-type]
            Report("a", 1.0, value=(float("inf"),)),
            Report("a", 1.0, weight=-1.0),
            Report("a", 1.0, choice="\x1b[2J"),
        ):
            self.assertEqual(view.apply_report(FULL, bad), FULL, bad)

    def test_who_reports_nothing_is_shown_to_nobody(self) -> None:
        """A member without a cost has no report."""
        self.assertIsNone(make_view(object()).make_report(replace(FULL, cost=None)))
