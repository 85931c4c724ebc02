"""Tests of ``middleware.deployment.module_channel``: messages between a node and a module's process."""

from __future__ import annotations

import random

from twisted.trial.unittest import SynchronousTestCase

from middleware.deployment.module_channel import (
    MAX_REPLY_BYTES,
    BadFrame,
    FrameSplitter,
    pack,
    parse_reply,
    parse_request,
)


class ModuleChannelTests(SynchronousTestCase):
    def test_stream_is_split(self) -> None:
        """Messages are decoded completely, however the stream is split into chunks."""
        messages = [pack([number, True, b"x" * number]) for number in range(20)]
        stream, dice, splitter, found = b"".join(messages), random.Random(1), FrameSplitter(MAX_REPLY_BYTES), []
        while stream:
            size = dice.randint(1, 30)
            found += splitter.feed(stream[:size])
            stream = stream[size:]
        self.assertEqual([parse_reply(each)[0] for each in found], list(range(20)))

    def test_too_large_is_refused_unread(self) -> None:
        """A message length above the limit is rejected before the content arrives."""
        self.assertRaises(BadFrame, FrameSplitter(10).feed, b"\0\0\0\x0b")

    def test_nonsense(self) -> None:
        """Any bytes are decoded as messages or raise ``BadFrame``."""
        dice = random.Random(2)
        for _ in range(2000):
            data = dice.randbytes(dice.randint(0, 30))
            for read in (parse_reply, parse_request):
                try:
                    read(data)
                except BadFrame:
                    continue
        self.assertRaises(BadFrame, pack, object())
        self.assertRaises(BadFrame, parse_reply, b"\x91" * 5000)
