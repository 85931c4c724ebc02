"""Workload: store values, kill some of their holders simultaneously, and read the values at other nodes.

With ``deaths`` "quorum", all but one of the nodes that acknowledged the value are killed; an acknowledged value must
survive this (invariant D1). With "none", only the faults of the scenario kill nodes, for example to compare the loss
of half of a network with the model 2 ** -k. A read may return the value or "unavailable", but never "not found"; a
value that cannot be read for ``patience`` seconds is lost.

With "none", a random reader looks up the holders of each value before the value is read; the figure is the share of
the holders (among the k closest nodes) that the reader finds. Lookups of KAD in the field found 18 % (Kang et al.,
2009).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta
from twisted.python.failure import Failure

from formats.convert import Unit, one_of
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError
from middleware.entangled.identity import derive_node_id
from middleware.entangled.kademlia.distance import distance
from middleware.entangled.kademlia.overlay import K
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, Slot, hash_key
from middleware.entangled.replication.owner import Stored
from sim.team.load.client_workload import ClientWorkload, Pacer
from sim.team.load.lookups import MAX_LISTED
from sim.team.metric import Metric, make_maximum, make_percentiles, make_share, mean
from sim.team.team import Team

QUORUM, NONE = "quorum", "none"
RETRY_S = 2.0
"""Seconds between two attempts to read an unavailable value."""
NAME = "value"


@dataclass(frozen=True)
class ValueSettings:
    """``[load.values]``: the number of values, and the deaths."""

    count: Annotated[int, Meta(ge=1, le=1_000_000)] = 1000
    """Total number of values."""

    rate: Annotated[float, Meta(ge=0.001, le=10_000.0)] = 1.0
    """Values stored per second."""

    deaths: Annotated[str, one_of((NONE, QUORUM))] = NONE
    """``quorum``: kill all but one of the nodes that acknowledged the value; ``none``: only the faults of the
    scenario."""

    age: Annotated[float, Meta(ge=0.0, le=86_400.0), Unit("seconds")] = 5.0
    """Seconds from these deaths until a value is read; with ``none`` values are read at the end."""

    away: Annotated[float, Meta(ge=1.0, le=86_400.0), Unit("seconds")] = 30.0
    """Seconds after which each dead node is replaced by a new node."""

    patience: Annotated[float, Meta(ge=0.0, le=3600.0), Unit("seconds")] = 90.0
    """Seconds for which reads are retried before a value is regarded as lost. Dead replicas are part of a majority for
    at least half a minute, so a value whose holders are mostly dead may be unavailable for this time."""


@dataclass
class Value:
    """One value and its state."""

    number: int
    key: bytes
    slot: Slot
    began: float
    acknowledged: int = 0
    killed: int = 0
    asked_since: float = 0.0

    @property
    def content(self) -> bytes:
        """The stored bytes."""
        return b"value %d" % self.number


class Values(ClientWorkload):
    """The workload ``values``."""

    def __init__(self, team: Team, settings: ValueSettings) -> None:
        super().__init__(team, "values")
        self._settings = settings
        self._pace = Pacer(team.clock, settings.rate, settings.count)
        self._begun = 0
        self._waiting: list[Value] = []
        self.failed_puts = 0
        self.put_seconds: list[float] = []
        self.get_seconds: list[float] = []
        self.outages: list[float] = []
        self.holders: list[float] = []
        self.copies: list[float] = []
        self.kills = self.read = self.lost = self.missing = self.unread = 0
        self._violations: list[str] = []

    def step(self) -> None:
        """Store the values that are due."""
        for _ in range(self._pace.take_due()):
            place = self._joined.any(self._rng)
            if place:
                self._put(place[0])

    def make_final_requests(self) -> None:
        """Read the values that have not been read yet."""
        waiting, self._waiting = self._waiting, []
        for value in waiting:
            self._count_holders(value)
            self._read(value)

    def find_violations(self) -> list[str]:
        """Return lost values and wrong "not found" answers; empty with "none": faults may exceed the tolerance."""
        return self._violations if self._settings.deaths == QUORUM else []

    def collect_metrics(self) -> list[Metric]:
        """Return durability, times, and the share of holders that a reader finds."""
        over = self.read + self.lost
        figures = [
            Metric("values.acknowledged", float(self._begun - self.failed_puts), "values", n=self._begun),
            *make_percentiles("values.put", self.put_seconds, "s", (0.5, 0.99)),
            *make_percentiles("values.get", self.get_seconds, "s", (0.5, 0.99)),
            make_share("values.read", self.read, over),
            make_share("values.read_at_once", self.read - len(self.outages), over),
            Metric("values.outage.max", max(self.outages, default=0.0), "s", n=len(self.outages)),
            Metric("values.missing", float(self.missing), "answers", n=over),
            Metric("values.open", float(self.unread), "values"),
        ]
        if self._settings.deaths == QUORUM:
            lost = make_maximum("values.lost", float(self.lost), "values", 0.0, n=over)
            return [*figures, lost, Metric("values.killed", float(self.kills), "nodes")]
        figures += [
            Metric("values.holders_found", mean(self.holders), "share", n=len(self.holders)),
            Metric("values.copies", mean(self.copies), "nodes", n=len(self.copies)),
        ]
        return [*figures, Metric("values.lost", self.lost / over if over else None, "share", n=over)]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _put(self, place: int) -> None:
        life = self._joined.node(place)
        self._begun += 1
        key = hash_key(f"{NAME} {self._begun}")
        value = Value(self._begun, key, Slot(key, life.identity.public, NAME), self._clock.seconds())
        life.put(key, NAME, value.content).addCallbacks(self._on_stored, self._on_put_failed, (value,))

    def _on_put_failed(self, failure: Failure) -> None:
        failure.trap(EntangledError)
        self.failed_puts += 1

    def _on_stored(self, stored: Stored, value: Value) -> None:
        value.acknowledged = int(stored)
        self.put_seconds.append(self._clock.seconds() - value.began)
        if self._settings.deaths == QUORUM:
            self._kill(value)
            self._clock.callLater(self._settings.age, self._read, value)
        else:
            self._waiting.append(value)

    def _find_holders(self, value: Value) -> list[int]:
        """Return the places of living nodes that hold the value."""
        holders = []
        for place in self._joined.list_places():
            held = self._joined.node(place).store.get_slot(value.slot)
            if held is not None and held.value == value.content:
                holders.append(place)
        return holders

    def _kill(self, value: Value) -> None:
        """Kill nodes that acknowledged the value: as many as the value must survive."""
        held = self._find_holders(value)
        dying = self._rng.sample(held, min(value.acknowledged - 1, len(held) - 1)) if held else []
        for place in dying:
            self.kills += 1
            value.killed += 1
            self._team.kill(place)
            self._clock.callLater(self._settings.away, self._replace_node, place)

    def _replace_node(self, place: int) -> None:
        if place not in self._team.living:
            self._team.replace(place)
            self._team.start(place)

    def _count_holders(self, value: Value) -> None:
        """Let a random node look up the holders, and count the holders that it finds."""
        held = [self._joined.node(place) for place in self._find_holders(value)]
        life = self._choose_reader()
        if life is None or not held:
            return
        self.copies.append(float(len(held)))
        ids = sorted((one.identity.node_id for one in held), key=lambda id_: distance(id_, value.key))[:K]
        life.find_node(value.key).addCallbacks(self._on_holders_found, _ignore_failure, (ids, life))

    def _on_holders_found(self, contacts: list[Contact], ids: list[bytes], reader: EntangledNode) -> None:
        seen = {contact.node_id for contact in contacts} | {derive_node_id(reader.identity.public)}
        self.holders.append(sum(id_ in seen for id_ in ids) / len(ids))

    def _read(self, value: Value) -> None:
        now = self._clock.seconds()
        if not value.asked_since:
            value.asked_since = now
            self.unread += 1
        life = self._choose_reader()
        if life is None:
            self._retry_or_give_up(value)
            return
        life.get(value.key).addCallbacks(self._on_read, self._on_unavailable, (value, now), {}, (value,))

    def _choose_reader(self) -> EntangledNode | None:
        chosen = self._joined.any(self._rng)
        return self._joined.node(chosen[0]) if chosen else None

    def _on_read(self, records: list[Record], value: Value, asked_at: float) -> None:
        if any(record.slot == value.slot and record.value == value.content for record in records):
            now = self._clock.seconds()
            self.get_seconds.append(now - asked_at)
            if asked_at > value.asked_since:
                self.outages.append(asked_at - value.asked_since)
            self.read += 1
            self.unread -= 1
            return
        self.missing += 1
        self._add_violation(f"D1: value {value.number}, acknowledged by {value.acknowledged}, is reported as not found")
        self._retry_or_give_up(value)

    def _on_unavailable(self, failure: Failure, value: Value) -> None:
        failure.trap(EntangledError)
        self._retry_or_give_up(value)

    def _retry_or_give_up(self, value: Value) -> None:
        if self._clock.seconds() - value.asked_since < self._settings.patience:
            self._clock.callLater(RETRY_S, self._read, value)
            return
        self.lost += 1
        self.unread -= 1
        after = f"after {value.killed} of {value.acknowledged} that acknowledged it died"
        self._add_violation(f"D1: value {value.number} is lost {after}")

    def _add_violation(self, line: str) -> None:
        if len(self._violations) < MAX_LISTED:
            self._violations.append(line)


def _ignore_failure(failure: Failure) -> None:
    failure.trap(EntangledError)
