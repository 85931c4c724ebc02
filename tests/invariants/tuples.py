"""The workload of tuples: several clients put, take, claim and read tuples.

It records the results and checks the invariants T1 to T6.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import Any

from twisted.internet.defer import Deferred
from twisted.python.failure import Failure

from middleware.entangled.errors import EntangledError
from middleware.entangled.node import EntangledNode
from middleware.entangled.quorum.acceptor import Event
from middleware.entangled.space.take_codec import unpack_reply
from middleware.entangled.space.taker import Claim
from middleware.entangled.space.template import ANY, Field, Tuple
from middleware.entangled.space.tuple_record import StoredTuple
from middleware.entangled.space.tuplespace import TupleSpace
from sim.team import event
from sim.team.clients import record_outcome
from sim.team.invariant.tuple_space import PUT, RING, SURVEY, TAKE, WAIT
from sim.team.schedule import Schedule
from sim.team.takers.vote_recorder import VoteRecorder
from sim.team.workload import Workload

JOB = ("job", int, ANY)
BELL = ("bell", int)
MOST_WAITING = 6
SWEEP = 3.0
"""The time in seconds after the repair interval at which a client takes all remaining tuples."""
FETCH = 5.0
"""The time in seconds after which a client waits for each tuple that remains.

The rest of the run has time for two rounds of 1.5 s each, in which the council waits for a failed member.  The first
round may be outbid by a bid that a taker made before it failed; the second round knows the counter of that bid.
Sweeps are not enough: a sweep that took a tuple ends after the first round, like ``get_many``, and a sweep from
another node starts at the same tuple.  So a tuple that two sweeps leave is not necessarily stuck."""


class Tuples(Workload):
    """Clients of each node put, take, claim and read jobs.

    Two clients wait for a bell tuple, which is put at the end.
    """

    def __init__(self, schedule: Schedule) -> None:
        self._schedule = schedule
        self._clock = schedule.team.clock
        self._rng = random.Random(f"tuples/{schedule.seed}")
        self._history = schedule.history
        self._witness = VoteRecorder(schedule.history)
        self._spaces: dict[int, TupleSpace] = {}
        self._lives = 0
        self._number = 0
        self._acknowledged: dict[Tuple, None] = {}
        self._waiting: dict[int, int] = {}
        schedule.team.watch_lives(self._born, self._died)

    def step(self) -> None:
        """Perform a few operations at random nodes."""
        if not self._spaces:
            return
        if self._rng.random() < 0.4 and len(self._witness.list_undecided()) < MOST_WAITING:
            self._put()
        if self._rng.random() < 0.6:
            place = self._rng.choice(sorted(self._spaces))
            act = self._rng.choice([self._take, self._take, self._take_some, self._claim, self._look, self._again])
            act(place, self._spaces[place])

    def make_final_requests(self) -> None:
        """Let all nodes read all tuples, put the bell tuple, and take the remaining tuples, at the end one by one."""
        for place, space in sorted(self._spaces.items()):
            self._survey(place, space)
            self._listen(f"node {place}, which waits without faults", space)
        self._clock.callLater(1.0, self._ring)
        self._clock.callLater(SWEEP, self._sweep)
        self._clock.callLater(FETCH, self._fetch)

    def find_violations(self) -> list[str]:
        """Record the members that can still decide."""
        self._seats()
        for space in self._spaces.values():
            space.stop()
        return []

    # -- start and end of nodes -------------------------------------------------------------------------------------

    def _born(self, place: int, node: EntangledNode) -> None:
        self._lives += 1
        node.replica.on_record.add(self._witness.record_tuple)
        rng = random.Random(f"tuples/{self._schedule.seed}/{place}/{self._lives}")
        space = self._spaces[place] = TupleSpace(node, self._clock, rng)
        self._witness.wrap_member(node.take_acceptor, node.endpoint.expose, node.identity.public)
        if place < 2:
            # The call is delayed, because possibly the node has not started yet.
            self._clock.callLater(0.1, self._wait, place, space)

    def _died(self, place: int, node: EntangledNode) -> None:
        self._spaces.pop(place).stop()
        if place in self._waiting:
            self._history.record_failure(self._waiting.pop(place), "it died")

    def _wait(self, place: int, space: TupleSpace) -> None:
        if self._spaces.get(place) is space:
            self._waiting[place] = self._listen(f"node {place}, which waits from the start", space)

    def _left(self) -> list[StoredTuple]:
        """Return the acknowledged tuples that were not taken and must still be available."""
        return [p for p in self._witness.list_undecided() if p.fields in self._acknowledged and self._can_decide(p)]

    def _can_decide(self, stored_tuple: StoredTuple) -> bool:
        """Return whether a majority of the council members is online and has kept its state."""
        acceptors = {
            node.identity.public: node.take_acceptor for node in map(self._schedule.node, self._schedule.alive())
        }
        there = [m for m in stored_tuple.council if m.contact.public in acceptors]
        able = [m for m in there if acceptors[m.contact.public].incarnation == m.incarnation]
        return 2 * len(able) > len(stored_tuple.council)

    # -- operations of clients --------------------------------------------------------------------------------------

    def _put(self) -> None:
        fields = ("job", self._number, self._number / 2)
        self._number += 1
        putting = self._spaces[self._rng.choice(sorted(self._spaces))].put(fields)
        asked = self._history.record_request("somebody", PUT, fields)

        def acknowledged(_: object) -> None:
            self._acknowledged[fields] = None

        record_outcome(self._history, asked, putting.addCallback(acknowledged))

    def _take(self, place: int, space: TupleSpace) -> None:
        self._get(JOB, place, space, timeout=self._rng.choice([0.3, 2.0, 5.0]))

    def _get(self, template: Sequence[Field], place: int, space: TupleSpace, timeout: float | None = None) -> None:
        self._taking(space.get(template, timeout).addCallback(lambda fields: [fields]), place)

    def _take_some(self, place: int, space: TupleSpace) -> None:
        self._taking(space.get_many(JOB, self._rng.choice([1, 3])), place)

    def _taking(self, taking: Deferred[list[Tuple]], place: int) -> None:
        """Record a take of a client."""
        record_outcome(self._history, self._history.record_request(place, TAKE, "job"), taking, tuple)

    def _claim(self, place: int, space: TupleSpace) -> None:
        claiming = space.claim(JOB, lease=1.5, timeout=3.0)
        claiming.addCallbacks(lambda claim: self._claimed(claim, place, space), _weather)

    def _claimed(self, claim: Claim, place: int, space: TupleSpace) -> None:
        """Confirm the claim in time, too late or twice, or release it, or do nothing, like a failed client."""
        fate = self._rng.choice(["confirm", "late", "release", "forget"])
        if fate == "release":
            claim.release()
        elif fate != "forget":
            self._clock.callLater(2.5 if fate == "late" else 0.3, self._confirm, claim, place, space)

    def _confirm(self, claim: Claim, place: int, space: TupleSpace) -> None:
        if self._spaces.get(place) is space:
            self._taking(claim.confirm().addCallback(lambda fields: [fields]), place)

    def _look(self, place: int, space: TupleSpace) -> None:
        space.read_all(JOB).addErrback(_weather)

    def _again(self, place: int, space: TupleSpace) -> None:
        """Ask members again to confirm a decided take: each member that accepted it must repeat its reply."""
        decided = [one for one in self._witness.tuples.values() if self._witness.find_takers(one.tuple_id)]
        if not decided:
            return
        stored_tuple = self._rng.choice(decided)
        node = self._schedule.node(place)
        for (counter, taker, value), members in sorted(self._witness.votes[stored_tuple.tuple_id].items()):
            if 2 * len(members) <= len(stored_tuple.council):
                continue
            for member in stored_tuple.council:
                if member.contact.public in members - {node.identity.public}:
                    places = [stored_tuple.tuple_id.pack()]
                    question = (stored_tuple.tuple_id.key, places, member.incarnation, counter, taker, value)
                    asked = node.endpoint.ask(member.contact, "decree.confirm", *question, changes=True)
                    asked.addCallbacks(self._said_again, _weather, (stored_tuple, value))

    def _said_again(self, answer: Any, stored_tuple: StoredTuple, value: bytes) -> None:
        reply = unpack_reply(answer[0], Event.ACCEPT) if isinstance(answer, list) and answer else None
        self._history.record(
            event.AnswerRepeated, stored_tuple.fields, value, reply.value if reply is not None else None
        )

    # -- the end ----------------------------------------------------------------------------------------------------

    def _listen(self, who: str, space: TupleSpace) -> int:
        asked = self._history.record_request(who, WAIT, who)
        space.read(BELL).addCallbacks(lambda _: self._history.record_answer(asked), _weather)
        return asked

    def _ring(self) -> None:
        place = self._rng.choice(sorted(self._spaces))
        asked = self._history.record_request(place, RING, "bell")
        record_outcome(self._history, asked, self._spaces[place].put(("bell", 1)))

    def _survey(self, place: int, space: TupleSpace) -> None:
        asked = self._history.record_request(place, SURVEY, "job")

        def seen(found: list[Tuple]) -> tuple[Tuple, ...]:
            self._seats()
            return tuple(found)

        record_outcome(self._history, asked, space.read_all(JOB), seen)

    def _seats(self) -> None:
        self._witness.record_members(map(self._schedule.node, self._schedule.alive()))

    def _sweep(self) -> None:
        place = self._rng.choice(sorted(self._spaces))
        self._taking(self._spaces[place].get_many(JOB, 1000), place)

    def _fetch(self) -> None:
        """Wait for each tuple separately, so a tuple that cannot be taken does not block the other tuples."""
        for posted in self._left():
            place = self._rng.choice(sorted(self._spaces))
            self._get(posted.fields, place, self._spaces[place])


def _weather(failure: Failure) -> None:
    failure.trap(EntangledError)
