"""Tests of the admission server of a bootstrap node, in isolation."""

from __future__ import annotations

import random
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from nacl import bindings
from twisted.internet.defer import Deferred, fail, succeed
from twisted.logger import capturedLogs, formatEvent
from twisted.trial.unittest import SynchronousTestCase

from middleware.admission import join_codec
from middleware.admission.join_codec import JoinReply, VerifiedReply
from middleware.admission.membership_list import MembershipList
from middleware.admission.server import MAX_REQUESTS_PER_S, MAX_UNSIGNED_REFUSALS_PER_S, AdmissionServer
from middleware.entangled.errors import Full, NoAnswer
from middleware.entangled.network.network import Address
from tests.middleware.admission.paper import LATER, NOW, granted, identity, invited, make_list, operator

OPERATOR = operator()
CODE, PACKED, INVITE = invited(OPERATOR)
DOOR = Address("10.0.0.2", 9000)
SECRET = b"e" * 32
DOG = identity("dog").public


class AdmissionServerTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.now = 0.0
        self.sent: list[tuple[bytes, Address]] = []
        terms = OPERATOR.invite("dog", ("device",), 1, NOW, LATER, random.Random(1)).terms
        self.membership_list: MembershipList = make_list(
            OPERATOR, granted(OPERATOR, "vaio", "bootstrap"), PACKED, terms
        )
        self.taken: Deferred[bool] = succeed(True)
        self.refused: list[tuple[bytes, Address, str]] = []
        self.admit: Any = lambda packed: self.membership_list.add(packed, NOW)
        self.server = AdmissionServer(
            self.membership_list,
            identity("vaio"),
            lambda invite: self.taken,
            lambda packed: self.admit(packed),
            lambda shown: JoinReply(shown, ((1, b"s" * 32, 0),)),
            lambda datagram, to: self.sent.append((datagram, to)),
            lambda: self.now,
            lambda: NOW,
            random.Random(1),
            lambda who, source, code: self.refused.append((who, source, code)),
        )

    def knocked(self, dice: int = 1, name: str = "dog", secret: bytes = SECRET) -> bytes:
        """Return a valid join request (JOIN_REQUEST); the seed determines its bytes."""
        shared = bindings.crypto_scalarmult_base(secret)
        return join_codec.make_request(CODE.key, identity(name).public, shared, "", random.Random(dice))

    def answer(self) -> JoinReply | str:
        """Return the content of the last signed reply."""
        reply = join_codec.open_reply(self.sent[-1][0], CODE, DOG, SECRET)
        assert isinstance(reply, VerifiedReply)
        return reply.content

    def test_let_in(self) -> None:
        """A valid join request gets one reply, sent to its source and not larger than the request."""
        said = self.knocked()
        self.server.on_request(said, DOOR)
        self.assertIsInstance(self.answer(), JoinReply)
        self.assertEqual([to for _, to in self.sent], [DOOR])
        self.assertLessEqual(len(self.sent[0][0]), len(said))
        assert self.membership_list.find_admission(DOG) is not None

    def test_repeated_knock_costs_nothing(self) -> None:
        """A repeated datagram gets the same reply, from any source address, and does not use the code again."""
        said = self.knocked()
        self.server.on_request(said, DOOR)
        self.taken = Deferred()  # A second use of the code would wait for this Deferred.
        self.server.on_request(said, Address("10.0.0.3", 1))
        self.assertEqual(self.sent[0][0], self.sent[1][0])

    def test_answer_under_way(self) -> None:
        """Repeated requests of a newcomer wait until the use of its code is decided.

        Then the newcomer gets one reply.
        """
        self.taken = Deferred()
        for dice in range(3):
            self.server.on_request(self.knocked(dice), DOOR)
        self.assertEqual(self.sent, [])
        self.taken.callback(True)
        self.assertEqual(len(self.sent), 1)

    def test_nobody_can_tell(self) -> None:
        """A newcomer is rejected with "later" if too few peers are reachable or the membership list is full."""
        self.taken = fail(NoAnswer("too few"))
        self.server.on_request(self.knocked(1), DOOR)
        self.assertEqual(self.answer(), "later")
        self.taken = succeed(True)

        def full(packed: bytes) -> None:
            raise Full("no room")

        self.admit = full
        with capturedLogs() as said:
            self.server.on_request(self.knocked(2), DOOR)
        self.assertEqual(self.answer(), "later")
        self.assertIn("no room", "".join(formatEvent(event) for event in said))
        self.assertIsNone(self.membership_list.find_admission(DOG))

    def test_strangers_get_nothing(self) -> None:
        """Forged requests for a known invitation get no reply, and do not delay a newcomer that has the code."""
        said = self.knocked()
        for number in range(int(MAX_REQUESTS_PER_S) * 3):
            forged = bytearray(said)
            forged[40 + number] ^= 1
            self.server.on_request(bytes(forged), DOOR)
        self.assertEqual(self.sent, [])
        self.server.on_request(said, DOOR)
        self.assertIsInstance(self.answer(), JoinReply)

    def test_key_that_is_none(self) -> None:
        """A request with an invalid ephemeral key gets no reply and logs no error."""
        bad = join_codec.make_request(CODE.key, DOG, bytes(32), "", random.Random(1))
        self.server.on_request(bad, DOOR)
        self.assertEqual((self.sent, self.flushLoggedErrors()), ([], []))

    def test_hints_are_few_and_short(self) -> None:
        """Requests with unknown codes get hints of nine bytes, limited in rate and logged once."""
        strange = bytearray(self.knocked())
        strange[1] ^= 1
        with capturedLogs() as said:
            for _ in range(1000):
                self.server.on_request(bytes(strange), DOOR)
        self.assertEqual(
            (len(self.sent), {len(each) for each, _ in self.sent}), (int(MAX_UNSIGNED_REFUSALS_PER_S), {9})
        )
        self.assertEqual(len(said), 1)

    def test_checks_are_few(self) -> None:
        """The rate of requests that are checked is limited, even for newcomers with the code."""
        for number in range(int(MAX_REQUESTS_PER_S) + 10):
            self.server.on_request(self.knocked(name=f"dog{number}"), DOOR)
        self.assertEqual(len(self.sent), int(MAX_REQUESTS_PER_S))
        self.now = 1.0
        self.server.on_request(self.knocked(name="another"), DOOR)
        self.assertEqual(len(self.sent), int(MAX_REQUESTS_PER_S) + 1)

    @given(st.data())
    @settings(max_examples=150, deadline=None)
    def test_takes_anything(self, data: st.DataObject) -> None:
        """Any datagram is handled without an exception, and the reply is not larger than the datagram."""
        said = bytearray(self.knocked())
        for place in data.draw(st.lists(st.integers(0, len(said) - 1), max_size=3)):
            said[place] ^= data.draw(st.integers(0, 255))
        cut = bytes(said[: data.draw(st.integers(1, len(said)) | st.just(len(said)))])
        before = len(self.sent)
        self.now += 1.0
        self.server.on_request(cut, DOOR)
        self.assertLessEqual(sum(len(each) for each, _ in self.sent[before:]), len(cut))
