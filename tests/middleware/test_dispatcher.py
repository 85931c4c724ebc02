"""Tests of the call features of ``Dispatcher``: deadline, cancellation, typed errors and checked types."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import CancelledError, Deferred

from middleware.entangled.contact import Contact
from middleware.entangled.errors import NoAnswer, Refused
from middleware.entangled.wire.message import NO_LIMIT_MS, Cancel, Request, decode, encode, set_remaining_time
from tests.middleware.test_endpoint import DELAY, EndpointCase


class CallTests(EndpointCase):
    """Tests of ``Dispatcher``."""

    def setUp(self) -> None:
        """Open a session."""
        super().setUp()
        self.ended: list[str] = []
        self.works: list[Deferred[Any]] = []
        self.got(self.a.ask(self.to_b, "echo", 1))

    def equip(self, endpoint: Any) -> None:
        """Register slow methods, and a method that gets the deadline."""
        super().equip(endpoint)
        endpoint.expose("slow", self.slow)
        endpoint.expose("slow change", self.slow, changes=True)
        endpoint.expose("crawl", self.crawl)
        endpoint.expose("when", self.when)
        endpoint.expose("busy", self.occupied)

    def slow(self, peer: Contact) -> Deferred[Any]:
        """Return a Deferred that never fires."""
        work: Deferred[Any] = Deferred()
        work.addErrback(self.note)
        self.works.append(work)
        return work

    def note(self, failure: Any) -> Any:
        """Record the type of the failure."""
        self.ended.append(failure.type.__name__)
        return failure

    async def crawl(self, peer: Contact) -> None:
        """Wait forever, as a coroutine."""
        try:
            await Deferred()
        except CancelledError:
            self.ended.append("coroutine")
            raise

    def when(self, peer: Contact, *, deadline: float) -> float:
        """Return for how many more seconds the caller waits for the reply."""
        return deadline - self.clock.seconds()

    def occupied(self, peer: Contact) -> None:
        """Reject the call."""
        raise Refused("with a bone", self.code)

    def test_cancelling_reaches_the_method(self) -> None:
        """Cancelling the Deferred of ``ask`` also cancels the method's work, after the one-way delay.

        The method may have returned a Deferred or a coroutine.
        """
        for name, how in (("slow", "CancelledError"), ("slow change", "CancelledError"), ("crawl", "coroutine")):
            asked = self.a.ask(self.to_b, name, timeout=60.0, changes=name == "slow change")
            self.clock.advance(1.0)
            asked.cancel()
            self.failureResultOf(asked, CancelledError)
            self.clock.advance(DELAY)
            self.assertEqual(self.ended.pop(), how)
        self.clock.advance(70)
        self.assertEqual([account.running for account in self.b._dispatcher._history._peers.values()], [{}])

    def test_cancel_overtakes_its_question(self) -> None:
        """A request that arrives after its cancellation does not run."""
        session = next(iter(self.a._sessions.values()))
        late = session.seal(encode(Request(5, "add", (1,))))
        receive = self.taps[self.to_b.address].receiver
        receive(session.seal(encode(Cancel(5))), self.to_a.address)
        receive(late, self.to_a.address)
        self.assertEqual((self.runs, self.b.counters["cancelled"]), ([], 1))

    def test_a_stranger_cancels_nothing(self) -> None:
        """A peer cannot cancel another peer's request."""
        asked = self.a.ask(self.to_b, "slow", timeout=60.0)
        c, _ = self.endpoint(3)
        self.got(c.ask(self.to_b, "echo", 1))
        session = next(iter(c._sessions.values()))
        number = next(iter(self.a._requester._requests))
        self.taps[self.to_b.address].receiver(session.seal(encode(Cancel(number))), c.address)
        self.assertEqual(self.ended, [])
        self.works[0].callback("done")
        self.assertEqual(self.got(asked), "done")

    def test_deadline_is_carried(self) -> None:
        """A method gets the caller's remaining time, less the network delay, as milliseconds in 32 bits."""
        for seconds, milliseconds in ((1.5, 1500), (-1.0, 0), (1e9, NO_LIMIT_MS)):
            aged_one = decode(set_remaining_time(encode(Request(1, "m", (), 7)), seconds))
            self.assertEqual(aged_one, Request(1, "m", (), milliseconds))
        for timeout, least, most in ((None, 1.4, 1.5), (9.0, 8.9, 9.0)):
            left = self.got(self.a.ask(self.to_b, "when", timeout=timeout))
            self.assertTrue(least <= left <= most, left)

    def test_what_is_too_late_stops(self) -> None:
        """A running method is cancelled at the deadline; a request that arrives after its deadline never runs."""
        asked = self.a.ask(self.to_b, "slow", timeout=2.0)
        self.clock.advance(1.9)
        self.assertEqual(self.ended, [])
        self.failed(asked, NoAnswer)
        self.assertEqual(self.ended, ["CancelledError"])
        late = set_remaining_time(encode(Request(9, "add", (1,))), 0.0)
        session = next(iter(self.a._sessions.values()))
        self.taps[self.to_b.address].receiver(session.seal(late), self.to_a.address)
        self.assertEqual((self.runs, self.b.counters["late"]), ([], 2))

    def test_refusals_have_a_code(self) -> None:
        """A rejection contains its code and text; an invalid code is replaced by ``refused``."""
        for code, arrives in (("dog.busy", "dog.busy"), ("", "refused"), ("x" * 65, "refused"), ("a\nb", "refused")):
            self.code = code
            asked = self.a.ask(self.to_b, "busy")
            self.clock.advance(1)
            error = self.failureResultOf(asked, Refused).value
            self.assertEqual((str(error), error.code), ("with a bone", arrives))
