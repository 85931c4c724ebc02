"""Tests of ``formats.jpeg``."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from formats.jpeg import read_size
from tests.webnode.picture import jpeg


class JpegTests(SynchronousTestCase):
    def test_size_of_a_picture(self) -> None:
        """The size of a complete JPEG is found, even after other segments, fill bytes and bare markers.

        Data that is not a JPEG has no size.
        """
        self.assertEqual(read_size(jpeg(208, 156)), (208, 156))
        for before in (b"\xff\xff\xd0\xff\xdb\x00\x04zz", b"\xff\xff\x01"):
            self.assertEqual(read_size(b"\xff\xd8" + before + jpeg(10, 20)[2:]), (10, 20))
        whole = jpeg()
        broken = [whole[:n] for n in range(len(whole))] + [whole[1:], jpeg(128, 0), jpeg(0, 96)]
        between = (b"", bytes(20), b"\xff" * 50, b"\xff\xe0\x00\x01" + bytes(9), b"\xff\xda\x00\x04" + bytes(9))
        for data in broken + [b"\xff\xd8" + middle + b"\xff\xd9" for middle in between]:
            self.assertIsNone(read_size(data), data[:20])

    @settings(max_examples=100)
    @given(st.binary(max_size=40))
    def test_any_bytes(self, data: bytes) -> None:
        """For any bytes between the start and end markers of a JPEG, the result is a size or None."""
        size = read_size(b"\xff\xd8" + data + b"\xff\xd9")
        self.assertTrue(size is None or min(size) > 0)
