"""Many takers at once: is any tuple confirmed twice, is any lost, whatever dies?  In simulated time, from a seed.

``python -m benchmarks.takers --tuples 10000 --takers 8 --loss 0.0-0.5`` runs whole nodes over a switchboard that loses
datagrams, while nodes are killed and come back and links are cut; prints a table and ends with 1 on a violation.
``Trial`` is one such run; the tests use it as well.
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

from twisted.internet.defer import maybeDeferred

from middleware.entangled.clock import HeapClock
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.errors import EntangledError
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.network.network import Address
from middleware.entangled.network.switchboard import Switchboard, Weather
from middleware.entangled.node import EntangledNode
from middleware.entangled.quorum.acceptor import Event
from middleware.entangled.quorum.ballot import NONE
from middleware.entangled.quorum.register import Kind, Reply
from middleware.entangled.record import Record
from middleware.entangled.space.claim import Claim
from middleware.entangled.space.posting import Place, Posted, place_unpacked, posting
from middleware.entangled.space.seat import Seat
from middleware.entangled.space.take_codec import unpack_reply
from middleware.entangled.space.template import ANY, Tuple
from middleware.entangled.space.tuplespace import TupleSpace

TEAM = b"t" * 32
JOINING = 0.3
STEP = 0.25
WAITING = 24
"""Tuples that wait to be taken, about."""
MAX_DOWN = 2
"""Nodes that are dead at the same moment: fewer than a majority of any council and of the holders of any record."""


class Witness:
    """Writes down every acceptance of every council member, in all of its lives."""

    def __init__(self) -> None:
        self.posted: dict[Place, Posted] = {}
        self.bids: dict[Place, dict[tuple[int, bytes, bytes], set[bytes]]] = defaultdict(lambda: defaultdict(set))

    def stored(self, record: Record) -> None:
        """Take note of a tuple that some replica holds now."""
        said = posting(record)
        if isinstance(said, Posted):
            self.posted[said.place] = said

    def attend(self, seat: Seat, expose: Callable[..., object], member: bytes) -> None:
        """Look over the shoulder of the council member ``member`` as it confirms takes, and tells what it accepted."""
        confirm: Callable[..., Any] = seat.answer_confirm
        claim: Callable[..., Any] = seat.answer_claim

        def told(event: Event, key: bytes, places: list[object], answers: list[object]) -> list[tuple[Place, Reply]]:
            pairs = [(place_unpacked(key, p), unpack_reply(a, event)) for p, a in zip(places, answers, strict=True)]
            return [(place, reply) for place, reply in pairs if place is not None and reply is not None]

        def confirmed(peer: Contact, key: bytes, places: list[object], incarnation: bytes, *ballot: Any) -> Any:
            def noted(answers: list[object]) -> list[object]:
                for place, reply in told(Event.ACCEPT, key, places, answers):
                    if reply.kind is Kind.GRANTED:
                        self.accepted(place, ballot, member)
                return answers

            return maybeDeferred(confirm, peer, key, places, incarnation, *ballot).addCallback(noted)

        def claimed(peer: Contact, key: bytes, places: list[object], *rest: Any) -> Any:
            def noted(answers: list[object]) -> list[object]:
                # One whose disk was full when it accepted could not say so, and tells it with the next it can write.
                for place, reply in told(Event.PREPARE, key, places, answers):
                    if reply.accepted != NONE:
                        self.accepted(place, (*reply.accepted, reply.value), member)
                return answers

            return maybeDeferred(claim, peer, key, places, *rest).addCallback(noted)

        seat.answer_confirm, seat.answer_claim = confirmed, claimed  # type: ignore[method-assign, assignment]
        expose("decree.confirm", confirmed, changes=True)
        expose("decree.claim", claimed, changes=True)

    def accepted(self, place: Place, ballot: tuple[int, bytes, bytes], member: bytes) -> None:
        """Take note of what a member of the council accepted."""
        self.bids[place][ballot].add(member)

    def takers(self, place: Place) -> set[bytes]:
        """Everybody for whom a majority of the council ever accepted a take; more than one is a violation."""
        quorum = len(self.posted[place].council) // 2 + 1
        return {value for (_, _, value), members in self.bids[place].items() if len(members) >= quorum}

    def open(self) -> list[Posted]:
        """The tuples that no majority has given to anybody."""
        return [posted for place, posted in self.posted.items() if not self.takers(place)]

    def split(self) -> list[str]:
        """Tuples that two majorities gave to different takers, at any two moments."""
        return [f"{p.fields} was accepted for two" for place, p in self.posted.items() if len(self.takers(place)) > 1]


class Trial:
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
        self.seed, self.tuples, self.churn, self.takers = seed, tuples, churn, takers
        self.clock = HeapClock()
        self.rng = random.Random(f"{seed}/story")
        self.calm = Weather(delay_s=0.001, jitter_s=0.0008)
        self.storm = Weather(delay_s=0.002, jitter_s=0.0015, loss=loss, duplicate=loss / 5, reorder=loss / 5)
        self.board = Switchboard(self.clock, random.Random(f"{seed}/board"), self.calm)
        self.witness = Witness()
        self.stores = [MemoryStore() for _ in range(nodes)]
        self.nodes: list[EntangledNode | None] = []
        self.spaces: list[TupleSpace | None] = []
        self.lives = 0
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

    def address(self, place: int) -> Address:
        """Where the node of this place listens."""
        return Address("10.0.0.1", 7000 + place)

    def made(self, place: int) -> tuple[EntangledNode, TupleSpace]:
        """The next life of the node of this place, on the store of the last one, not started."""
        self.lives += 1
        identity = Identity(random.Random(f"{self.seed}/{place}").randbytes(32))
        rng = random.Random(f"{self.seed}/{place}/{self.lives}")
        node = self.node(place, identity, rng)
        space = TupleSpace(node, self.clock, rng)
        self.furnish(node, space, rng)
        self.witness.attend(node.seat, node.endpoint.expose, identity.public)
        return node, space

    def node(self, place: int, identity: Identity, rng: random.Random) -> EntangledNode:
        """A whole node."""
        network = self.board.network(*self.address(place))
        node = EntangledNode(identity, TEAM, network, self.stores[place], self.clock, rng)
        inner = node.replica.on_record

        def on_record(record: Record) -> None:
            self.witness.stored(record)
            inner(record)

        node.replica.on_record = on_record
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

    def run(self) -> None:
        """Let it all happen, then let everybody come back and finish."""
        self.board.weather = self.storm
        if self.churn:
            self.clock.callLater(self.rng.uniform(0.2, 1.0), self.befall)
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
            putting = self.rng.choice(self.living()).put(fields)
            putting.addCallbacks(lambda _, put=fields: self.acknowledged.setdefault(put), _ignored)
        if self.rng.random() < 0.1:
            self.look(self.rng.choice(self.living()))

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
        way = self.rng.random()
        if way < 0.75:
            space.get(("job", int, ANY), timeout=self.rng.choice([None, 0.3])).addBoth(self.took, place, space)
        elif way < 0.85:
            space.get_many(("job", ANY, float), 5).addBoth(self.took, place, space)
        else:
            space.claim(("job", int, ANY), lease=1.0, timeout=5.0).addBoth(self.claimed, place, space)

    def claimed(self, claim: object, place: int, space: TupleSpace) -> None:
        """Work on a claim: mostly confirm it, sometimes too late, sometimes never."""
        fate, work = self.rng.random(), self.rng.uniform(0.0, 0.3)
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
        self.clock.callLater(self.rng.uniform(0.0, 0.05), self.take, place)

    def befall(self) -> None:
        """Kill a node for a while or, once, for good; or cut the network in two."""
        if not self.churn:
            return
        self.clock.callLater(self.rng.uniform(0.2, 2.0), self.befall)
        if self.rng.random() < 0.25:
            cut = self.rng.sample(range(len(self.nodes)), self.rng.randrange(1, len(self.nodes) // 2))
            self.board.partition([self.address(place) for place in cut])
            self.clock.callLater(self.rng.uniform(0.2, 3.0), self.board.heal)
            return
        down = [place for place, node in enumerate(self.nodes) if node is None]
        if len(down) < MAX_DOWN:
            place = self.rng.randrange(len(self.nodes))
            self.kill(place)
            if self.grave is None and self.rng.random() < 0.2:
                self.grave = place
            self.clock.callLater(self.rng.uniform(0.1, 4.0), self.start, place)

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


def main(arguments: list[str] | None = None) -> int:
    """Run trials and print what came of them."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.takers", description=__doc__.partition("\n")[0])
    parser.add_argument("--tuples", type=int, default=1000, help="tuples over all trials")
    parser.add_argument("--takers", type=int, default=8, help="takers of each trial")
    parser.add_argument("--nodes", type=int, default=12, help="nodes of each trial")
    parser.add_argument("--loss", default="0.0-0.5", help="share of datagrams lost, or the range it goes through")
    parser.add_argument("--trials", type=int, default=6, help="trials, from the least loss to the greatest")
    parser.add_argument("--seed", type=int, default=1, help="seed of the first trial")
    parser.add_argument("--village", action="store_true", help="replicate no records: the councils alone, much faster")
    parser.add_argument("--calm", action="store_true", help="kill nobody and cut nothing")
    wanted = parser.parse_args(arguments)
    kind: type[Trial] = Trial
    if wanted.village:
        from benchmarks.village import VillageTrial  # it is built on this module

        kind = VillageTrial
    low, _, high = wanted.loss.partition("-")
    least, most = float(low), float(high or low)
    print("seed  loss  churn  tuples  confirmed  twice  lost  seen again  simulated s  datagrams/tuple  real s")
    wrong: list[str] = []
    for number in range(wanted.trials):
        loss = least + (most - least) * number / max(1, wanted.trials - 1)
        began = time.monotonic()
        tuples = wanted.tuples * (number + 1) // wanted.trials - wanted.tuples * number // wanted.trials
        trial = kind(wanted.seed + number, tuples, loss, not wanted.calm, wanted.takers, wanted.nodes)
        sent = trial.board.counters["sent"]
        trial.run()
        trial.stop()
        confirmed = len(trial.witness.posted) - len(trial.witness.open())
        print(
            f"{trial.seed:4d}  {loss:4.2f}  {'no' if wanted.calm else 'yes':>5}  {tuples:6d}  {confirmed:9d}"
            f"  {len(trial.witness.split()) + len(trial.twice()):5d}  {len(trial.lost()):4d}"
            f"  {len(trial.seen_again()):10d}"
            f"  {trial.clock.seconds():11.0f}  {(trial.board.counters['sent'] - sent) / max(1, tuples):15.0f}"
            f"  {time.monotonic() - began:6.0f}",
            flush=True,
        )
        wrong += [f"seed {trial.seed}, loss {loss:.2f}: {text}" for text in trial.violations()]
    for text in wrong[:20]:
        print(text)
    return 1 if wrong else 0


if __name__ == "__main__":
    from benchmarks import takers  # so that what the village is built on is not there twice

    sys.exit(takers.main())
