"""Tests of ``middleware.deployment.frame``: messages to and from a module's process."""

from __future__ import annotations

import random

from twisted.trial.unittest import SynchronousTestCase

from middleware.deployment.frame import MAX_ANSWER, BadFrame, Splitter, pack, unpack_answer, unpack_question


class FrameTests(SynchronousTestCase):
    def test_stream_is_split(self) -> None:
        """Messages are decoded whole, however the stream is split."""
        messages = [pack([number, True, b"x" * number]) for number in range(20)]
        stream, dice, splitter, found = b"".join(messages), random.Random(1), Splitter(MAX_ANSWER), []
        while stream:
            size = dice.randint(1, 30)
            found += splitter.feed(stream[:size])
            stream = stream[size:]
        self.assertEqual([unpack_answer(each)[0] for each in found], list(range(20)))

    def test_too_large_is_refused_unread(self) -> None:
        """A length above the limit is refused before the content arrives."""
        self.assertRaises(BadFrame, Splitter(10).feed, b"\0\0\0\x0b")

    def test_nonsense(self) -> None:
        """Any bytes are a message or raise ``BadFrame``."""
        dice = random.Random(2)
        for _ in range(2000):
            data = dice.randbytes(dice.randint(0, 30))
            for read in (unpack_answer, unpack_question):
                try:
                    read(data)
                except BadFrame:
                    continue
        self.assertRaises(BadFrame, pack, object())
        self.assertRaises(BadFrame, unpack_answer, b"\x91" * 5000)
