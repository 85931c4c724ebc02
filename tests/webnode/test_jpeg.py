"""Tests of ``webnode.jpeg``."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from tests.webnode.picture import jpeg
from webnode.jpeg import size_of


class JpegTests(SynchronousTestCase):
    def test_size_of_a_picture(self) -> None:
        """The size stands in the header, past whatever else stands there; bytes that are no picture have none."""
        self.assertEqual(size_of(jpeg(208, 156)), (208, 156))
        padded = b"\xff\xd8\xff\xff\xd0\xff\xdb\x00\x04zz" + jpeg(10, 20)[2:]
        self.assertEqual(size_of(padded), (10, 20))
        whole = jpeg()
        for n in range(len(whole)):
            self.assertIsNone(size_of(whole[:n]))
        self.assertIsNone(size_of(b"\xff\xd8" + b"\xff" * 50 + b"\xff\xd9"))
