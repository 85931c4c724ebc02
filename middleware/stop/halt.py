"""Halt: the stops of the whole team as this node knows them, which what acts obeys.

A stop goes to every device at once, and stays as a record for those that come later or did not hear it.  It is in force
until a release names it (``middleware.stop.stop_set``).  Stops and releases count only from members that may order.
Where the role of a record's owner is not known, its stops count and its releases do not.

A node keeps the stops in its store and acknowledges one when it is written, so that a restart releases nothing.  Where
no record names a stop any more, because its author left or was revoked, a node that may order names it in its own.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

import msgpack
from twisted.internet.defer import Deferred, DeferredList

from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError, NoAnswer, NotRunning, Refused
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, Slot, hashed_key
from middleware.entangled.replication.watch import Watch
from middleware.entangled.value import MAX_VALUE, bounded
from middleware.stop.stop_set import (
    ID_BYTES,
    MAX_NAMED,
    MAX_RELEASED,
    Statement,
    StopSet,
    are_ids,
    clipped,
    derived_id,
    statement_in,
    statement_of,
    unpacked,
)

HALT = hashed_key("halt")
SLOT = "halt"
METHOD = "device.halt"
NOTE = "halt/stops"
"""The node's note of the stops in force, the released ones, and those that it released itself."""
STANDS = "stands"
GOES_ON = "goes on"
NO_ROBOT = "has no robot"
UNHEARD = "did not answer; it stops when it hears of it, or when its lease is over"
UNSAVED = "; it cannot save the stop: a restart of its node may end it"
RECORDED_RELEASES = 16
"""Releases that the node's own record names, the newest ones."""
MADE = ADOPTED = MAX_NAMED // 2
"""Stops that a node has in force itself, where a new one replaces its oldest, and those of others that it names."""
REVIEW = 10.0
"""Least seconds between two looks, while the team is stopped, for a stop that no record names; at most twice that."""

Report = Callable[[Collection[bytes], str], None]
"""Called with the stops that are obeyed, and with what this node does, in a few words."""
Later = Callable[[float, Callable[[], None]], object]


class Halt:
    """The stops as this node knows them; what acts asks ``is_on`` before it acts, and says how it obeys.

    ``later(seconds, call)`` is a timer that ends with the node, and ``report`` is called when something has changed.
    Without a node, nothing is stopped.
    """

    def __init__(
        self,
        entangled: EntangledNode | None = None,
        rng: random.Random | None = None,
        later: Later = lambda seconds, call: None,
        report: Report = lambda stops, words: None,
    ) -> None:
        self.is_known = True
        self.released_by = ""
        self._set = StopSet()
        self._entangled = entangled
        self._rng = rng
        self._later = later
        self._report = report
        self._obeying: list[Callable[[], str]] = []
        self._watch: Watch | None = None
        self._is_asking = self._is_reviewing = self._is_in_doubt = False
        self._made: list[bytes] = []
        self._ordered: dict[bytes, None] = {}
        self._by = ""
        self._written: tuple[object, ...] = ({}, ())
        if entangled is not None:
            self._restore(entangled)

    @property
    def stops(self) -> Mapping[bytes, str]:
        """The stops in force, id to operator."""
        return self._set.in_force

    @property
    def is_stopped(self) -> bool:
        """Whether any stop is in force."""
        return bool(self._set.in_force)

    @property
    def is_on(self) -> bool:
        """Whether what acts is to stand: a stop is in force, or this node has just started and does not know yet."""
        return self.is_stopped or not self.is_known

    @property
    def by(self) -> str:
        """The operators whose stops are in force."""
        return ", ".join(dict.fromkeys(filter(None, self._set.in_force.values())))

    @property
    def records(self) -> list[Record]:
        """The records of the stops, where they are followed."""
        return [] if self._watch is None else self._watch.records

    def watch(self, obey: Callable[[], str]) -> None:
        """Call ``obey`` when the team is stopped and when it is released; it says in a few words what it does then."""
        self._obeying.append(obey)

    def follow(self) -> None:
        """Follow the records of the stops; they are in the node's store as well."""
        if self._entangled is not None and self._watch is None:
            self._watch = self._entangled.watch(HALT, self._merge_records, keep=True)
            self._review_later()

    def learn(self) -> None:
        """Follow the stops, and stand until the network has said which there are; call it again until it has."""
        if self._entangled is None or self._is_asking or (self._watch is not None and self.is_known):
            return
        self.follow()
        self.is_known, self._is_asking = False, True
        self._entangled.get(HALT).addCallbacks(self._learnt, self._unlearnt)

    def refresh(self) -> str:
        """Judge again what was in doubt, and obey; what this node does now, in a few words."""
        if self._is_in_doubt:
            self._merge_records(self.records)
        return self._obey()

    # -- what an operator orders ------------------------------------------------------------------------------------

    def stop(self, by: str, contacts: Collection[Contact]) -> Deferred[dict[str, str]]:
        """Stop the team; fires with what each of ``contacts`` does, by uuid, in a few words."""
        assert self._entangled is not None and self._rng is not None
        # A new id each time: a release that is under way, of an earlier stop, does not end this one.
        stop = self._rng.randbytes(ID_BYTES)
        made = [*(each for each in self._made if each in self.stops), stop]
        replaced, self._made = made[:-MADE], made[-MADE:]
        return self._order(Statement({stop: clipped(by)}, tuple(replaced), clipped(by)), contacts)

    def release(self, stops: Iterable[bytes], by: str, contacts: Collection[Contact]) -> Deferred[dict[str, str]]:
        """End these stops and no other ones; fires as ``stop`` does.  Raises ``ValueError`` for what is no id."""
        named = tuple(dict.fromkeys(stops))[:MAX_RELEASED]
        if not are_ids(named):
            raise ValueError(f"the id of a stop has {ID_BYTES} bytes")
        return self._order(Statement({}, named, clipped(by)), contacts)

    def _order(self, order: Statement, contacts: Collection[Contact]) -> Deferred[dict[str, str]]:
        assert self._entangled is not None
        self._by = order.by
        self._ordered = {**self._ordered, **dict.fromkeys(order.released)}
        while len(self._ordered) > RECORDED_RELEASES:
            del self._ordered[next(iter(self._ordered))]
        own = self._entangled.identity
        told = {own.node_id.hex(): self.take(own.public, order)}
        others = [contact for contact in contacts if contact.node_id != own.node_id]
        return DeferredList([self._tell(contact, order, told) for contact in others]).addCallback(lambda _: told)

    def _tell(self, contact: Contact, order: Statement, told: dict[str, str]) -> Deferred[None]:
        assert self._entangled is not None

        def answered(answer: Any) -> None:
            said = answer[0] if isinstance(answer, list) and answer else ""
            told[uuid] = said if isinstance(said, str) else ""

        def unanswered(failure: Any) -> None:
            failure.trap(EntangledError)
            told[uuid] = UNHEARD if failure.check(NoAnswer) else failure.getErrorMessage()

        uuid = contact.node_id.hex()
        asked = self._entangled.call(contact, METHOD, *order.packed(), changes=True)
        return asked.addCallbacks(answered, unanswered)

    # -- what others order ------------------------------------------------------------------------------------------

    def answer(self, peer: Contact, stops: list[object], released: list[object], by: str) -> Deferred[list[object]]:
        """Obey what a peer orders; what this node does now, and the stops that it obeys, once they are written."""
        statement = statement_of([stops, released, by])
        if statement is None:
            raise Refused(
                f"an order has at most {MAX_NAMED} stops [id, by], at most {MAX_RELEASED} ids of {ID_BYTES} bytes"
                " that it releases, and a name"
            )
        assert self._entangled is not None
        said = self.take(peer.public, statement)
        obeyed = [[stop, by] for stop, by in list(self.stops.items())[-MAX_RELEASED:]]

        def saved(_: None) -> list[object]:
            return [said, obeyed]

        def unsaved(failure: Any) -> list[object]:
            failure.trap(EntangledError)
            return [said + UNSAVED, obeyed]

        return self._entangled.store.written().addCallbacks(saved, unsaved)

    def take(self, sender: bytes, statement: Statement) -> str:
        """Merge an order of ``sender``, which may order; what this node does now, in a few words."""
        return self._settle(self._merge(sender, statement, may_release=True))

    def _merge(self, sender: bytes, statement: Statement, may_release: bool) -> bool:
        was_stopped = self.is_stopped
        is_new = self._set.merge(sender, statement, may_release)
        if was_stopped and not self.is_stopped:
            self.released_by = statement.by
        return is_new

    def _merge_records(self, records: list[Record]) -> None:
        assert self._entangled is not None
        own = self._entangled.identity.public
        is_new = self._is_in_doubt = False
        for record in records:
            statement = None
            if record.name == SLOT and record.value is not None and len(record.value) <= MAX_VALUE:
                statement = statement_in(record.owner, record.value)
            if statement is None or not self._entangled.replica.may_stay(record.slot):
                continue
            # The same right for both ways: the owner has to be one who may call the method.
            may_release = record.owner == own or self._entangled.endpoint.door.may(record.owner, METHOD)
            self._is_in_doubt |= not may_release and bool(statement.released)
            is_new |= self._merge(record.owner, statement, may_release)
        if is_new:
            self._settle(is_new)

    def _learnt(self, records: list[Record]) -> None:
        self.is_known, self._is_asking = True, False
        self._merge_records(records)
        self._obey()

    def _unlearnt(self, failure: Any) -> None:
        """Nobody answered; what needs to know asks again."""
        failure.trap(EntangledError)
        self._is_asking = False

    # -- inside -----------------------------------------------------------------------------------------------------

    def _settle(self, is_new: bool) -> str:
        """Obey, and keep and publish what is new."""
        said = self._obey()
        if is_new:
            self._save()
            self._publish()
            self._review_later()
        return said

    def _obey(self) -> str:
        said = ", ".join(obey() for obey in self._obeying) or NO_ROBOT
        self._report(list(self.stops), said if self.is_stopped else "")
        return said

    def _save(self) -> None:
        if self._entangled is not None:
            self._entangled.store.note(NOTE, msgpack.packb([*self._set.packed(), list(self._ordered)]))

    def _restore(self, entangled: EntangledNode) -> None:
        """Take up the stops of an earlier life; what cannot be read of them is a stop until it is released."""
        own, note = entangled.identity.public, entangled.store.noted(NOTE)
        if note is not None:
            try:
                *fields, ordered = msgpack.unpackb(note)
                self._set = unpacked(fields)
                self._ordered = dict.fromkeys(ordered if are_ids(ordered) else ())
            except Exception:  # a rotten file may hold anything, and the decoder raises many kinds
                self._set.merge(own, Statement({derived_id(own, note): "a damaged store"}))
        record = entangled.store.slot(Slot(HALT, own, SLOT))
        written = None if record is None else statement_in(own, record.value)
        if written is not None:
            self._written = (dict(written.stops), written.released)
        self._merge_records(entangled.store.get(HALT))
        if self.is_stopped:
            self._save()

    def _publish(self) -> None:
        """Name this node's stops and releases in its record, for those that cannot be told now, or come later."""
        if self._entangled is None:
            return
        own = self._entangled.identity.public
        stops = dict(list(self._set.of(own).items())[-MAX_NAMED:])
        released = tuple(self._ordered)
        if (stops, released) == self._written or not self._may_order():
            return
        value = bounded(msgpack.packb(Statement(stops, released, self._by).packed()))
        before, self._written = self._written, (stops, released)
        try:
            self._entangled.put(HALT, SLOT, value, "team").addErrback(_unwritten)
        except NotRunning:
            self._written = before

    def _review_later(self) -> None:
        if self._rng is not None and self._watch is not None and self.is_stopped and not self._is_reviewing:
            self._is_reviewing = True
            self._later(REVIEW * (1.0 + self._rng.random()), self._review)

    def _review(self) -> None:
        """Name a stop that no record names any more, where this node may, and look again later."""
        self._is_reviewing = False
        self._adopt()
        self._publish()
        self.refresh()
        self._review_later()

    def _adopt(self) -> None:
        assert self._entangled is not None
        own = self._entangled.identity.public
        statements = [statement_in(record.owner, record.value) for record in self.records if record.name == SLOT]
        named = {stop for statement in statements if statement is not None for stop in statement.stops}
        lost = {stop: by for stop, by in self.stops.items() if stop not in named}
        room = ADOPTED - len(self._set.of(own))
        if room > 0 and lost and self._may_order():
            self._settle(self._merge(own, Statement(dict(list(lost.items())[-room:])), may_release=True))

    def _may_order(self) -> bool:
        assert self._entangled is not None
        return self._entangled.replica.may_store(Slot(HALT, self._entangled.identity.public, SLOT))


def answer_halt(entangled: EntangledNode, rng: random.Random, later: Later, report: Report) -> Halt:
    """The stops as the node ``entangled`` knows them; peers may order stops and releases."""
    halt = Halt(entangled, rng, later, report)
    entangled.endpoint.expose(METHOD, halt.answer, changes=True, idempotent=True)
    return halt


def stops_in(records: list[Record]) -> dict[bytes, str]:
    """The stops in force by these records alone, id to operator."""
    found = StopSet()
    for record in records:
        statement = statement_in(record.owner, record.value) if record.name == SLOT else None
        if statement is not None:
            found.merge(record.owner, statement)
    return found.in_force


def _unwritten(failure: Any) -> None:
    """Too few hold it just now; its owner brings it to them when they are there."""
    failure.trap(EntangledError)
