"""Requests for the certificates of record owners, to the node that sends their records.

A node checks a record against its owner's certificate.  It knows most certificates from a session with the owner or
from the team's membership list; for others, such as guests that only some members met, it asks the node that sent the
record.  A node that cannot send a certificate is not asked again for ``UNASKED_S`` seconds, so junk costs little.
"""

from __future__ import annotations

from collections.abc import Iterable

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError
from middleware.entangled.wire.door import FOREIGN, Door
from middleware.entangled.wire.endpoint import Endpoint

MAX_OWNERS = 12
"""Owners in one request."""
UNASKED_S = 2.0
MAX_UNASKED = 1024
"""Peers remembered as not to be asked for ``UNASKED_S`` seconds; the oldest is dropped first."""
OWNER_BYTES = 32


class Certificates:
    """Fetches and serves certificates of record owners; the admission check ``door`` verifies them."""

    def __init__(self, endpoint: Endpoint, clock: IReactorTime) -> None:
        self.door: Door = endpoint.door
        self._endpoint = endpoint
        self._clock = clock
        self._unasked: dict[bytes, float] = {}
        endpoint.expose("certificates", self._answer_certificates)

    def lacking(self, contact: Contact, owners: Iterable[bytes]) -> list[bytes]:
        """Return the owners with an unknown certificate; none if ``contact`` should not be asked now."""
        lacking = [owner for owner in dict.fromkeys(owners) if self.door.authority(owner).refusal == FOREIGN]
        return lacking if self._clock.seconds() >= self._unasked.get(contact.node_id, 0.0) else []

    async def learn(self, contact: Contact, owners: Iterable[bytes]) -> None:
        """Request the unknown certificates of ``owners`` from ``contact``; never raises."""
        lacking = self.lacking(contact, owners)
        while lacking and await self._learn(contact, lacking[:MAX_OWNERS]):
            lacking = lacking[MAX_OWNERS:]

    # -- inside -----------------------------------------------------------------------------------------------------

    async def _learn(self, contact: Contact, owners: list[bytes]) -> bool:
        """Request the certificates of ``owners``; return whether ``contact`` sent a valid one for each."""
        try:
            answer = await self._endpoint.ask(contact, "certificates", owners)
        except EntangledError:
            answer = None
        certificates = answer if isinstance(answer, list) and len(answer) == len(owners) else [None] * len(owners)
        for owner, certificate in zip(owners, certificates, strict=True):
            if not (isinstance(certificate, bytes) and certificate and self.door.learn(owner, certificate)):
                self._unasked.pop(contact.node_id, None)
                self._unasked[contact.node_id] = self._clock.seconds() + UNASKED_S
                if len(self._unasked) > MAX_UNASKED:
                    del self._unasked[next(iter(self._unasked))]
                return False
        return True

    def _answer_certificates(self, peer: Contact, owners: list[object]) -> list[bytes]:
        """CERTIFICATES: return the certificate of each owner, empty if unknown."""
        return [
            self.door.certificate(owner) if isinstance(owner, bytes) and len(owner) == OWNER_BYTES else b""
            for owner in owners[:MAX_OWNERS]
        ]
