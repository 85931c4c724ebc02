"""Run one trial of a tuple space: publishers, takers and faults from a seed, recorded for the checker."""

from __future__ import annotations

from typing import Any

from middleware.entangled.identity import Identity
from middleware.entangled.network.switchboard import Weather
from middleware.entangled.node import EntangledNode
from middleware.entangled.space.posting import Posted, posting
from middleware.entangled.space.taker import Claim
from middleware.entangled.space.template import ANY, Tuple
from middleware.entangled.space.tuplespace import TupleSpace
from sim.team.checker import check
from sim.team.clients import follow
from sim.team.event import Settled
from sim.team.invariant.taking import PUT, SURVEY, TAKE
from sim.team.takers.witness import Witness
from sim.team.world import JOINING, TEAM, World

STEP = 0.25
WAITING = 24
"""Approximate number of tuples waiting to be taken."""
MAX_DOWN = 2
"""Maximum number of dead nodes: less than a majority of any council and of the holders of any record."""


class Trial(World):
    """One run from one ``seed``: publishers, takers that take repeatedly, and faults.

    ``loss`` is the share of lost datagrams; with ``churn`` nodes are killed, one permanently, and links are cut.
    """

    aftermath = 240.0
    """Seconds that the takers get after all faults for the remaining tuples."""

    def __init__(
        self, seed: int, tuples: int, loss: float = 0.0, churn: bool = False, takers: int = 8, nodes: int = 12
    ) -> None:
        super().__init__(seed, Weather(delay_s=0.001, jitter_s=0.0008))
        self.tuples, self.churn, self.takers, self.n = tuples, churn, takers, nodes
        self.dice = self.generator("story")
        self.calm = self.board.weather
        self.storm = Weather(delay_s=0.002, jitter_s=0.0015, loss=loss, duplicate=loss / 5, reorder=loss / 5)
        self.witness = Witness(self.history)
        self.spaces: dict[int, TupleSpace] = {}
        self.number = 0
        self.is_open = False
        self.busy: dict[int, TupleSpace] = {}
        self.grave: int | None = None
        self.come = 0
        for place in range(nodes):
            self.come += 1
            self.start(place)
            self.clock.advance(JOINING)

    # -- nodes ------------------------------------------------------------------------------------------------------

    def node(self, place: int, identity: Identity, rng: Any) -> EntangledNode:
        """Return the next life of the node at this place, with the store of the last one, not started."""
        network = self.network(place)
        node = EntangledNode(identity, TEAM, network, self.store(place), self.clock, rng)
        node.replica.on_record.add(self.witness.stored)
        return node

    def start(self, place: int) -> None:
        """Start the node of this place, if it does not live."""
        if place in self.living or place == self.grave:
            return
        identity, rng = self.identity(place), self.rng(place)
        node = self.node(place, identity, rng)
        self.spaces[place] = TupleSpace(node, self.clock, rng)
        self.witness.attend(node.seat, node.endpoint.expose, identity.public)
        self.begin_life(place, node, identity)
        node.start()
        node.join([self.address(other) for other in range(self.come) if other != place][: place or 3])
        if place < self.takers and self.is_open:
            self.take(place)

    def kill(self, place: int) -> None:
        """Kill the node of this place between two instructions, like a loss of power."""
        if place in self.living:
            node, space = self.end_life(place), self.spaces.pop(place)
            self.board.kill(self.address(place))
            node.vanish()
            space.stop()

    # -- schedule ---------------------------------------------------------------------------------------------------

    def play(self) -> None:
        """Run the trial, then restart all nodes and let the takers finish."""
        self.board.weather = self.storm
        if self.churn:
            self.clock.callLater(self.dice.uniform(0.2, 1.0), self.befall)
        while self.number < self.tuples:
            self.publish()
            self.clock.advance(STEP)
        self.churn = False
        self.board.heal()
        for place in range(self.n):
            self.start(place)
        end = self.clock.seconds() + self.aftermath
        while self.clock.seconds() < end and any(map(self.stands, self.witness.open())):
            self.clock.advance(1.0)
        self.board.weather = self.calm
        self.clock.advance(4.0)
        self.history.note(Settled)
        for place in self.alive():
            self.look(place)
        self.clock.advance(2.0)
        self.witness.seated(self.living.values())

    def stop(self) -> None:
        """End every node."""
        for place in range(self.n):
            self.kill(place)

    def publish(self) -> None:
        """Put the next few tuples, unless too many are waiting."""
        if not self.is_open:
            self.is_open = True
            for place in range(self.takers):
                self.take(place)
        waiting = len(self.witness.open())
        for _ in range(min(12, max(1, WAITING - waiting), self.tuples - self.number)):
            fields = ("job", self.number, self.number / 2)
            self.number += 1
            place = self.dice.choice(self.alive())
            asked = self.history.asked(place, PUT, fields)
            follow(self.history, asked, self.spaces[place].put(fields))
        if self.dice.random() < 0.1:
            self.look(self.dice.choice(self.alive()))

    def look(self, place: int) -> None:
        """Read all tuples; in a quiet network the result must not contain tuples taken before."""
        is_quiet = self.board.weather is self.calm or not (self.storm.loss or self.churn)
        asked = self.history.asked(place, SURVEY if is_quiet else "look", "job")

        def seen(tuples: list[Tuple]) -> tuple[Tuple, ...]:
            self.witness.seated(self.living.values())
            return tuple(tuples)

        follow(self.history, asked, self.spaces[place].read_all(("job", int, float)), seen)

    def take(self, place: int) -> None:
        """Start the next operation of this place's taker, of a random kind."""
        space = self.spaces.get(place)
        if space is None or self.busy.get(place) is space:
            return
        self.busy[place] = space
        asked = self.history.asked(place, TAKE, "job")
        way = self.dice.random()
        if way < 0.75:
            space.get(("job", int, ANY), timeout=self.dice.choice([None, 0.3])).addBoth(self.took, place, space, asked)
        elif way < 0.85:
            space.get_many(("job", ANY, float), 5).addBoth(self.took, place, space, asked)
        else:
            space.claim(("job", int, ANY), lease=1.0, timeout=5.0).addBoth(self.claimed, place, space, asked)

    def claimed(self, claim: object, place: int, space: TupleSpace, asked: int) -> None:
        """Work on a claim: mostly confirm it, sometimes too late, sometimes never."""
        fate, work = self.dice.random(), self.dice.uniform(0.0, 0.3)
        if not isinstance(claim, Claim) or fate < 0.1:
            self.took(None, place, space, asked)
        elif fate < 0.2:
            claim.release()
            self.took(None, place, space, asked)
        else:
            late = 1.2 if fate < 0.3 else 0.0
            self.clock.callLater(work + late, lambda: claim.confirm().addBoth(self.took, place, space, asked))

    def took(self, result: Any, place: int, space: TupleSpace, asked: int) -> None:
        """Record the result of a call, and start the next one."""
        if self.spaces.get(place) is not space:
            return  # calls of a dead node have no result
        taken = result if isinstance(result, list) else [result] if isinstance(result, tuple) else []
        self.history.answered(asked, tuple(taken))
        del self.busy[place]
        self.clock.callLater(self.dice.uniform(0.0, 0.05), self.take, place)

    def befall(self) -> None:
        """Kill a node for some time or, once, permanently; or partition the network."""
        if not self.churn:
            return
        self.clock.callLater(self.dice.uniform(0.2, 2.0), self.befall)
        if self.dice.random() < 0.25:
            cut = self.dice.sample(range(self.n), self.dice.randrange(1, self.n // 2))
            self.board.partition([self.address(place) for place in cut])
            self.clock.callLater(self.dice.uniform(0.2, 3.0), self.board.heal)
            return
        if self.n - len(self.living) < MAX_DOWN:
            place = self.dice.randrange(self.n)
            self.kill(place)
            if self.grave is None and self.dice.random() < 0.2:
                self.grave = place
            self.clock.callLater(self.dice.uniform(0.1, 4.0), self.start, place)

    # -- results ----------------------------------------------------------------------------------------------------

    def stands(self, posted: Posted) -> bool:
        """Return whether a living node holds this tuple; an unacknowledged one may vanish with its nodes."""
        held = [node.store.slot(posted.place.slot) for node in self.living.values()]
        return any(record is not None and posting(record) == posted for record in held)

    def violations(self) -> list[str]:
        """Return all violations; must be called while the nodes live."""
        left = [posted for posted in self.witness.open() if self.stands(posted)]
        return check(self.history) + [f"T5: {posted.fields} exists and was not taken" for posted in left]
