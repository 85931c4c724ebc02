"""Batching of a node's own records for their replicas.

As in Nagle's algorithm (RFC 896), further records wait until the replica has answered the last request, and are then
sent in one request.  A single write is therefore not delayed, and many writes share datagrams.
"""

from __future__ import annotations

from collections import deque

from twisted.internet.defer import Deferred

from middleware.entangled.background import Background
from middleware.entangled.contact import Contact
from middleware.entangled.errors import Crowded, EntangledError, NoAnswer, Refused
from middleware.entangled.kademlia.overlay import Overlay
from middleware.entangled.record import Record

MAX_LOAD_BYTES = 1300
"""The maximum bytes of records in one datagram."""
MAX_WAITING = 2048
"""The maximum number of records that wait for one replica."""


Waiting = deque[tuple[Record, Deferred[object]]]
"""The records that wait for one replica, each with the Deferred of its result."""


class RecordBatcher:
    """Sends the own records of a node to their replicas."""

    def __init__(self, overlay: Overlay, background: Background) -> None:
        self._overlay = overlay
        self._background = background
        self._waiting: dict[bytes, Waiting] = {}

    async def store(self, contact: Contact, record: Record, lifetime_s: float | None = None) -> object:
        """Send STORE for ``record`` and return the reply; raise the errors of the request.

        If ``lifetime_s`` (the remaining lifetime in seconds) is given, another node owns the record, and the record is
        sent immediately in its own request.
        """
        if lifetime_s is not None:
            return (await self._send(contact, [record], [lifetime_s]))[0]
        if record.message_bytes > MAX_LOAD_BYTES:
            return (await self._send(contact, [record]))[0]  # sent in fragments, so it takes longer
        waiting = self._waiting.get(contact.node_id)
        if waiting is not None:
            if len(waiting) >= MAX_WAITING:
                raise Crowded(
                    f"the limit of {MAX_WAITING} records that wait for {contact.address} is reached; write more slowly"
                )
            result: Deferred[object] = Deferred()
            waiting.append((record, result))
            return await result
        waiting = self._waiting[contact.node_id] = deque()
        try:
            results = await self._send(contact, [record])
        except NoAnswer:
            self._send_all(waiting, contact)
            raise
        finally:
            self._finish_request(waiting, contact)
        return results[0]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _finish_request(self, waiting: Waiting, contact: Contact) -> None:
        """If records wait, send the next request, because the last request has ended."""
        if waiting:
            self._background.fork(self._send_next(waiting, contact))
        else:
            del self._waiting[contact.node_id]

    def _send_all(self, waiting: Waiting, contact: Contact) -> None:
        """Send all waiting records immediately, after a request was not answered."""
        while waiting:
            self._background.fork(self._deliver(contact, _take_batch(waiting)))

    async def _send_next(self, waiting: Waiting, contact: Contact) -> None:
        try:
            await self._deliver(contact, _take_batch(waiting))
        except NoAnswer:
            self._send_all(waiting, contact)
        finally:
            self._finish_request(waiting, contact)

    async def _deliver(self, contact: Contact, load: list[tuple[Record, Deferred[object]]]) -> None:
        """Send ``load`` in one request and fire its Deferreds; also raise ``NoAnswer``."""
        try:
            answers = await self._send(contact, [record for record, _ in load])
        except Refused as error:
            if len(load) == 1:
                load[0][1].errback(error)
            else:  # send each record separately, so that only the rejected record fails
                for one in load:
                    self._background.fork(self._deliver(contact, [one]))
        except EntangledError as error:
            for _, result in load:
                result.errback(error)
            if isinstance(error, NoAnswer):
                raise
        else:
            for (_, result), answer in zip(load, answers, strict=True):
                result.callback(answer)

    async def _send(self, contact: Contact, records: list[Record], *lives: list[float]) -> list[object]:
        packed = [record.pack() for record in records]
        answer = await self._overlay.ask(contact, "store", packed, *lives, changes=True)
        if not isinstance(answer, list) or len(answer) != len(records):
            raise Refused(f"{contact.address} rejects the record")
        return answer


def _take_batch(waiting: Waiting) -> list[tuple[Record, Deferred[object]]]:
    """Remove and return the next waiting records, as many as fit into one datagram."""
    room = MAX_LOAD_BYTES
    load: list[tuple[Record, Deferred[object]]] = []
    while waiting and (waiting[0][0].message_bytes <= room or not load):
        load.append(waiting.popleft())
        room -= load[-1][0].message_bytes
    return load
