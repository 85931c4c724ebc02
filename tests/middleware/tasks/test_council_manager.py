"""Tests of ``middleware.tasks.council_manager``."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.tasks.council_manager import choose_successors
from tests.middleware.consensus.lease.test_lease_codec import MEMBERS


class VacancyTests(SynchronousTestCase):
    def filled(self, council: str, silent: str, candidates: str, size: int = 3) -> str | None:
        """Return the indexes of the members of the next council."""
        members, gone, others = ([MEMBERS[int(number)] for number in group] for group in (council, silent, candidates))
        following = choose_successors(members, gone, others, size)
        return None if following is None else "".join(str(MEMBERS.index(member)) for member in following)

    def test_silent_members_are_replaced(self) -> None:
        """Reachable members stay, and the first reachable candidates replace the silent members."""
        self.assertEqual(self.filled("012", "1", "45"), "024")
        self.assertEqual(self.filled("01234", "13", "0265", 5), "02465")

    def test_nothing_to_gain(self) -> None:
        """A council stays unchanged if all members reply, if no candidate replies, or if a change improves nothing."""
        self.assertIsNone(self.filled("012", "", "345"))
        self.assertIsNone(self.filled("012", "1", "02"))
        self.assertIsNone(self.filled("012", "", "3", 5))
        self.assertIsNone(self.filled("0", "", "1"))

    def test_grows(self) -> None:
        """The council of a team that was small grows to its full size when enough nodes are reachable."""
        self.assertEqual(self.filled("0", "", "12"), "012")
        self.assertEqual(self.filled("012", "", "34", 5), "01234")

    def test_shrinks(self) -> None:
        """A council of five that lost two members and has no candidate shrinks to three, and tolerates one failure."""
        self.assertEqual(self.filled("01234", "13", "024", 5), "024")
        self.assertEqual(self.filled("0123456", "012", "7", 7), "34567")
