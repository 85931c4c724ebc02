"""Conformance: what every driver must hold to, as tests that anyone can run on one's own robot.

::

    class RoverTests(Conformance, SynchronousTestCase):
        bench = partial(MemoryBench, Rover, Emulator, {"host": "rover"})

or, without a test case, ``broken(partial(MemoryBench, ...))``, which gives a line for each rule that is broken.  Who
has a bench of another kind gives ``bench`` a function that makes that, or is the bench oneself: a test case with the
methods of ``Bench``.

What only senses (a description without limits) is held to the same rules but those of motion.
"""

from __future__ import annotations

from typing import Any, cast

from drivers.bench import Bench, MemoryBench, StandIn
from drivers.rules import (
    CHECKS,
    Breach,
    Faulty,
    broken,
    check_clips,
    check_connects,
    check_counts,
    check_deadline,
    check_describes,
    check_ends,
    check_invoke,
    check_keeps,
    check_leaves,
    check_link,
    check_motors,
    check_refuses,
    check_stops,
    check_subscribers,
    check_times,
    check_token,
)

__all__ = ["CHECKS", "Bench", "Breach", "Conformance", "Faulty", "MemoryBench", "StandIn", "broken"]


class Conformance:
    """Tests to be mixed into a test case that says ``bench = ...``, or that is a ``Bench`` itself."""

    bench: Any = None
    settle_s = 0.3

    def test_describes(self) -> None:
        """It says what its robot is and can do before it connects."""
        check_describes(self._bench())

    def test_connects(self) -> None:
        """The Deferred of connect fires with the first observation."""
        check_connects(self._bench())

    def test_motors(self) -> None:
        """Nothing moves before enable and after disable."""
        check_motors(self._bench())

    def test_clips(self) -> None:
        """What act returns is what is really done, within the limits."""
        check_clips(self._bench())

    def test_keeps(self) -> None:
        """What an action does not name stays as it was, and is zero after a stop."""
        check_keeps(self._bench())

    def test_refuses(self) -> None:
        """Unknown keys and what is no number are refused, and nothing moves."""
        check_refuses(self._bench())

    def test_deadline(self) -> None:
        """The robot moves until its deadline, and no longer."""
        check_deadline(self._bench())

    def test_token(self) -> None:
        """A lower token and a passed deadline are refused and counted."""
        check_token(self._bench())

    def test_stops(self) -> None:
        """Stop is never refused, and brings the motion to rest."""
        check_stops(self._bench())

    def test_ends(self) -> None:
        """Disconnect stops the motion, may be called twice, and is for good."""
        check_ends(self._bench())

    def test_leaves(self) -> None:
        """After disconnect nothing is left on the clock."""
        check_leaves(self._bench())

    def test_link(self) -> None:
        """A lost link stops the motion; it comes back by itself, at rest."""
        check_link(self._bench())

    def test_times(self) -> None:
        """Observations come in the order of time."""
        check_times(self._bench())

    def test_subscribers(self) -> None:
        """Each subscriber is told until it leaves, whatever another one does."""
        check_subscribers(self._bench())
        # Under trial what a driver logs of a faulty subscriber fails the test, unless it is expected.
        getattr(self, "flushLoggedErrors", lambda _: None)(Faulty)

    def test_counts(self) -> None:
        """Diagnostics are numbers under the agreed names."""
        check_counts(self._bench())

    def test_invoke(self) -> None:
        """A skill that there is not is refused."""
        check_invoke(self._bench())

    def _bench(self) -> Bench:
        bench = type(self).bench
        return cast(Bench, self if bench is None else bench())
