"""Tests of ``webnode.limits``: the limits of each address."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from webnode.limits import AddressLimits


class AddressLimitsTests(SynchronousTestCase):
    def test_count_each_address_for_itself(self) -> None:
        """An address at its limit gets no more connections of that kind until one ends.

        Other addresses are not affected.
        """
        limits = AddressLimits({"unfinished": 2, "stream": 1, "open": 9})
        for _ in range(2):
            self.assertTrue(limits.can_open("unfinished", "a"))
            limits.count("unfinished", "a", 1)
        self.assertFalse(limits.can_open("unfinished", "a"))
        self.assertTrue(limits.can_open("unfinished", "b") and limits.can_open("stream", "a"))
        limits.count("unfinished", "b", 1)
        self.assertEqual(limits.get_total("unfinished"), 3)
        limits.count("unfinished", "a", -1)
        self.assertTrue(limits.can_open("unfinished", "a"))

    def test_keep_nothing_of_who_has_left(self) -> None:
        """Addresses without open connections use no memory."""
        limits = AddressLimits()
        for number in range(1000):
            limits.can_open("open", str(number))
            limits.count("open", str(number), 1)
            limits.count("open", str(number), -1)
        self.assertEqual(len(limits._counts), 0)
