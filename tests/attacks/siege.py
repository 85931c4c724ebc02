"""Attackers of a closed team: endpoints with a member's key and certificate that violate the protocol."""

from __future__ import annotations

import random
from typing import Any

from twisted.logger import globalLogPublisher
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.contact import Contact
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.entangled.wire.admission_check import Incarnation, OpenAdmission
from middleware.entangled.wire.endpoint import Endpoint
from tests.middleware.admission.village import Village, VillageCase

SOURCE = Address("10.6.6.6", 666)


class AnyAdmission(OpenAdmission):
    """An attacker's admission check, which accepts every peer and presents any certificate."""

    def __init__(self, certificate: bytes, max_pass_bytes: int = 640, life: int = 1) -> None:
        self.own_pass = certificate
        self.max_pass_bytes = max_pass_bytes
        self.incarnation = Incarnation(life, b"attacker")
        self.fingerprint = bytes(8)

    def find_certificate(self, owner: bytes) -> bytes:
        return self.own_pass

    def add_certificate(self, owner: bytes, certificate: bytes) -> bool:
        return True


class SiegeCase(VillageCase):
    """A test case with a closed team and its attackers."""

    def attacker(
        self, team: Village, identity: Identity, secret: bytes, certificate: bytes, at: Address = SOURCE, life: int = 1
    ) -> Endpoint:
        """Return an endpoint that presents an arbitrary certificate; it is stopped when the test ends."""
        network = team.switchboard.make_network(*at)
        dice = random.Random(f"attacker {at}")
        endpoint = Endpoint(identity, secret, network, team.clock, dice, AnyAdmission(certificate, life=life))
        endpoint.start()
        self.addCleanup(endpoint.stop)
        return endpoint

    def insider(self, team: Village, name: str, *which: str, at: Address = SOURCE) -> tuple[Endpoint, Identity]:
        """Return an endpoint with a valid certificate for these roles, but without the admission check of a node."""
        paper = team.paper(name, *which)
        secret = paper.secrets[0][1]
        return self.attacker(team, paper.identity, secret, paper.certificate, at), paper.identity


class OneSession:
    """A session stub with only the attributes that receivers of datagrams read."""

    def __init__(self, public: bytes, at: Address = SOURCE) -> None:
        self.contact = Contact(public, at)


def events_of(case: SynchronousTestCase) -> list[dict[str, Any]]:
    """Return a list that collects all log events until the test ends."""
    events: list[dict[str, Any]] = []
    observer: Any = events.append
    globalLogPublisher.addObserver(observer)
    case.addCleanup(globalLogPublisher.removeObserver, observer)
    return events
