"""Certificates of record owners: fetched from the peer that hands a record over, where this node lacks them.

A record is stored and believed only from an owner whose present certificate allows its namespace.  A node knows the
certificates of the members that it met and of those on the membership list.  The owner of a second-hand record may be
neither, such as the guest of another gateway; the peer that hands the record over then gives the certificate too.
"""

from __future__ import annotations

from collections.abc import Iterable

from middleware.entangled.errors import EntangledError
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.record import Record
from middleware.entangled.wire.endpoint import Endpoint

METHOD = "certificates"
MAX_OWNERS = 16
"""Owners in one request: as many certificates as fit into one page of an answer."""
MAX_REQUESTS = 8
"""Requests for the owners of one batch of records; the owners beyond stay unknown, and their records are refused."""


class Certificates:
    """The certificates of owners, as the door of the ``endpoint`` knows them and peers tell them."""

    def __init__(self, endpoint: Endpoint) -> None:
        self._endpoint = endpoint
        endpoint.expose(METHOD, self.answer_certificates)

    def list_unknown(self, records: Iterable[Record], peer: Contact) -> list[bytes]:
        """Return the owners of ``records``, other than ``peer``, of which no certificate is known."""
        owners = dict.fromkeys(record.owner for record in records)
        return [owner for owner in owners if owner != peer.public and not self._endpoint.door.is_known(owner)]

    async def learn(self, owners: list[bytes], peer: Contact) -> None:
        """Ask ``peer`` for the certificates of ``owners``; those that do not hold are ignored."""
        for begin in range(0, min(len(owners), MAX_OWNERS * MAX_REQUESTS), MAX_OWNERS):
            page = owners[begin : begin + MAX_OWNERS]
            try:
                answer = await self._endpoint.ask(peer, METHOD, page)
            except EntangledError:
                return
            for owner, certificate in zip(page, answer if isinstance(answer, list) else [], strict=False):
                if isinstance(certificate, bytes) and certificate:
                    self._endpoint.door.judge(owner, certificate)

    def answer_certificates(self, peer: Contact, owners: list[object]) -> list[bytes]:
        """Return the certificate of each of ``owners``, at most ``MAX_OWNERS``; empty where none is known."""
        return [
            self._endpoint.door.certificate(owner) if isinstance(owner, bytes) else b"" for owner in owners[:MAX_OWNERS]
        ]
