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


class _Quay:
    """What waits for one replica while it is asked."""

    __slots__ = ("waiting",)

    def __init__(self) -> None:
        self.waiting: deque[tuple[Record, Deferred[object]]] = deque()

    def load(self) -> list[tuple[Record, Deferred[object]]]:
        """The next of those that wait, as many as one datagram carries."""
        room = ROOM
        load: list[tuple[Record, Deferred[object]]] = []
        while self.waiting and (self.waiting[0][0].message_bytes <= room or not load):
            load.append(self.waiting.popleft())
            room -= load[-1][0].message_bytes
        return load


class Shipper:
    """The own records of a node on their way to others."""

    def __init__(self, overlay: Overlay, chores: Background) -> None:
        self._overlay = overlay
        self._chores = chores
        self._quays: dict[bytes, _Quay] = {}

    async def store(self, contact: Contact, record: Record, left: float | None = None) -> object:
        """What ``contact`` says to ``record`` (see STORE); raises what asking it raises.

        Another's record, which is to be kept for ``left`` seconds, goes by itself.
        """
        if left is not None:
            return (await self._asked(contact, [record], [left]))[0]
        if record.message_bytes > ROOM:
            return (await self._asked(contact, [record]))[0]  # it goes as a parcel, and takes its time
        quay = self._quays.get(contact.node_id)
        if quay is not None:
            if len(quay.waiting) >= MAX_WAITING:
                raise Crowded(f"too many records wait for {contact.address}; put more slowly")
            verdict: Deferred[object] = Deferred()
            quay.waiting.append((record, verdict))
            return await verdict
        quay = self._quays[contact.node_id] = _Quay()
        try:
            verdicts = await self._asked(contact, [record])
        except NoAnswer:
            self._rush(quay, contact)
            raise
        finally:
            self._next(quay, contact)
        return verdicts[0]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _next(self, quay: _Quay, contact: Contact) -> None:
        """The question has ended: send the next one, if anything waits for it."""
        if quay.waiting:
            self._chores.fork(self._ship(quay, contact))
        else:
            del self._quays[contact.node_id]

    def _rush(self, quay: _Quay, contact: Contact) -> None:
        """Let nobody wait any longer for one that is silent: each gets its own chance now."""
        while quay.waiting:
            self._chores.fork(self._deliver(contact, quay.load()))

    async def _ship(self, quay: _Quay, contact: Contact) -> None:
        try:
            await self._deliver(contact, quay.load())
        except NoAnswer:
            self._rush(quay, contact)
        finally:
            self._next(quay, contact)

    async def _deliver(self, contact: Contact, load: list[tuple[Record, Deferred[object]]]) -> None:
        """Ask with these records, and tell each of those who wait; raises ``NoAnswer``, too."""
        try:
            verdicts = await self._asked(contact, [record for record, _ in load])
        except Refused as error:
            if len(load) == 1:
                load[0][1].errback(error)
            else:  # one that is refused shall not take the others with it
                for one in load:
                    self._chores.fork(self._deliver(contact, [one]))
        except EntangledError as error:
            for _, waiting in load:
                waiting.errback(error)
            if isinstance(error, NoAnswer):
                raise
        else:
            for (_, waiting), verdict in zip(load, verdicts, strict=True):
                waiting.callback(verdict)

    async def _asked(self, contact: Contact, records: list[Record], *lives: list[float]) -> list[object]:
        packed = [record.packed() for record in records]
        answer = await self._overlay.ask(contact, "store", packed, *lives, changes=True)
        if not isinstance(answer, list) or len(answer) != len(records):
            raise Refused(f"{contact.address} does not take the record")
        return answer
