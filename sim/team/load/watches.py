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
from middleware.entangled.record import Record, hashed_key
from sim.team.figure import Figure, share, spread
from sim.team.load.residents import Load, Pace
from sim.team.team import Team

NAME = "watched"


@dataclass(frozen=True)
class WatchSettings:
    """``[load.watches]``: the numbers of keys and watchers."""

    keys: Annotated[int, Meta(ge=1, le=100_000)] = 10
    """Number of watched keys."""

    watchers: Annotated[int, Meta(ge=1, le=10_000)] = 10
    """Number of watchers of each key; a dead watcher is replaced."""

    rate: Annotated[float, Meta(ge=0.001, le=10_000.0)] = 1.0
    """Changes per second of all keys together."""

    limit: Annotated[float, Meta(ge=0.1, le=600.0), Unit("seconds")] = 10.0
    """Time limit of a notification in seconds."""


@dataclass
class Follower:
    """One watch: the watching node, its life, and the newest change received from each owner."""

    place: int
    life: EntangledNode
    heard: dict[bytes, int] = field(default_factory=dict)


@dataclass
class Change:
    """One change: its time, its owner, and the watchers to be notified."""

    number: int
    key: bytes
    owner: bytes
    at: float
    waiting: dict[int, Follower]
    """The watchers that have not been notified, by place."""


class Watches(Load):
    """The workload ``watches``."""

    def __init__(self, team: Team, settings: WatchSettings) -> None:
        super().__init__(team, "watches")
        self._settings = settings
        self._pace = Pace(team.clock, settings.rate)
        self._keys = [hashed_key(f"watched {number}") for number in range(settings.keys)]
        self._followers: dict[bytes, list[Follower]] = {}
        self._open: list[Change] = []
        self._changes = 0
        self.heard = self.unheard = 0
        self.seconds: list[float] = []

    def step(self) -> None:
        """Keep the number of watchers of each key, and make the changes that are due."""
        for key in self._keys:
            self._follow(key)
        for _ in range(self._pace.due()):
            self._change(self._keys[self._rng.randrange(len(self._keys))])
        self._drop_late()

    def settled(self) -> None:
        """Count the missed notifications."""
        self._drop_late()

    def figures(self) -> list[Figure]:
        """Return the share of notifications in time, and their delays."""
        return [
            share("watches.heard", self.heard, self.heard + self.unheard),
            *spread("watches.seconds", self.seconds, "s", (0.5, 0.99)),
        ]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _follow(self, key: bytes) -> None:
        followers = [one for one in self._followers.get(key, ()) if self._residents.lives(one.place, one.life)]
        taken = {one.place for one in followers}
        wanted = self._settings.watchers - len(followers)
        for place in self._residents.any(self._rng, self._settings.watchers) if wanted > 0 else ():
            if place not in taken and len(followers) < self._settings.watchers:
                life = self._residents.node(place)
                follower = Follower(place, life)
                life.watch(key, self._hearer(follower, key))
                followers.append(follower)
        self._followers[key] = followers

    def _hearer(self, follower: Follower, key: bytes) -> Callable[[list[Record]], None]:
        def changed(records: list[Record]) -> None:
            now = self._clock.seconds()
            for record in records:
                if record.name == NAME and record.value is not None:
                    known = follower.heard.get(record.owner, 0)
                    follower.heard[record.owner] = max(known, int(record.value))
            for change in self._open:
                is_heard = change.key == key and follower.heard.get(change.owner, 0) >= change.number
                if is_heard and change.waiting.get(follower.place) is follower:
                    del change.waiting[follower.place]
                    self.heard += 1
                    self.seconds.append(now - change.at)

        return changed

    def _change(self, key: bytes) -> None:
        place = self._residents.any(self._rng)
        life = self._residents.node(place[0]) if place else None
        if life is None:
            return
        self._changes += 1
        number = self._changes
        others = {one.place: one for one in self._followers.get(key, ()) if one.life is not life}
        self._open.append(Change(number, key, life.identity.public, self._clock.seconds(), others))
        life.put(key, NAME, b"%d" % number).addErrback(lambda failure: self._not_stored(failure, number))

    def _not_stored(self, failure: Failure, number: int) -> None:
        """Drop a change that no replica acknowledged; watchers may see a partially acknowledged one."""
        failure.trap(EntangledError)
        if not failure.check(NotAcknowledged):
            self._open = [change for change in self._open if change.number != number]

    def _drop_late(self) -> None:
        since = self._clock.seconds() - self._settings.limit
        for change in self._open:
            dead = [p for p, one in change.waiting.items() if not self._residents.lives(p, one.life)]
            for place in dead:
                del change.waiting[place]
            if change.at <= since:
                self.unheard += len(change.waiting)
        self._open = [change for change in self._open if change.at > since and change.waiting]
