"""The workload of tuples: puts, takes, claims and reads by several clients, and T1 to T6 over what came of them."""

from __future__ import annotations

import random
from collections import defaultdict
from typing import Any

from twisted.python.failure import Failure

from benchmarks.takers import Witness
from middleware.entangled.errors import EntangledError
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record
from middleware.entangled.space.claim import Claim
from middleware.entangled.space.decree import reply_unpacked
from middleware.entangled.space.posting import Posted
from middleware.entangled.space.template import ANY, Tuple
from middleware.entangled.space.tuplespace import TupleSpace
from tests.invariants.schedule import Schedule

JOB = ("job", int, ANY)
BELL = ("bell", int)
MOST_WAITING = 6
WAKE = 1.0
"""Seconds within which whoever waits is woken (T6)."""
SWEEP = (3.0, 6.0)
"""Seconds after the repair interval at which whatever is left is taken."""


class Tuples:
    """Clients of every node put, take, claim and read jobs; two of them wait for a bell that rings at the end."""

    def __init__(self, schedule: Schedule) -> None:
        self._schedule = schedule
        self._clock = schedule.fleet.clock
        self._rng = random.Random(f"tuples/{schedule.seed}")
        self._witness = Witness()
        self._spaces: dict[int, TupleSpace] = {}
        self._lives = 0
        self._number = 0
        self._acknowledged: dict[Tuple, None] = {}
        self._told: dict[Tuple, list[str]] = defaultdict(list)
        self._found: list[str] = []
        self._is_over = False
        self._rung_at: float | None = None
        self._listening: dict[str, float | None] = {}
        self._reads = 0
        schedule.attend(self._born, self._died)

    def step(self) -> None:
        """A few operations at random nodes."""
        if not self._spaces:
            return
        if self._rng.random() < 0.4 and len(self._witness.open()) < MOST_WAITING:
            self._put()
        if self._rng.random() < 0.6:
            place = self._rng.choice(sorted(self._spaces))
            act = self._rng.choice([self._take, self._take, self._take_some, self._claim, self._look, self._again])
            act(place, self._spaces[place])

    def settled(self) -> None:
        """Everybody reads all tuples; then a bell rings, and what is left is taken."""
        self._is_over = True
        for place, space in sorted(self._spaces.items()):
            reading = space.read_all(JOB)
            reading.addCallbacks(self._check, self._failed, (place,), {}, ("a read of all tuples",))
            self._listen(f"node {place}, which waits in the calm", space)
        self._clock.callLater(1.0, self._ring)
        for moment in SWEEP:
            self._clock.callLater(moment, self._sweep)

    def verdict(self) -> list[str]:
        """What was found, and the tuples that nobody got."""
        for line in self._witness.split():
            self._say("T1", line)
        for fields, ways in self._told.items():
            if len(ways) > 1:
                self._say("T1", f"{fields} was confirmed to {' and '.join(ways)}")
        for posted in self._witness.open():
            if posted.fields in self._acknowledged and self._can_decide(posted):
                self._say("T5", f"{posted.fields} is held by nobody who lives, and cannot be taken")
        if self._rung_at is None:
            self._say("T2", "a put is not acknowledged after everything healed")
        else:
            for who, at in self._listening.items():
                if at is None or at > self._rung_at + WAKE:
                    late = "never" if at is None else f"{at - self._rung_at:.2f} s later"
                    self._say("T6", f"{who}, hears the bell {late}")
        for space in self._spaces.values():
            space.stop()
        return self._found

    # -- lives ------------------------------------------------------------------------------------------------------

    def _born(self, place: int, node: EntangledNode) -> None:
        self._lives += 1
        inner = node.replica.on_record

        def on_record(record: Record) -> None:
            self._witness.stored(record)
            inner(record)

        node.replica.on_record = on_record
        rng = random.Random(f"tuples/{self._schedule.seed}/{place}/{self._lives}")
        space = self._spaces[place] = TupleSpace(node, self._clock, rng)
        self._witness.attend(node.seat, node.endpoint.expose, node.identity.public)
        if place < 2:
            # A moment later, for it may not have started yet.
            self._clock.callLater(0.1, self._wait, place, space)

    def _died(self, place: int, node: EntangledNode) -> None:
        self._spaces.pop(place).stop()
        self._listening.pop(f"node {place}, which waits through it all", None)

    def _wait(self, place: int, space: TupleSpace) -> None:
        if self._spaces.get(place) is space:
            self._listen(f"node {place}, which waits through it all", space)

    def _can_decide(self, posted: Posted) -> bool:
        """Whether a majority of the council lives, and remembers."""
        seats = {node.identity.public: node.seat for node in map(self._schedule.node, self._schedule.alive())}
        there = [m for m in posted.council if m.contact.public in seats]
        able = [m for m in there if seats[m.contact.public].incarnation == m.incarnation]
        return 2 * len(able) > len(posted.council)

    # -- what clients do --------------------------------------------------------------------------------------------

    def _put(self) -> None:
        fields = ("job", self._number, self._number / 2)
        self._number += 1
        putting = self._spaces[self._rng.choice(sorted(self._spaces))].put(fields)
        putting.addCallbacks(lambda _: self._acknowledged.setdefault(fields), _weather)

    def _take(self, place: int, space: TupleSpace) -> None:
        taking = space.get(JOB, timeout=self._rng.choice([0.3, 2.0, 5.0]))
        taking.addCallbacks(lambda fields: self._took([fields], place, space), _weather)

    def _take_some(self, place: int, space: TupleSpace) -> None:
        taking = space.get_many(JOB, self._rng.choice([1, 3]))
        taking.addCallbacks(lambda taken: self._took(taken, place, space), _weather)

    def _claim(self, place: int, space: TupleSpace) -> None:
        claiming = space.claim(JOB, lease=1.5, timeout=3.0)
        claiming.addCallbacks(lambda claim: self._claimed(claim, place, space), _weather)

    def _claimed(self, claim: Claim, place: int, space: TupleSpace) -> None:
        """Confirm it in time, or late, or twice; give it back; or never come back to it, as who dies."""
        fate = self._rng.choice(["confirm", "late", "release", "forget"])
        if fate == "release":
            claim.release()
        elif fate != "forget":
            self._clock.callLater(2.5 if fate == "late" else 0.3, self._confirm, claim, place, space)

    def _confirm(self, claim: Claim, place: int, space: TupleSpace) -> None:
        if self._spaces.get(place) is space:
            claim.confirm().addCallbacks(lambda fields: self._took([fields], place, space), _weather)

    def _took(self, taken: list[Tuple], place: int, space: TupleSpace) -> None:
        for fields in taken:
            self._told[fields].append(f"node {place} at {self._clock.seconds():.1f}")

    def _look(self, place: int, space: TupleSpace) -> None:
        space.read_all(JOB).addErrback(_weather)

    def _again(self, place: int, space: TupleSpace) -> None:
        """Ask members once more what decided a take: whoever accepted it then stands by it for ever."""
        decided = [one for one in self._witness.posted.values() if self._witness.takers(one.place)]
        if not decided:
            return
        posted = self._rng.choice(decided)
        node = self._schedule.node(place)
        for (counter, taker, value), members in sorted(self._witness.bids[posted.place].items()):
            if 2 * len(members) <= len(posted.council):
                continue
            for member in posted.council:
                if member.contact.public in members - {node.identity.public}:
                    places = [posted.place.packed()]
                    question = (posted.place.key, places, member.incarnation, counter, taker, value)
                    asked = node.endpoint.ask(member.contact, "decree.confirm", *question, changes=True)
                    asked.addCallbacks(self._said_again, _weather, (posted, value))

    def _said_again(self, answer: Any, posted: Posted, value: bytes) -> None:
        reply = reply_unpacked(answer[0]) if isinstance(answer, list) and answer else None
        if reply is None or reply.value != value:
            self._say("T4", f"a member does not stand by what it said about {posted.fields}: {reply}")

    # -- the end ----------------------------------------------------------------------------------------------------

    def _listen(self, who: str, space: TupleSpace) -> None:
        self._listening[who] = None
        space.read(BELL).addCallbacks(lambda _: self._listening.__setitem__(who, self._clock.seconds()), _weather)

    def _ring(self) -> None:
        def rung(_: object) -> None:
            self._rung_at = self._clock.seconds()

        place = self._rng.choice(sorted(self._spaces))
        self._spaces[place].put(("bell", 1)).addCallbacks(rung, self._failed, (), {}, ("a put",))

    def _check(self, seen: list[Tuple], place: int) -> None:
        """Hold what everybody reads at the end against what was put and taken."""
        there = set(seen)
        known = {posted.fields: posted for posted in self._witness.posted.values()}
        for fields in self._acknowledged:
            posted = known.get(fields)
            if posted is None or (not self._witness.takers(posted.place) and fields not in there):
                self._say("T2", f"{fields} was acknowledged and not taken; node {place} does not see it")
        for fields in seen:
            if fields in self._told and self._can_decide(known[fields]):
                self._say("T3", f"{fields} was taken by {self._told[fields][0]}; node {place} still sees it")

    def _sweep(self) -> None:
        place = self._rng.choice(sorted(self._spaces))
        space = self._spaces[place]
        taking = space.get_many(JOB, 1000)
        taking.addCallbacks(lambda taken: self._took(taken, place, space), _weather)

    def _failed(self, failure: Failure, what: str) -> None:
        failure.trap(EntangledError)
        self._say("T2", f"{what} fails after everything healed: {failure.value}")

    def _say(self, invariant: str, text: str) -> None:
        line = f"{invariant}: {text}"
        if line not in self._found:
            self._found.append(line)


def _weather(failure: Failure) -> None:
    failure.trap(EntangledError)
