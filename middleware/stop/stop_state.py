"""The emergency stops of the whole team that this node knows; the agent of this node obeys them.

A stop is sent to every device directly, and is also written as a record for devices that join later or did not receive
it.  It is in force until a release contains its id (``middleware.stop.stop_set``).  Stops and releases are accepted
only from members with the permission to give orders.  If the role of a record's owner is unknown, the record's stops
are accepted, but not its releases.

A node writes a stop to its store before it acknowledges the stop, so a restart does not release it.  If the author of a
stop has left or was revoked, it may happen that no record contains the stop.  Then a node with the permission to give
orders adds the stop to its own record.
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
from middleware.entangled.record import Record, Slot, hash_key
from middleware.entangled.replication.watch import Watch
from middleware.entangled.value import MAX_VALUE_BYTES, check_size
from middleware.stop.stop_set import (
    ID_BYTES,
    MAX_RELEASED,
    MAX_STOPS,
    Statement,
    StopSet,
    are_ids,
    clip_name,
    derive_id,
    parse_record_value,
    parse_statement,
    parse_stop_set,
)

STOPS_KEY = hash_key("halt")
SLOT = "halt"
METHOD = "device.halt"
NOTE_NAME = "halt/stops"
"""The key in the node's store for the stops in force, the released stops, and the releases that this node ordered."""
STANDS_STILL = "stands"
CONTINUES = "goes on"
NO_ROBOT = "has no robot"
NO_ANSWER = "did not answer; it stops when it receives the stop, or when its lease expires"
NOT_SAVED = "; it cannot save the stop: a restart of its node may end it"
RECORDED_RELEASES = 16
"""Maximum number of releases in the node's own record; the newest are kept."""
MAX_OWN_STOPS = MAX_ADOPTED_STOPS = MAX_STOPS // 2
"""Maximum number of a node's own stops in force, and of adopted stops; a further own stop replaces the oldest."""
REVIEW_INTERVAL_S = 10.0
"""Minimum seconds between two checks for stops without a record while the team is stopped.

The maximum is twice this value.
"""

Report = Callable[[Collection[bytes], str], None]
"""Called with the ids of the stops that the node obeys, and a short text about its activity."""
Later = Callable[[float, Callable[[], None]], object]


class StopState:
    """The stops that this node knows; agents check ``is_motion_forbidden`` before they act, and report their activity.

    ``later(seconds, call)`` calls ``call`` after ``seconds``, unless the node is stopped first; ``report`` is called
    after each change.  If ``entangled`` is None, no stop is ever in force.
    """

    def __init__(
        self,
        entangled: EntangledNode | None = None,
        rng: random.Random | None = None,
        later: Later = lambda seconds, call: None,
        report: Report = lambda stops, text: None,
    ) -> None:
        self.is_known = True
        self.released_by = ""
        self._stop_set = StopSet()
        self._entangled = entangled
        self._rng = rng
        self._later = later
        self._report = report
        self._listeners: list[Callable[[], str]] = []
        self._watch: Watch | None = None
        self._is_requesting = self._is_reviewing = self._has_doubtful = False
        self._own_stops: list[bytes] = []
        self._own_releases: dict[bytes, None] = {}
        self._operator = ""
        self._written_record: tuple[object, ...] = ({}, ())
        if entangled is not None:
            self._restore(entangled)

    @property
    def stops(self) -> Mapping[bytes, str]:
        """The stops in force (id to operator)."""
        return self._stop_set.in_force

    @property
    def is_stopped(self) -> bool:
        """Whether any stop is in force."""
        return bool(self._stop_set.in_force)

    @property
    def is_motion_forbidden(self) -> bool:
        """Whether robots must stand still: a stop is in force, or this node does not know the stops yet."""
        return self.is_stopped or not self.is_known

    @property
    def operators(self) -> str:
        """The names of the operators that ordered the stops in force."""
        return ", ".join(dict.fromkeys(filter(None, self._stop_set.in_force.values())))

    @property
    def records(self) -> list[Record]:
        """The watched records of the stops; empty before ``follow``."""
        return [] if self._watch is None else self._watch.records

    def subscribe(self, obey: Callable[[], str]) -> None:
        """Call ``obey`` when the team is stopped or released; it must return the agent's activity as a short text."""
        self._listeners.append(obey)

    def follow(self) -> None:
        """Watch the records of the stops, and keep them in the node's store."""
        if self._entangled is not None and self._watch is None:
            self._watch = self._entangled.watch(STOPS_KEY, self._merge_records, keep=True)
            self._review_later()

    def request_stops(self) -> None:
        """Watch the stops, and forbid motion until the network has returned them.

        Agents repeat this call until then.
        """
        if self._entangled is None or self._is_requesting or (self._watch is not None and self.is_known):
            return
        self.follow()
        self.is_known, self._is_requesting = False, True
        self._entangled.get(STOPS_KEY).addCallbacks(self._on_records, self._ignore_unreachable)

    def recheck(self) -> str:
        """Check again the records whose releases were not accepted; let the agent obey, and return its activity."""
        if self._has_doubtful:
            self._merge_records(self.records)
        return self._notify()

    # -- orders of this node's operator -----------------------------------------------------------------------------

    def stop(self, by: str, contacts: Collection[Contact]) -> Deferred[dict[str, str]]:
        """Stop the team; fire with a short text about the activity of each of ``contacts``, by uuid."""
        assert self._entangled is not None and self._rng is not None
        # Use a new id each time, so that a late release of an earlier stop does not end this one.
        stop = self._rng.randbytes(ID_BYTES)
        own_stops = [*(each for each in self._own_stops if each in self.stops), stop]
        replaced, self._own_stops = own_stops[:-MAX_OWN_STOPS], own_stops[-MAX_OWN_STOPS:]
        return self._order(Statement({stop: clip_name(by)}, tuple(replaced), clip_name(by)), contacts)

    def release(self, stops: Iterable[bytes], by: str, contacts: Collection[Contact]) -> Deferred[dict[str, str]]:
        """Release only these stops; fire as ``stop`` does.  Raise ``ValueError`` for an invalid id."""
        named = tuple(dict.fromkeys(stops))[:MAX_RELEASED]
        if not are_ids(named):
            raise ValueError(f"the id of a stop must have {ID_BYTES} bytes")
        return self._order(Statement({}, named, clip_name(by)), contacts)

    def _order(self, order: Statement, contacts: Collection[Contact]) -> Deferred[dict[str, str]]:
        assert self._entangled is not None
        self._operator = order.by
        self._own_releases = {**self._own_releases, **dict.fromkeys(order.released)}
        while len(self._own_releases) > RECORDED_RELEASES:
            del self._own_releases[next(iter(self._own_releases))]
        own = self._entangled.identity
        answers = {own.node_id.hex(): self.apply_order(own.public, order)}
        others = [contact for contact in contacts if contact.node_id != own.node_id]
        return DeferredList([self._send_order(contact, order, answers) for contact in others]).addCallback(
            lambda _: answers
        )

    def _send_order(self, contact: Contact, order: Statement, answers: dict[str, str]) -> Deferred[None]:
        assert self._entangled is not None

        def answered(answer: Any) -> None:
            activity = answer[0] if isinstance(answer, list) and answer else ""
            answers[uuid] = activity if isinstance(activity, str) else ""

        def unanswered(failure: Any) -> None:
            failure.trap(EntangledError)
            answers[uuid] = NO_ANSWER if failure.check(NoAnswer) else failure.getErrorMessage()

        uuid = contact.node_id.hex()
        request = self._entangled.call(contact, METHOD, *order.pack(), changes=True)
        return request.addCallbacks(answered, unanswered)

    # -- orders of other nodes --------------------------------------------------------------------------------------

    def answer(self, peer: Contact, stops: list[object], released: list[object], by: str) -> Deferred[list[object]]:
        """Obey a peer's order; when it is stored, fire with the node's activity and the stops that the node obeys."""
        statement = parse_statement([stops, released, by])
        if statement is None:
            raise Refused(
                f"an order must have at most {MAX_STOPS} stops [id, by], at most {MAX_RELEASED} ids of {ID_BYTES} bytes"
                " to release, and the operator's name"
            )
        assert self._entangled is not None
        activity = self.apply_order(peer.public, statement)
        obeyed = [[stop, by] for stop, by in list(self.stops.items())[-MAX_RELEASED:]]

        def saved(_: None) -> list[object]:
            return [activity, obeyed]

        def unsaved(failure: Any) -> list[object]:
            failure.trap(EntangledError)
            return [activity + NOT_SAVED, obeyed]

        return self._entangled.store.wait_for_write().addCallbacks(saved, unsaved)

    def apply_order(self, sender: bytes, statement: Statement) -> str:
        """Merge an order of ``sender``, a node that may give orders; return the activity as a short text."""
        return self._apply(self._merge(sender, statement, may_release=True))

    def _merge(self, sender: bytes, statement: Statement, may_release: bool) -> bool:
        was_stopped = self.is_stopped
        is_new = self._stop_set.merge(sender, statement, may_release)
        if was_stopped and not self.is_stopped:
            self.released_by = statement.by
        return is_new

    def _merge_records(self, records: list[Record]) -> None:
        assert self._entangled is not None
        own = self._entangled.identity.public
        is_new = self._has_doubtful = False
        for record in records:
            statement = None
            if record.name == SLOT and record.value is not None and len(record.value) <= MAX_VALUE_BYTES:
                statement = parse_record_value(record.owner, record.value)
            if statement is None or not self._entangled.replica.may_stay(record.slot):
                continue
            # The same permission as for calls: the owner must be allowed to call the method.
            may_release = record.owner == own or self._entangled.endpoint.admission.may_call(record.owner, METHOD)
            self._has_doubtful |= not may_release and bool(statement.released)
            is_new |= self._merge(record.owner, statement, may_release)
        if is_new:
            self._apply(is_new)

    def _on_records(self, records: list[Record]) -> None:
        self.is_known, self._is_requesting = True, False
        self._merge_records(records)
        self._notify()

    def _ignore_unreachable(self, failure: Any) -> None:
        """Ignore an unanswered request; agents call ``request_stops`` again."""
        failure.trap(EntangledError)
        self._is_requesting = False

    # -- inside -----------------------------------------------------------------------------------------------------

    def _apply(self, is_new: bool) -> str:
        """Obey, then save and publish changes."""
        activity = self._notify()
        if is_new:
            self._save()
            self._publish()
            self._review_later()
        return activity

    def _notify(self) -> str:
        activity = ", ".join(obey() for obey in self._listeners) or NO_ROBOT
        self._report(list(self.stops), activity if self.is_stopped else "")
        return activity

    def _save(self) -> None:
        if self._entangled is not None:
            self._entangled.store.set_note(NOTE_NAME, msgpack.packb([*self._stop_set.pack(), list(self._own_releases)]))

    def _restore(self, entangled: EntangledNode) -> None:
        """Load the stops of an earlier run; an unreadable entry is treated as a stop until it is released."""
        own, note = entangled.identity.public, entangled.store.get_note(NOTE_NAME)
        if note is not None:
            try:
                *fields, ordered = msgpack.unpackb(note)
                self._stop_set = parse_stop_set(fields)
                self._own_releases = dict.fromkeys(ordered if are_ids(ordered) else ())
            except Exception:  # a corrupt file may have any content, and the decoder raises many kinds of exceptions
                self._stop_set.merge(own, Statement({derive_id(own, note): "a damaged store"}))
        record = entangled.store.get_slot(Slot(STOPS_KEY, own, SLOT))
        written = None if record is None else parse_record_value(own, record.value)
        if written is not None:
            self._written_record = (dict(written.stops), written.released)
        self._merge_records(entangled.store.get(STOPS_KEY))
        if self.is_stopped:
            self._save()

    def _publish(self) -> None:
        """Write this node's stops and releases to its record, for devices that are unreachable now or join later."""
        if self._entangled is None:
            return
        own = self._entangled.identity.public
        stops = dict(list(self._stop_set.get_stops(own).items())[-MAX_STOPS:])
        released = tuple(self._own_releases)
        if (stops, released) == self._written_record or not self._may_order():
            return
        value = check_size(msgpack.packb(Statement(stops, released, self._operator).pack()))
        before, self._written_record = self._written_record, (stops, released)
        try:
            self._entangled.put(STOPS_KEY, SLOT, value, "team").addErrback(_ignore_unwritten)
        except NotRunning:
            self._written_record = before

    def _review_later(self) -> None:
        if self._rng is not None and self._watch is not None and self.is_stopped and not self._is_reviewing:
            self._is_reviewing = True
            self._later(REVIEW_INTERVAL_S * (1.0 + self._rng.random()), self._review)

    def _review(self) -> None:
        """Adopt stops that are no longer in any record, if this node may give orders, and check again later."""
        self._is_reviewing = False
        self._adopt()
        self._publish()
        self.recheck()
        self._review_later()

    def _adopt(self) -> None:
        assert self._entangled is not None
        own = self._entangled.identity.public
        statements = [parse_record_value(record.owner, record.value) for record in self.records if record.name == SLOT]
        named = {stop for statement in statements if statement is not None for stop in statement.stops}
        orphaned = {stop: by for stop, by in self.stops.items() if stop not in named}
        free_entries = MAX_ADOPTED_STOPS - len(self._stop_set.get_stops(own))
        if free_entries > 0 and orphaned and self._may_order():
            self._apply(self._merge(own, Statement(dict(list(orphaned.items())[-free_entries:])), may_release=True))

    def _may_order(self) -> bool:
        assert self._entangled is not None
        return self._entangled.replica.may_store(Slot(STOPS_KEY, self._entangled.identity.public, SLOT))


def expose_stops(entangled: EntangledNode, rng: random.Random, later: Later, report: Report) -> StopState:
    """Create the stop state of the node ``entangled``, and let peers order stops and releases."""
    stop_state = StopState(entangled, rng, later, report)
    entangled.endpoint.expose(METHOD, stop_state.answer, changes=True, idempotent=True)
    return stop_state


def collect_stops(records: list[Record]) -> dict[bytes, str]:
    """Return the stops that are in force according to these records alone (id to operator)."""
    found = StopSet()
    for record in records:
        statement = parse_record_value(record.owner, record.value) if record.name == SLOT else None
        if statement is not None:
            found.merge(record.owner, statement)
    return found.in_force


def _ignore_unwritten(failure: Any) -> None:
    """Ignore the error that too few replicas are reachable: the owner writes the record again when enough are."""
    failure.trap(EntangledError)
