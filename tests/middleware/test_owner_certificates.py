"""Tests of ``owner_certificates`` of ``replication``, which requests the certificates of unknown owners."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred, fail, succeed
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.clock import HeapClock
from middleware.entangled.contact import Contact
from middleware.entangled.errors import NoAnswer
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.entangled.replication.owner_certificates import (
    MAX_FAILED_PEERS,
    MAX_OWNERS,
    RETRY_AFTER_S,
    Certificates,
)
from middleware.entangled.wire.admission_check import FOREIGN, Authority, OpenAdmission


class KnownOwnersAdmission(OpenAdmission):
    """An admission check that accepts an owner after it learned the certificate.

    In these tests a valid certificate equals the owner's key.
    """

    def __init__(self) -> None:
        self.known: set[bytes] = set()

    def find_authority(self, owner: bytes) -> Authority:
        return Authority("" if owner in self.known else FOREIGN)

    def find_certificate(self, owner: bytes) -> bytes:
        return owner if owner in self.known else b""

    def add_certificate(self, owner: bytes, certificate: bytes) -> bool:
        if owner == certificate:
            self.known.add(owner)
        return owner == certificate


class Endpoint:
    def __init__(self) -> None:
        self.admission = KnownOwnersAdmission()
        self.asked: list[list[bytes]] = []
        self.answer: Any = lambda owners: succeed(owners)
        self.exposed: Any = None

    def expose(self, name: str, answer: Any) -> None:
        self.exposed = answer

    def ask(self, contact: Contact, method: str, owners: list[bytes]) -> Deferred[Any]:
        self.asked.append(owners)
        answered: Deferred[Any] = self.answer(owners)
        return answered


def made() -> Any:
    """Return a stub of the endpoint."""
    return Endpoint()


def contact(number: int) -> Contact:
    return Contact(Identity(number.to_bytes(32)).public, Address("10.0.0.1", 1000 + number % 60_000))


def owners(count: int) -> list[bytes]:
    return [number.to_bytes(32) for number in range(count)]


class CertificateTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.clock = HeapClock()
        self.endpoint = made()
        self.certificates = Certificates(self.endpoint, self.clock)
        self.admission = self.endpoint.admission

    def learn(self, which: list[bytes], peer: int = 1) -> None:
        self.successResultOf(Deferred.fromCoroutine(self.certificates.fetch_missing(contact(peer), which)))

    def test_asked_once_for_each(self) -> None:
        """The certificate of each unknown owner is requested once, several certificates in one request."""
        self.admission.known.update(owners(3))
        self.learn(owners(20) * 2)
        self.assertEqual(self.endpoint.asked, [owners(20)[3 : 3 + MAX_OWNERS], owners(20)[3 + MAX_OWNERS :]])
        self.learn(owners(20))
        self.assertEqual(len(self.endpoint.asked), 2)

    def test_a_peer_that_cannot_show_one(self) -> None:
        """A peer that sent an invalid, empty or no reply gets no request for a time; other peers still get requests."""
        junk: list[Any] = [
            lambda asked: fail(NoAnswer("silent")),
            lambda asked: succeed(None),
            lambda asked: succeed([b""]),
            lambda asked: succeed([b"junk"] * len(asked)),
            lambda asked: succeed([7] * len(asked)),
        ]
        for peer, answer in enumerate(junk, start=1):
            self.endpoint.answer = answer
            before = len(self.endpoint.asked)
            self.learn(owners(2), peer)
            self.learn(owners(2), peer)
            self.assertEqual(len(self.endpoint.asked) - before, 1)
            self.assertEqual(self.certificates.find_missing(contact(peer), owners(2)), [])
        self.endpoint.answer = lambda asked: succeed(asked)
        self.clock.advance(RETRY_AFTER_S)
        self.learn(owners(2), 1)
        self.assertEqual(self.admission.known, set(owners(2)))

    def test_only_those_that_were_asked_for(self) -> None:
        """A certificate counts only for the requested owner.

        Certificates before the first invalid certificate are used.
        """
        self.endpoint.answer = lambda asked: succeed([asked[0], b"", *asked[2:]])
        self.learn(owners(3))
        self.assertEqual(self.admission.known, {owners(3)[0]})

    def test_bounded(self) -> None:
        """The table of peers that sent invalid certificates is limited."""
        self.endpoint.answer = lambda asked: succeed(None)
        for peer in range(MAX_FAILED_PEERS + 10):
            self.learn(owners(1), peer)
        self.assertEqual(len(self.certificates._retry_at), MAX_FAILED_PEERS)

    def test_answer(self) -> None:
        """A node returns certificates for up to ``MAX_OWNERS`` owners, and an empty entry for an invalid key."""
        self.admission.known.update(owners(2))
        answer = self.endpoint.exposed(contact(1), [*owners(3), b"short", 7])
        self.assertEqual(answer, [*owners(2), b"", b"", b""])
        self.assertEqual(len(self.endpoint.exposed(contact(1), owners(100))), MAX_OWNERS)
