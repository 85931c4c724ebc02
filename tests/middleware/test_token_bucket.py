"""Tests of ``middleware.entangled.token_bucket``, a rate limit."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.token_bucket import TokenBucket


class TokenBucketTests(SynchronousTestCase):
    def test_so_many_at_once_and_so_many_a_second(self) -> None:
        """A full bucket permits a burst (by default the tokens of one second), and refills up to its capacity."""
        bucket = TokenBucket(2.0)
        self.assertEqual([bucket.take(0.0) for _ in range(3)], [True, True, False])
        bucket = TokenBucket(2.0, 3.0)
        self.assertEqual([bucket.take(10.0) for _ in range(4)], [True, True, True, False])
        self.assertEqual([bucket.take(10.5), bucket.take(10.5)], [True, False])
        self.assertEqual([bucket.take(100.0) for _ in range(4)], [True, True, True, False])

    def test_take_much(self) -> None:
        """A request for more tokens than the bucket contains takes no tokens; a smaller request still succeeds."""
        bucket = TokenBucket(2.0, 4.0)
        self.assertEqual([bucket.take(0.0, 5.0), bucket.take(0.0, 3.0), bucket.take(0.0, 2.0)], [False, True, False])
        self.assertEqual([bucket.take(0.5, 2.0), bucket.take(0.5, 0.5)], [True, False])

    def test_clock_set_back(self) -> None:
        """If the clock is set back, the bucket neither gains nor loses tokens, and refills from the new time on."""
        bucket = TokenBucket(2.0, 3.0)
        self.assertTrue(bucket.take(10.0, 2.0))
        self.assertEqual([bucket.take(5.0), bucket.take(5.0), bucket.take(5.5)], [True, False, True])

    def test_give(self) -> None:
        """Returned tokens can be taken again, up to the capacity."""
        bucket = TokenBucket(1.0, 2.0)
        self.assertTrue(bucket.take(0.0, 2.0))
        bucket.refund()
        self.assertEqual([bucket.take(0.0), bucket.take(0.0)], [True, False])
        for _ in range(9):
            bucket.refund()
        self.assertEqual([bucket.take(0.0, 2.0), bucket.take(0.0)], [True, False])

    def test_full(self) -> None:
        """A bucket is full initially, and again after all taken tokens were refilled."""
        bucket = TokenBucket(2.0, 4.0)
        self.assertTrue(bucket.is_full(0.0))
        bucket.take(7.0, 3.0)
        self.assertEqual([bucket.is_full(moment) for moment in (7.0, 8.0, 8.5)], [False, False, True])
