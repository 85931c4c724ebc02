"""Tests of ``webnode.limits``: what each address has open."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from webnode.limits import AddressLimits


class AddressLimitsTests(SynchronousTestCase):
    def test_count_each_address_for_itself(self) -> None:
        """An address that has as many as it may gets no more of that kind; another does, and it does once one ends."""
        limits = AddressLimits({"unfinished": 2, "stream": 1, "open": 9})
        for _ in range(2):
            self.assertTrue(limits.may("unfinished", "a"))
            limits.count("unfinished", "a", 1)
        self.assertFalse(limits.may("unfinished", "a"))
        self.assertTrue(limits.may("unfinished", "b") and limits.may("stream", "a"))
        limits.count("unfinished", "b", 1)
        self.assertEqual(limits.total("unfinished"), 3)
        limits.count("unfinished", "a", -1)
        self.assertTrue(limits.may("unfinished", "a"))

    def test_keep_nothing_of_who_has_left(self) -> None:
        """Of addresses that have nothing open nothing is kept, however many there were."""
        limits = AddressLimits()
        for number in range(1000):
            limits.may("open", str(number))
            limits.count("open", str(number), 1)
            limits.count("open", str(number), -1)
        self.assertEqual(len(limits._counts), 0)
