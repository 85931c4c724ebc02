"""Tests of ``agents.conference`` and ``agents.conference``: rounds of a task, and what counts of what is heard."""

from __future__ import annotations

from dataclasses import replace

from twisted.trial.unittest import SynchronousTestCase

from agents.conference import LINGERING, Circle, Epoch
from middleware.tasks.task import Member

B = Member("b", "dog2", "WAITING", 2.0, "a", "d1", epoch=3, serial=1)


class EpochTests(SynchronousTestCase):
    def test_first_decision_opens_no_round(self) -> None:
        """Until somebody is named nothing raises the number, and the first name does not either."""
        epoch = Epoch()
        for basis in (("a",), ("a", "b")):
            self.assertEqual(epoch.decide(basis, "", "", ()), 0)
        self.assertEqual(epoch.decide(("a", "b", 1), "a", "d1", ()), 0)

    def test_change_after_a_decision_opens_a_round(self) -> None:
        """What a decision depends on changes: a new round, one for each change and none without."""
        epoch = Epoch()
        epoch.decide((1,), "a", "d1", ())
        self.assertEqual([epoch.decide((n,), "a", "d1", ()) for n in (1, 2, 2, 3)], [0, 1, 1, 2])

    def test_same_decision_joins_the_round_of_another(self) -> None:
        """Who comes to the decision that another has already told in a newer round joins it."""
        epoch = Epoch()
        epoch.decide((1,), "a", "d0", ())
        epoch.hear(3)
        self.assertEqual(epoch.decide((2,), "a", "d1", (B,)), 3)
        epoch.hear(5)
        self.assertEqual(epoch.decide((3,), "b", "d1", (replace(B, epoch=5),)), 6)


class CircleTests(SynchronousTestCase):
    def costs(self, circle: Circle, now: float) -> dict[str, float | None]:
        """What counts now."""
        return {member.uuid: member.cost for member in circle.members(now)}

    def test_old_round_is_ignored(self) -> None:
        """A report of an older round changes nothing, whenever it comes; a newer one does."""
        circle = Circle("a")
        circle.hear([B], 0.0)
        circle.hear([replace(B, cost=9.0, epoch=2, serial=7)], 1.0)
        self.assertEqual(self.costs(circle, 1.0), {"b": 2.0})
        circle.hear([replace(B, cost=1.0, epoch=4, serial=0)], 2.0)
        self.assertEqual(self.costs(circle, 2.0), {"b": 1.0})

    def test_who_left_is_forgotten_after_a_while(self) -> None:
        """A late report of one that left is known to be old; a new life is heard when the old one is forgotten."""
        circle = Circle("a")
        circle.hear([B], 0.0)
        circle.hear([], 1.0)
        again = replace(B, epoch=0, serial=0)
        circle.hear([again], 1.5)
        self.assertEqual(len(circle), 0)
        circle.hear([again], 1.0 + LINGERING + 0.1)
        self.assertEqual(len(circle), 1)

    def test_stale_report_is_no_bid(self) -> None:
        """A bid counts for as long as it is valid, less its age when it was told, and again when it is renewed."""
        circle = Circle("a")
        bid = replace(B, valid_for=3.0, age=1.0)
        circle.hear([bid], 10.0)
        self.assertEqual(self.costs(circle, 12.0), {"b": 2.0})
        circle.hear([bid], 12.1)  # the same record once more is no news
        self.assertEqual(self.costs(circle, 12.1), {"b": None})
        circle.hear([replace(bid, serial=2)], 12.2)
        self.assertEqual(self.costs(circle, 12.3), {"b": 2.0})

    def test_own_report_comes_back(self) -> None:
        """The own report is kept apart: of an older life, it says where the others' counting stands."""
        circle = Circle("b")
        circle.hear([B], 0.0)
        self.assertEqual((len(circle), circle.echo), (0, B))
