"""Attack S6: send arbitrary bytes to every decoder, in a short run of every target of ``tests/fuzz``."""

from __future__ import annotations

import random
import time
from collections.abc import Callable

from hypothesis import given, settings
from hypothesis import strategies as st
from twisted.trial.unittest import SynchronousTestCase

from tests.fuzz import carried, decoder, envelope, handshake, paper, raw
from tests.fuzz.ground import Violation
from tests.fuzz.runner import mutated, seeds

TARGETS: dict[str, tuple[Callable[[bytes], None], int]] = {
    "raw": (raw.check, 150),
    "envelope": (envelope.check, 150),
    "handshake": (handshake.check, 100),
    "decoder": (decoder.check, 1000),
    "paper": (paper.check, 3000),
    "carried": (carried.check, 600),
}
BOUNDED = settings(max_examples=120)
SLOWEST_S = 0.25
"""Maximum duration of one input in seconds, on a busy machine; an idle machine needs about a millisecond."""


class MutationTests(SynchronousTestCase):
    """No input raises or is logged, a rejected input changes nothing, and no reply is longer than its request."""

    def test_every_target(self) -> None:
        """The stored inputs, and some mutations of them, cause no violation in any target."""
        for name, (check, count) in TARGETS.items():
            with self.subTest(target=name):
                inputs, dice = seeds(name), random.Random(f"s6/{name}/1")
                self.assertGreater(len(inputs), 5)
                for data in inputs + [mutated(dice, inputs) for _ in range(count)]:
                    check(data)

    @BOUNDED
    @given(st.integers(0, 255), st.binary(max_size=200))
    def test_any_paper(self, kind: int, data: bytes) -> None:
        """Arbitrary bytes in place of a statement, certificate, join request or join reply cause no violation."""
        paper.check(bytes([kind]) + data)

    def test_paper_is_quick(self) -> None:
        """Invalid statements, certificates, join requests and join replies are rejected quickly, even large ones."""
        dice = random.Random(8)
        large = [bytes([kind]) + dice.randbytes(65_000) for kind in range(4)]
        large += [bytes([kind]) + b"\x91" * 65_000 for kind in range(4)]
        large += [bytes([kind]) + b"\xdd\xff\xff\xff\xff" * 10_000 for kind in range(4)]
        for data in large:
            began = time.thread_time()
            paper.check(data)
            self.assertLess(time.thread_time() - began, SLOWEST_S)

    def test_the_targets_notice(self) -> None:
        """The target ``paper`` accepts valid inputs, and reports an accepted input that it takes for a forgery."""
        for kind, each in paper.LAWFUL.items():
            for place, whole in enumerate(each):
                paper.check(bytes([paper.KINDS.index(kind) + 4 * place]) + whole)
        self.patch(paper, "GENUINE", set())
        for kind in ("statement", "pass", "knock", "welcome"):
            whole = paper.LAWFUL[kind][0]
            self.assertRaises(Violation, paper.check, bytes([paper.KINDS.index(kind)]) + whole)
