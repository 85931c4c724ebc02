"""Tests of the evaluation in ``benchmarks.nat``: criteria, table, document and figure. No trial runs."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from benchmarks.nat.matrix import list_plain_pairs, list_sites, list_special_pairs
from benchmarks.nat.outcome import LOSS, MATRIX, PLAIN, Outcome, check_requirements, format_cell, is_punchable
from benchmarks.nat.report import BEGIN, END, draw_svg, format_table, update_document
from sim.namespaces.nat import NatKind


def good(part: str = PLAIN) -> list[Outcome]:
    """Return the outcomes of a round that meets all criteria."""
    outcomes = []
    for pair in list_plain_pairs(part):
        is_direct = is_punchable(NatKind(pair.a), NatKind(pair.b))
        path = "direct" if is_direct else "tunnel" if "noudp" in (pair.a, pair.b) else "relayed"
        outcomes.append(Outcome(part, pair.a, pair.b, [0.1, 0.2 if is_direct else 2.1], path, joined_s=[0.1, 2.0]))
    return outcomes


class OutcomeTests(SynchronousTestCase):
    def test_thirteen_of_fifteen_pairs_can_be_punched(self) -> None:
        """Hole punching works for 13 of the 15 pairs of routers that pass UDP.

        The exceptions are a symmetric router with a symmetric router, and with a port restricted router.
        """
        pairs = [(a, b) for n, a in enumerate(MATRIX) for b in MATRIX[n:] if NatKind.NOUDP not in (a, b)]
        self.assertEqual(len(pairs), 15)
        closed = [(a.value, b.value) for a, b in pairs if not is_punchable(a, b)]
        self.assertEqual(closed, [("port", "sym"), ("sym", "sym")])

    def test_a_good_round_keeps_every_promise(self) -> None:
        """A good round meets all criteria.

        A pair that is relayed although its routers could be punched, or slow pairs, violate a criterion.
        """
        self.assertEqual([one for one in check_requirements([*good(), *good(LOSS)]) if not one.is_kept], [])
        relayed = good()
        relayed[0].path = "relayed"
        self.assertFalse(check_requirements(relayed)[0].is_kept)
        slow = good()
        for outcome in slow[:2]:
            outcome.took_s = [1.1, 0.1]
        self.assertEqual([one.is_kept for one in check_requirements(slow)], [True, False, True, True])
        late = good()
        late[-1].joined_s = [0.1, 2.6]
        self.assertEqual([one.is_kept for one in check_requirements(late)], [True, True, True, False])

    def test_one_of_twenty_may_fail_under_loss(self) -> None:
        """With packet loss, 95 percent of each class must succeed: one failure of 21 is permitted."""
        lossy = good(LOSS)
        lossy[0].took_s = [None, None]
        self.assertEqual(
            [one.is_kept for one in check_requirements(lossy)], [True, False, True]
        )  # 14 of 15: below 95 percent
        lossy[1].took_s = [5.1, 0.1]
        self.assertEqual([one.is_kept for one in check_requirements(lossy)], [False, False, True])
        blocked = good(LOSS)
        for outcome in [one for one in blocked if "noudp" in one.pair][:2]:
            outcome.took_s = [None, None]
        self.assertEqual([one.is_kept for one in check_requirements(blocked)], [False, True, False])

    def test_cell(self) -> None:
        """A table cell contains path kinds, median, maximum, and the number of failures."""
        some = [Outcome(PLAIN, "port", "port", [took], "direct") for took in (0.1, 0.3, None)]
        self.assertEqual(format_cell(some), "direct 0.20 (0.30), 1 of 3 fail")
        self.assertEqual((format_cell(some[2:]), format_cell([])), ("fails", ""))

    def test_report_and_document(self) -> None:
        """The table contains each kind of router.

        The document changes only between its marks; a document without marks is refused.
        """
        self.assertIn("noudp", format_table(good()))
        text = update_document(f"before\n{BEGIN}\nold\n{END}\nafter\n", good())
        self.assertTrue(text.startswith("before\n") and text.endswith("\nafter\n"))
        self.assertNotIn("old", text)
        self.assertIn("| none | direct 0.20 (0.20) |", text)
        self.assertEqual(update_document(text, good()), text)
        self.assertRaises(ValueError, update_document, "no marks", good())

    def test_picture_has_a_square_for_each_pair(self) -> None:
        """The figure has 21 squares, a frame and a legend; a failed pair is marked."""
        bad = good()
        bad[3].took_s = [None, None]
        picture = draw_svg(bad, "a < b")
        self.assertEqual(picture.count("<rect"), 21 + 1 + 4)
        self.assertIn("a &lt; b", picture)
        self.assertEqual(picture.count(">fails<"), 1)

    def test_every_host_of_a_pair_exists(self) -> None:
        """The sites of a run contain each host that belongs to a pair."""
        hosts = {f"{site.name}{number}" for site in list_sites() for number in range(1, site.hosts + 1)}
        pairs = [*list_plain_pairs(PLAIN), *list_special_pairs()]
        self.assertEqual({host for pair in pairs for host in (pair.host_a, pair.host_b)} - hosts, set())
