"""Requests for the certificates of record owners, to the node that sends their records.

A node checks a record against its owner's certificate.  The node knows most certificates from a session with the owner
or from the team's membership list.  It requests any other certificate, for example the certificate of a guest with
sessions to only some members, from the node that sent the record.  A node that cannot send a certificate is not asked
again for ``RETRY_AFTER_S`` seconds, so invalid records cause few requests.
"""

from __future__ import annotations

from collections.abc import Iterable

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError
from middleware.entangled.wire.admission_check import FOREIGN, AdmissionCheck
from middleware.entangled.wire.endpoint import Endpoint

MAX_OWNERS = 12
"""The maximum number of owners in one request."""
RETRY_AFTER_S = 2.0
MAX_FAILED_PEERS = 1024
"""The number of peers that are remembered as not to be asked for ``RETRY_AFTER_S`` seconds; the oldest is dropped
first."""
OWNER_BYTES = 32


class Certificates:
    """Fetches and serves certificates of record owners; the admission check ``admission`` verifies them."""

    def __init__(self, endpoint: Endpoint, clock: IReactorTime) -> None:
        self.admission: AdmissionCheck = endpoint.admission
        self._endpoint = endpoint
        self._clock = clock
        self._retry_at: dict[bytes, float] = {}
        endpoint.expose("certificates", self._answer_certificates)

    def find_missing(self, contact: Contact, owners: Iterable[bytes]) -> list[bytes]:
        """Return the owners with an unknown certificate; an empty list if ``contact`` should not be asked now."""
        lacking = [owner for owner in dict.fromkeys(owners) if self.admission.find_authority(owner).refusal == FOREIGN]
        return lacking if self._clock.seconds() >= self._retry_at.get(contact.node_id, 0.0) else []

    async def fetch_missing(self, contact: Contact, owners: Iterable[bytes]) -> None:
        """Request the unknown certificates of ``owners`` from ``contact``; never raises."""
        lacking = self.find_missing(contact, owners)
        while lacking and await self._fetch(contact, lacking[:MAX_OWNERS]):
            lacking = lacking[MAX_OWNERS:]

    # -- inside -----------------------------------------------------------------------------------------------------

    async def _fetch(self, contact: Contact, owners: list[bytes]) -> bool:
        """Request the certificates of ``owners``; return whether ``contact`` sent a valid certificate of each owner."""
        try:
            answer = await self._endpoint.ask(contact, "certificates", owners)
        except EntangledError:
            answer = None
        certificates = answer if isinstance(answer, list) and len(answer) == len(owners) else [None] * len(owners)
        for owner, certificate in zip(owners, certificates, strict=True):
            if not (
                isinstance(certificate, bytes) and certificate and self.admission.add_certificate(owner, certificate)
            ):
                self._retry_at.pop(contact.node_id, None)
                self._retry_at[contact.node_id] = self._clock.seconds() + RETRY_AFTER_S
                if len(self._retry_at) > MAX_FAILED_PEERS:
                    del self._retry_at[next(iter(self._retry_at))]
                return False
        return True

    def _answer_certificates(self, peer: Contact, owners: list[object]) -> list[bytes]:
        """Answer CERTIFICATES: return the certificate of each owner, empty if it is unknown."""
        return [
            self.admission.find_certificate(owner) if isinstance(owner, bytes) and len(owner) == OWNER_BYTES else b""
            for owner in owners[:MAX_OWNERS]
        ]
