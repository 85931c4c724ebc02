"""Shipper: brings a node's own records to their replicas, those that come close together in one question.

After Nagle (RFC 896): a record for a replica that has not yet answered earlier ones waits for that answer, and goes
with all that came meanwhile.  So a single write loses no time, and a flood of them shares datagrams and their cost.
"""

from __future__ import annotations

from collections import deque

from twisted.internet.defer import Deferred

from middleware.entangled.background import Background
from middleware.entangled.contact import Contact
from middleware.entangled.errors import Crowded, EntangledError, NoAnswer, Refused
from middleware.entangled.kademlia.overlay import Overlay
from middleware.entangled.record import Record

ROOM = 1300
"""Bytes of records in one datagram."""
MAX_WAITING = 2048
"""Records that wait for one replica."""


Waiting = deque[tuple[Record, Deferred[object]]]
"""The records that wait for one replica, and who is told what becomes of them."""


class Shipper:
    """The own records of a node on their way to others."""

    def __init__(self, overlay: Overlay, chores: Background) -> None:
        self._overlay = overlay
        self._chores = chores
        self._waiting: dict[bytes, Waiting] = {}

    async def store(self, contact: Contact, record: Record, left: float | None = None) -> object:
        """What ``contact`` says to ``record`` (see STORE); raises what asking it raises.

        Another's record, which is to be kept for ``left`` seconds, goes by itself.
        """
        if left is not None:
            return (await self._asked(contact, [record], [left]))[0]
        if record.message_bytes > ROOM:
            return (await self._asked(contact, [record]))[0]  # it goes as a parcel, and takes its time
        waiting = self._waiting.get(contact.node_id)
        if waiting is not None:
            if len(waiting) >= MAX_WAITING:
                raise Crowded(f"too many records wait for {contact.address}; put more slowly")
            verdict: Deferred[object] = Deferred()
            waiting.append((record, verdict))
            return await verdict
        waiting = self._waiting[contact.node_id] = deque()
        try:
            verdicts = await self._asked(contact, [record])
        except NoAnswer:
            self._rush(waiting, contact)
            raise
        finally:
            self._next(waiting, contact)
        return verdicts[0]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _next(self, waiting: Waiting, contact: Contact) -> None:
        """The question has ended: send the next one, if anything waits for it."""
        if waiting:
            self._chores.fork(self._ship(waiting, contact))
        else:
            del self._waiting[contact.node_id]

    def _rush(self, waiting: Waiting, contact: Contact) -> None:
        """Let nobody wait any longer for one that is silent: each gets its own chance now."""
        while waiting:
            self._chores.fork(self._deliver(contact, _take_load(waiting)))

    async def _ship(self, waiting: Waiting, contact: Contact) -> None:
        try:
            await self._deliver(contact, _take_load(waiting))
        except NoAnswer:
            self._rush(waiting, contact)
        finally:
            self._next(waiting, contact)

    async def _deliver(self, contact: Contact, load: list[tuple[Record, Deferred[object]]]) -> None:
        """Ask with these records, and tell each of those who wait; raises ``NoAnswer``, too."""
        try:
            answers = await self._asked(contact, [record for record, _ in load])
        except Refused as error:
            if len(load) == 1:
                load[0][1].errback(error)
            else:  # one that is refused shall not take the others with it
                for one in load:
                    self._chores.fork(self._deliver(contact, [one]))
        except EntangledError as error:
            for _, verdict in load:
                verdict.errback(error)
            if isinstance(error, NoAnswer):
                raise
        else:
            for (_, verdict), answer in zip(load, answers, strict=True):
                verdict.callback(answer)

    async def _asked(self, contact: Contact, records: list[Record], *lives: list[float]) -> list[object]:
        packed = [record.packed() for record in records]
        answer = await self._overlay.ask(contact, "store", packed, *lives, changes=True)
        if not isinstance(answer, list) or len(answer) != len(records):
            raise Refused(f"{contact.address} does not take the record")
        return answer


def _take_load(waiting: Waiting) -> list[tuple[Record, Deferred[object]]]:
    """Take the next of those that wait, as many as one datagram carries."""
    room = ROOM
    load: list[tuple[Record, Deferred[object]]] = []
    while waiting and (waiting[0][0].message_bytes <= room or not load):
        load.append(waiting.popleft())
        room -= load[-1][0].message_bytes
    return load
