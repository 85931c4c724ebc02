"""Tests of ``formats.jpeg``."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from formats.jpeg import size_of
from tests.webnode.picture import jpeg


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

    def test_reads_the_size(self) -> None:
        """Of a whole JPEG, behind other segments, fill bytes and bare marks; of nothing else."""
        self.assertEqual(size_of(jpeg(128, 96)), (128, 96))
        self.assertEqual(size_of(b"\xff\xd8\xff\xff\x01" + jpeg(128, 96)[2:]), (128, 96))
        for data in (
            b"",
            jpeg()[:-1],
            jpeg()[1:],
            jpeg(128, 0),
            jpeg(0, 96),
            b"\xff\xd8\xff\xd9",
            b"\xff\xd8" + bytes(20) + b"\xff\xd9",
        ):
            self.assertIsNone(size_of(data))
        self.assertIsNone(size_of(b"\xff\xd8\xff\xe0\x00\x01" + bytes(9) + b"\xff\xd9"))
        self.assertIsNone(size_of(b"\xff\xd8\xff\xda\x00\x04" + bytes(9) + b"\xff\xd9"))

    @settings(derandomize=True, database=None, deadline=None, max_examples=100)
    @given(st.binary(max_size=40))
    def test_any_bytes(self, data: bytes) -> None:
        """Whatever stands between the ends of a JPEG, it has a size or none."""
        size = size_of(b"\xff\xd8" + data + b"\xff\xd9")
        self.assertTrue(size is None or min(size) > 0)
