"""Workload: watch keys that other nodes change; measures the time until each watcher is notified."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated

from msgspec import Meta
from twisted.python.failure import Failure

from formats.convert import Unit
from middleware.entangled.errors import EntangledError, NotAcknowledged
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, hash_key
from sim.team.load.client_workload import ClientWorkload, Pacer
from sim.team.metric import Metric, make_percentiles, make_share
from sim.team.team import Team

NAME = "watched"


@dataclass(frozen=True)
class WatchSettings:
    """``[load.watches]``: the numbers of keys and watchers, and the rate of changes."""

    keys: Annotated[int, Meta(ge=1, le=100_000)] = 10
    """Number of watched keys."""

    watchers: Annotated[int, Meta(ge=1, le=10_000)] = 10
    """Number of watchers of each key; a dead watcher is replaced."""

    rate: Annotated[float, Meta(ge=0.001, le=10_000.0)] = 1.0
    """Changes per second of all keys together."""

    limit: Annotated[float, Meta(ge=0.1, le=600.0), Unit("seconds")] = 10.0
    """Time limit of a notification in seconds."""


@dataclass
class KeyWatcher:
    """One watch: the watching node, its life, and the newest change received from each owner."""

    place: int
    life: EntangledNode
    newest: dict[bytes, int] = field(default_factory=dict)


@dataclass
class Change:
    """One change: its time, its owner, and the watchers to be notified."""

    number: int
    key: bytes
    owner: bytes
    at: float
    waiting: dict[int, KeyWatcher]
    """The watchers that have not been notified, by place."""


class Watches(ClientWorkload):
    """The workload ``watches``."""

    def __init__(self, team: Team, settings: WatchSettings) -> None:
        super().__init__(team, "watches")
        self._settings = settings
        self._pace = Pacer(team.clock, settings.rate)
        self._keys = [hash_key(f"watched {number}") for number in range(settings.keys)]
        self._watchers: dict[bytes, list[KeyWatcher]] = {}
        self._open: list[Change] = []
        self._changes = 0
        self.notified_count = self.missed_count = 0
        self.seconds: list[float] = []

    def step(self) -> None:
        """Replace dead watchers, and make the changes that are due."""
        for key in self._keys:
            self._add_watchers(key)
        for _ in range(self._pace.take_due()):
            self._make_change(self._keys[self._rng.randrange(len(self._keys))])
        self._drop_late()

    def make_final_requests(self) -> None:
        """Count the missed notifications."""
        self._drop_late()

    def collect_metrics(self) -> list[Metric]:
        """Return the share of notifications in time, and their delays."""
        return [
            make_share("watches.heard", self.notified_count, self.notified_count + self.missed_count),
            *make_percentiles("watches.seconds", self.seconds, "s", (0.5, 0.99)),
        ]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _add_watchers(self, key: bytes) -> None:
        followers = [one for one in self._watchers.get(key, ()) if self._joined.is_alive(one.place, one.life)]
        taken = {one.place for one in followers}
        wanted = self._settings.watchers - len(followers)
        for place in self._joined.any(self._rng, self._settings.watchers) if wanted > 0 else ():
            if place not in taken and len(followers) < self._settings.watchers:
                life = self._joined.node(place)
                follower = KeyWatcher(place, life)
                life.watch(key, self._make_callback(follower, key))
                followers.append(follower)
        self._watchers[key] = followers

    def _make_callback(self, follower: KeyWatcher, key: bytes) -> Callable[[list[Record]], None]:
        def changed(records: list[Record]) -> None:
            now = self._clock.seconds()
            for record in records:
                if record.name == NAME and record.value is not None:
                    known = follower.newest.get(record.owner, 0)
                    follower.newest[record.owner] = max(known, int(record.value))
            for change in self._open:
                is_heard = change.key == key and follower.newest.get(change.owner, 0) >= change.number
                if is_heard and change.waiting.get(follower.place) is follower:
                    del change.waiting[follower.place]
                    self.notified_count += 1
                    self.seconds.append(now - change.at)

        return changed

    def _make_change(self, key: bytes) -> None:
        place = self._joined.any(self._rng)
        life = self._joined.node(place[0]) if place else None
        if life is None:
            return
        self._changes += 1
        number = self._changes
        others = {one.place: one for one in self._watchers.get(key, ()) if one.life is not life}
        self._open.append(Change(number, key, life.identity.public, self._clock.seconds(), others))
        life.put(key, NAME, b"%d" % number).addErrback(lambda failure: self._on_put_failed(failure, number))

    def _on_put_failed(self, failure: Failure, number: int) -> None:
        """Drop a change that was not acknowledged; watchers may nevertheless receive it."""
        failure.trap(EntangledError)
        if not failure.check(NotAcknowledged):
            self._open = [change for change in self._open if change.number != number]

    def _drop_late(self) -> None:
        since = self._clock.seconds() - self._settings.limit
        for change in self._open:
            dead = [p for p, one in change.waiting.items() if not self._joined.is_alive(p, one.life)]
            for place in dead:
                del change.waiting[place]
            if change.at <= since:
                self.missed_count += len(change.waiting)
        self._open = [change for change in self._open if change.at > since and change.waiting]
