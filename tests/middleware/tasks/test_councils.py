"""Tests of ``middleware.tasks.councils``."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.tasks.councils import filled
from tests.middleware.consensus.lease.test_lease_codec import MEMBERS


class VacancyTests(SynchronousTestCase):
    def filled(self, council: str, silent: str, candidates: str, size: int = 3) -> str | None:
        """The next council, its members by number."""
        seats, gone, others = ([MEMBERS[int(number)] for number in group] for group in (council, silent, candidates))
        following = filled(seats, gone, others, size)
        return None if following is None else "".join(str(MEMBERS.index(member)) for member in following)

    def test_silent_members_are_replaced(self) -> None:
        """Who is there stays, and the first of the others, in their order, takes the seat of who is not."""
        self.assertEqual(self.filled("012", "1", "45"), "024")
        self.assertEqual(self.filled("01234", "13", "0265", 5), "02465")

    def test_nothing_to_gain(self) -> None:
        """A council stays where all are there, or nobody is who could come, or one more could lose no more than now."""
        self.assertIsNone(self.filled("012", "", "345"))
        self.assertIsNone(self.filled("012", "1", "02"))
        self.assertIsNone(self.filled("012", "", "3", 5))
        self.assertIsNone(self.filled("0", "", "1"))

    def test_grows(self) -> None:
        """A council that was made when the team was small has all its seats taken as soon as enough are there."""
        self.assertEqual(self.filled("0", "", "12"), "012")
        self.assertEqual(self.filled("012", "", "34", 5), "01234")

    def test_shrinks(self) -> None:
        """Five of whom two are gone, with nobody to follow: three, of which one may be lost; five could lose none."""
        self.assertEqual(self.filled("01234", "13", "024", 5), "024")
        self.assertEqual(self.filled("0123456", "012", "7", 7), "34567")
