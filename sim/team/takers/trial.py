"""One simulated trial of a tuple space: publishers, takers and faults from a seed, and what must not come of them."""

from __future__ import annotations

import random
from collections import defaultdict
from typing import Any

from middleware.entangled.errors import EntangledError
from middleware.entangled.identity import Identity
from middleware.entangled.network.switchboard import Weather
from middleware.entangled.node import EntangledNode
from middleware.entangled.space.posting import Posted, posting
from middleware.entangled.space.taker import Claim
from middleware.entangled.space.template import ANY, Tuple
from middleware.entangled.space.tuplespace import TupleSpace
from sim.team.takers.witness import Witness
from sim.team.world import JOINING, TEAM, World

STEP = 0.25
WAITING = 24
"""Tuples that wait to be taken, about."""
MAX_DOWN = 2
"""Nodes that are dead at the same moment: fewer than a majority of any council and of the holders of any record."""


class Trial(World):
    """One run: publishers, takers that go on and on, and whatever befalls them, from one ``seed``.

    ``loss`` is the share of datagrams that the wire loses, ``churn`` whether nodes are killed, one of them for good,
    and links cut.  ``furnish`` may be overridden to give nodes faults
    on purpose.
    """

    aftermath = 240.0
    """Seconds that the takers get, once all faults are over, for what is left."""

    def __init__(
        self, seed: int, tuples: int, loss: float = 0.0, churn: bool = False, takers: int = 8, nodes: int = 12
    ) -> None:
        super().__init__(seed, Weather(delay_s=0.001, jitter_s=0.0008))
        self.tuples, self.churn, self.takers = tuples, churn, takers
        self.dice = random.Random(f"{seed}/story")
        self.calm = self.board.weather
        self.storm = Weather(delay_s=0.002, jitter_s=0.0015, loss=loss, duplicate=loss / 5, reorder=loss / 5)
        self.witness = Witness()
        self.nodes: list[EntangledNode | None] = []
        self.spaces: list[TupleSpace | None] = []
        self.number = 0
        self.is_open = False
        self.acknowledged: dict[Tuple, None] = {}
        self.told: dict[Tuple, list[int]] = defaultdict(list)
        self.told_at: dict[Tuple, float] = {}
        self.ghosts: list[Tuple] = []
        self.busy: dict[int, TupleSpace] = {}
        self.grave: int | None = None
        for place in range(nodes):
            self.nodes.append(None)
            self.spaces.append(None)
            self.start(place)
            self.clock.advance(JOINING)

    # -- the world --------------------------------------------------------------------------------------------------

    def made(self, place: int) -> tuple[EntangledNode, TupleSpace]:
        """The next life of the node of this place, on the store of the last one, not started."""
        identity, rng = self.identity(place), self.rng(place)
        node = self.node(place, identity, rng)
        space = TupleSpace(node, self.clock, rng)
        self.furnish(node, space, rng)
        self.witness.attend(node.seat, node.endpoint.expose, identity.public)
        return node, space

    def node(self, place: int, identity: Identity, rng: random.Random) -> EntangledNode:
        """A whole node."""
        network = self.network(place)
        node = EntangledNode(identity, TEAM, network, self.store(place), self.clock, rng)
        node.replica.on_record.add(self.witness.stored)
        return node

    def furnish(self, node: EntangledNode, space: TupleSpace, rng: random.Random) -> None:
        """Leave all as it is; who wants faults on purpose puts them in here."""

    def start(self, place: int) -> None:
        """Let the node of this place live, if it does not."""
        if self.nodes[place] is None and place != self.grave:
            node, space = self.made(place)
            self.nodes[place], self.spaces[place] = node, space
            node.start()
            node.join([self.address(other) for other in range(len(self.nodes)) if other != place][: place or 3])
            if place < self.takers and self.is_open:
                self.take(place)

    def kill(self, place: int) -> None:
        """End the node of this place between two instructions, as a loss of power does."""
        node, space = self.nodes[place], self.spaces[place]
        if node is not None and space is not None:
            self.nodes[place] = self.spaces[place] = None
            self.board.kill(self.address(place))
            node.vanish()
            space.stop()

    def living(self) -> list[TupleSpace]:
        """The spaces of the nodes that live."""
        return [space for space in self.spaces if space is not None]

    # -- the story --------------------------------------------------------------------------------------------------

    def play(self) -> None:
        """Let it all happen, then let everybody come back and finish."""
        self.board.weather = self.storm
        if self.churn:
            self.clock.callLater(self.dice.uniform(0.2, 1.0), self.befall)
        while self.number < self.tuples:
            self.publish()
            self.clock.advance(STEP)
        self.churn = False
        self.board.heal()
        for place in range(len(self.nodes)):
            self.start(place)
        end = self.clock.seconds() + self.aftermath
        while self.clock.seconds() < end and any(map(self.stands, self.witness.open())):
            self.clock.advance(1.0)
        self.board.weather = self.calm
        self.clock.advance(4.0)
        for space in self.living():
            self.look(space)
        self.clock.advance(2.0)

    def stop(self) -> None:
        """End every node."""
        for place in range(len(self.nodes)):
            self.kill(place)

    def publish(self) -> None:
        """Put the next few tuples, while not too many wait."""
        if not self.is_open:
            self.is_open = True
            for place in range(self.takers):
                self.take(place)
        waiting = len(self.witness.open())
        for _ in range(min(12, max(1, WAITING - waiting), self.tuples - self.number)):
            fields = ("job", self.number, self.number / 2)
            self.number += 1
            putting = self.dice.choice(self.living()).put(fields)
            putting.addCallbacks(lambda _, put=fields: self.acknowledged.setdefault(put), _ignored)
        if self.dice.random() < 0.1:
            self.look(self.dice.choice(self.living()))

    def look(self, space: TupleSpace) -> None:
        """Read all tuples; whatever was taken before must not be among them."""
        before = self.clock.seconds()
        quiet = self.board.weather is self.calm or not (self.storm.loss or self.churn)

        def seen(tuples: list[Tuple]) -> None:
            if quiet:
                self.ghosts += [fields for fields in tuples if self.told_at.get(fields, before) < before]

        space.read_all(("job", int, float)).addCallbacks(seen, _ignored)

    def take(self, place: int) -> None:
        """Let the taker of this place take once more, in one way or another."""
        space = self.spaces[place]
        if space is None or self.busy.get(place) is space:
            return
        self.busy[place] = space
        way = self.dice.random()
        if way < 0.75:
            space.get(("job", int, ANY), timeout=self.dice.choice([None, 0.3])).addBoth(self.took, place, space)
        elif way < 0.85:
            space.get_many(("job", ANY, float), 5).addBoth(self.took, place, space)
        else:
            space.claim(("job", int, ANY), lease=1.0, timeout=5.0).addBoth(self.claimed, place, space)

    def claimed(self, claim: object, place: int, space: TupleSpace) -> None:
        """Work on a claim: mostly confirm it, sometimes too late, sometimes never."""
        fate, work = self.dice.random(), self.dice.uniform(0.0, 0.3)
        if not isinstance(claim, Claim) or fate < 0.1:
            self.took(None, place, space)
        elif fate < 0.2:
            claim.release()
            self.took(None, place, space)
        else:
            late = 1.2 if fate < 0.3 else 0.0
            self.clock.callLater(work + late, lambda: claim.confirm().addBoth(self.took, place, space))

    def took(self, result: Any, place: int, space: TupleSpace) -> None:
        """Write down what a call was told, and go on."""
        if self.spaces[place] is not space:
            return  # a dead node tells nobody
        for fields in result if isinstance(result, list) else [result] if isinstance(result, tuple) else []:
            self.told[fields].append(place)
            self.told_at.setdefault(fields, self.clock.seconds())
        del self.busy[place]
        self.clock.callLater(self.dice.uniform(0.0, 0.05), self.take, place)

    def befall(self) -> None:
        """Kill a node for a while or, once, for good; or cut the network in two."""
        if not self.churn:
            return
        self.clock.callLater(self.dice.uniform(0.2, 2.0), self.befall)
        if self.dice.random() < 0.25:
            cut = self.dice.sample(range(len(self.nodes)), self.dice.randrange(1, len(self.nodes) // 2))
            self.board.partition([self.address(place) for place in cut])
            self.clock.callLater(self.dice.uniform(0.2, 3.0), self.board.heal)
            return
        down = [place for place, node in enumerate(self.nodes) if node is None]
        if len(down) < MAX_DOWN:
            place = self.dice.randrange(len(self.nodes))
            self.kill(place)
            if self.grave is None and self.dice.random() < 0.2:
                self.grave = place
            self.clock.callLater(self.dice.uniform(0.1, 4.0), self.start, place)

    # -- what came of it --------------------------------------------------------------------------------------------

    def twice(self) -> list[str]:
        """Tuples of which two calls were told that they took them."""
        return [f"{fields} was told to {places}" for fields, places in self.told.items() if len(places) > 1]

    def lost(self) -> list[str]:
        """Tuples that were acknowledged and went to nobody, and such as can be read and were not taken all the same."""
        gone = {posted.fields for place, posted in self.witness.posted.items() if self.witness.takers(place)}
        lost = [f"{fields} was never taken" for fields in self.acknowledged if fields not in gone]
        left = [posted for posted in self.witness.open() if self.stands(posted)]
        return lost + [f"{posted.fields} stands and was not taken" for posted in left]

    def stands(self, posted: Posted) -> bool:
        """Whether a living node still keeps this tuple; one that was never acknowledged may vanish with its nodes."""
        held = [node.store.slot(posted.place.slot) for node in self.nodes if node is not None]
        return any(record is not None and posting(record) == posted for record in held)

    def seen_again(self) -> list[str]:
        """Tuples that somebody read after a call had been told that it took them."""
        return [f"{fields} was read after it had been taken" for fields in self.ghosts]

    def violations(self) -> list[str]:
        """Everything that must not be."""
        return self.witness.split() + self.twice() + self.lost() + self.seen_again()


def _ignored(failure: Any) -> None:
    failure.trap(EntangledError)
