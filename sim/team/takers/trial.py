"""Run one trial of a tuple space: publishers, takers and faults from a seed, recorded for the checker."""

from __future__ import annotations

from typing import Any

from middleware.entangled.identity import Identity
from middleware.entangled.network.switchboard import LinkConditions
from middleware.entangled.node import EntangledNode
from middleware.entangled.space.taker import Claim
from middleware.entangled.space.template import ANY, Tuple
from middleware.entangled.space.tuple_record import StoredTuple, parse_record
from middleware.entangled.space.tuplespace import TupleSpace
from sim.team.checker import find_violations
from sim.team.clients import record_outcome
from sim.team.event import Settled
from sim.team.invariant.tuple_space import PUT, SURVEY, TAKE
from sim.team.simulation import JOIN_S, TEAM_KEY, Simulation
from sim.team.takers.vote_recorder import VoteRecorder

STEP_S = 0.25
MAX_WAITING = 24
"""Approximate number of tuples waiting to be taken."""
MAX_DOWN = 2
"""Maximum number of dead nodes: less than a majority of any council and of any record's replicas."""


class TakingTrial(Simulation):
    """One run from one ``seed``: publishers, takers that take repeatedly, and faults.

    ``loss`` is the share of lost datagrams; with ``churn`` nodes are killed, one permanently, and links are cut.
    """

    finish_limit_s = 240.0
    """Seconds that the takers get after all faults for the remaining tuples."""

    def __init__(
        self, seed: int, tuples: int, loss: float = 0.0, churn: bool = False, takers: int = 8, nodes: int = 12
    ) -> None:
        super().__init__(seed, LinkConditions(delay_s=0.001, jitter_s=0.0008))
        self.tuples, self.churn, self.takers, self.n = tuples, churn, takers, nodes
        self.trial_rng = self.make_rng("story")
        self.quiet_conditions = self.switchboard.conditions
        self.lossy_conditions = LinkConditions(
            delay_s=0.002, jitter_s=0.0015, loss=loss, duplicate=loss / 5, reorder=loss / 5
        )
        self.recorder = VoteRecorder(self.history)
        self.spaces: dict[int, TupleSpace] = {}
        self.published_count = 0
        self.is_publishing = False
        self.busy: dict[int, TupleSpace] = {}
        self.dead_place: int | None = None
        self.started_count = 0
        for place in range(nodes):
            self.started_count += 1
            self.start(place)
            self.clock.advance(JOIN_S)

    # -- nodes ------------------------------------------------------------------------------------------------------

    def make_node(self, place: int, identity: Identity, rng: Any) -> EntangledNode:
        """Return the next node of this place, not started, with the store of the previous node."""
        network = self.network(place)
        node = EntangledNode(identity, TEAM_KEY, network, self.store(place), self.clock, rng)
        node.replica.on_record.add(self.recorder.record_tuple)
        return node

    def start(self, place: int) -> None:
        """Start the node of this place if it is not running."""
        if place in self.living or place == self.dead_place:
            return
        identity, rng = self.identity(place), self.make_life_rng(place)
        node = self.make_node(place, identity, rng)
        self.spaces[place] = TupleSpace(node, self.clock, rng)
        self.recorder.wrap_member(node.take_acceptor, node.endpoint.expose, identity.public)
        self.begin_life(place, node, identity)
        node.start()
        node.join([self.address(other) for other in range(self.started_count) if other != place][: place or 3])
        if place < self.takers and self.is_publishing:
            self.take(place)

    def kill(self, place: int) -> None:
        """Kill the node of this place between two instructions, as by a loss of power."""
        if place in self.living:
            node, space = self.end_life(place), self.spaces.pop(place)
            self.switchboard.kill(self.address(place))
            node.stop_silently()
            space.stop()

    # -- schedule ---------------------------------------------------------------------------------------------------

    def run_trial(self) -> None:
        """Run the trial, then restart all nodes and let the takers finish."""
        self.switchboard.conditions = self.lossy_conditions
        if self.churn:
            self.clock.callLater(self.trial_rng.uniform(0.2, 1.0), self.inject_fault)
        while self.published_count < self.tuples:
            self.publish()
            self.clock.advance(STEP_S)
        self.churn = False
        self.switchboard.heal()
        for place in range(self.n):
            self.start(place)
        end = self.clock.seconds() + self.finish_limit_s
        while self.clock.seconds() < end and any(map(self.is_stored, self.recorder.list_undecided())):
            self.clock.advance(1.0)
        self.switchboard.conditions = self.quiet_conditions
        self.clock.advance(4.0)
        self.history.record(Settled)
        for place in self.alive():
            self.read_all(place)
        self.clock.advance(2.0)
        self.recorder.record_members(self.living.values())

    def stop(self) -> None:
        """End every node."""
        for place in range(self.n):
            self.kill(place)

    def publish(self) -> None:
        """Put the next few tuples, unless too many are waiting."""
        if not self.is_publishing:
            self.is_publishing = True
            for place in range(self.takers):
                self.take(place)
        waiting = len(self.recorder.list_undecided())
        for _ in range(min(12, max(1, MAX_WAITING - waiting), self.tuples - self.published_count)):
            fields = ("job", self.published_count, self.published_count / 2)
            self.published_count += 1
            place = self.trial_rng.choice(self.alive())
            asked = self.history.record_request(place, PUT, fields)
            record_outcome(self.history, asked, self.spaces[place].put(fields))
        if self.trial_rng.random() < 0.1:
            self.read_all(self.trial_rng.choice(self.alive()))

    def read_all(self, place: int) -> None:
        """Read all tuples; in a quiet network the result must not contain tuples that were taken earlier."""
        is_quiet = self.switchboard.conditions is self.quiet_conditions or not (
            self.lossy_conditions.loss or self.churn
        )
        asked = self.history.record_request(place, SURVEY if is_quiet else "look", "job")

        def seen(tuples: list[Tuple]) -> tuple[Tuple, ...]:
            self.recorder.record_members(self.living.values())
            return tuple(tuples)

        record_outcome(self.history, asked, self.spaces[place].read_all(("job", int, float)), seen)

    def take(self, place: int) -> None:
        """Start the next operation of this place's taker, of a random kind."""
        space = self.spaces.get(place)
        if space is None or self.busy.get(place) is space:
            return
        self.busy[place] = space
        asked = self.history.record_request(place, TAKE, "job")
        way = self.trial_rng.random()
        if way < 0.75:
            space.get(("job", int, ANY), timeout=self.trial_rng.choice([None, 0.3])).addBoth(
                self.on_taken, place, space, asked
            )
        elif way < 0.85:
            space.get_many(("job", ANY, float), 5).addBoth(self.on_taken, place, space, asked)
        else:
            space.claim(("job", int, ANY), lease=1.0, timeout=5.0).addBoth(self.on_claimed, place, space, asked)

    def on_claimed(self, claim: object, place: int, space: TupleSpace, asked: int) -> None:
        """Process a claim: usually confirm the claim, sometimes too late, sometimes never."""
        fate, work = self.trial_rng.random(), self.trial_rng.uniform(0.0, 0.3)
        if not isinstance(claim, Claim) or fate < 0.1:
            self.on_taken(None, place, space, asked)
        elif fate < 0.2:
            claim.release()
            self.on_taken(None, place, space, asked)
        else:
            late = 1.2 if fate < 0.3 else 0.0
            self.clock.callLater(work + late, lambda: claim.confirm().addBoth(self.on_taken, place, space, asked))

    def on_taken(self, result: Any, place: int, space: TupleSpace, asked: int) -> None:
        """Record the result of a call, and start the next one."""
        if self.spaces.get(place) is not space:
            return  # calls of a dead node have no result
        taken = result if isinstance(result, list) else [result] if isinstance(result, tuple) else []
        self.history.record_answer(asked, tuple(taken))
        del self.busy[place]
        self.clock.callLater(self.trial_rng.uniform(0.0, 0.05), self.take, place)

    def inject_fault(self) -> None:
        """Kill a node for some time or, once, permanently; or partition the network."""
        if not self.churn:
            return
        self.clock.callLater(self.trial_rng.uniform(0.2, 2.0), self.inject_fault)
        if self.trial_rng.random() < 0.25:
            cut = self.trial_rng.sample(range(self.n), self.trial_rng.randrange(1, self.n // 2))
            self.switchboard.partition([self.address(place) for place in cut])
            self.clock.callLater(self.trial_rng.uniform(0.2, 3.0), self.switchboard.heal)
            return
        if self.n - len(self.living) < MAX_DOWN:
            place = self.trial_rng.randrange(self.n)
            self.kill(place)
            if self.dead_place is None and self.trial_rng.random() < 0.2:
                self.dead_place = place
            self.clock.callLater(self.trial_rng.uniform(0.1, 4.0), self.start, place)

    # -- results ----------------------------------------------------------------------------------------------------

    def is_stored(self, stored_tuple: StoredTuple) -> bool:
        """Return whether a living node stores this tuple; an unacknowledged tuple may be lost with its nodes."""
        held = [node.store.get_slot(stored_tuple.tuple_id.slot) for node in self.living.values()]
        return any(record is not None and parse_record(record) == stored_tuple for record in held)

    def find_violations(self) -> list[str]:
        """Return all violations; must be called while the nodes live."""
        left = [stored_tuple for stored_tuple in self.recorder.list_undecided() if self.is_stored(stored_tuple)]
        return find_violations(self.history) + [
            f"T5: {stored_tuple.fields} exists and was not taken" for stored_tuple in left
        ]
