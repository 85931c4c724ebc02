"""Tests of ``formats.head``."""

from __future__ import annotations

from twisted.trial.unittest import SynchronousTestCase

from formats.head import MAX_HEAD_BYTES, encode_head, pop_head


class HeadTests(SynchronousTestCase):
    def test_one_is_made_and_read(self) -> None:
        """The first line and the fields are parsed; case and surrounding blanks do not matter."""
        buffer = bytearray(encode_head("GET / HTTP/1.1", "Host: h:1", "uPgrade:  x , y  ") + b"rest")
        found = pop_head(buffer)
        assert found is not None
        self.assertEqual(found.first, b"GET / HTTP/1.1")
        self.assertEqual(found.fields, {b"host": b"h:1", b"upgrade": b"x , y"})
        self.assertEqual(bytes(buffer), b"rest")

    def test_the_end_is_waited_for(self) -> None:
        """An incomplete header and a header above the size limit give None."""
        whole = encode_head("HTTP/1.1 200 OK", "Server: x")
        for length in range(len(whole)):
            self.assertIsNone(pop_head(bytearray(whole[:length])))
        longest = b"x" * (MAX_HEAD_BYTES - 4) + b"\r\n\r\n"
        self.assertIsNotNone(pop_head(bytearray(longest)))
        self.assertIsNone(pop_head(bytearray(b"x" + longest)))

    def test_said_for_people(self) -> None:
        """The description is the start of the first line as text, even if this line has invalid bytes or is empty."""
        for bare, said in ((b"SSH-2.0-box", "SSH-2.0-box"), (b"", ""), (b"\xff" + b"x" * 99, "\ufffd" + "x" * 59)):
            found = pop_head(bytearray(bare + b"\r\n\r\n"))
            assert found is not None
            self.assertEqual((found.summary, found.fields), (said, {}))
