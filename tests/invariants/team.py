"""Team: places with machines, acceptors and agents on a simulated link, for schedules and trials of leases."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from typing import Any

from twisted.internet.defer import Deferred

from middleware.commitment.charter import Charter, Judge, pin
from middleware.commitment.council import Council
from middleware.entangled.clock import HeapClock
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.identity import Identity
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.network.network import Address
from sim.team.event import Born, Died
from tests.invariants.bidder import TICK, Bidder
from tests.invariants.machine import Machine
from tests.invariants.radio import Radio
from tests.invariants.referee import Referee


class Team:
    """Places whose clocks run at ``rates``; the first ``agents`` of them have agents.  ``seed`` names its dice.

    ``stop_time`` is how long a robot takes to come to rest, ``drift`` the largest error of a clock.
    """

    def __init__(
        self,
        seed: str,
        rates: Sequence[float],
        agents: int,
        ttl: float,
        stop_time: float = 0.0,
        drift: float = 0.01,
        has_stores: bool = True,
        tick: float = TICK,
    ) -> None:
        self.ttl = ttl
        self.stop_time = stop_time
        self.drift = drift
        self.tick = tick
        self.n = len(rates)
        self.agents = list(range(agents))
        self.has_stores = has_stores
        self.clock = HeapClock()
        self.radio = Radio(self.clock, random.Random(f"{seed}/radio"))
        self.referee = Referee(self)
        self.referee.agree()
        keys = random.Random(f"{seed}/keys")
        self.identities = [Identity(keys.randbytes(32)) for _ in range(self.n)]
        self.operator = Identity(keys.randbytes(32))
        self.judge = Judge(lambda public, task_id: public == self.operator.public)
        places = enumerate(self.identities)
        self.contacts = [Contact(one.public, Address("10.0.0.1", 7000 + n)) for n, one in places]
        self.councils: dict[str, Charter] = {}
        self._seed = seed
        self._rates = rates
        self._places = {contact.public: n for n, contact in enumerate(self.contacts)}
        self._stores = [MemoryStore() for _ in range(self.n)]
        self._lives = 0
        self.bidders = [self.born(place) for place in range(self.n)]

    def add_task(self, task_id: str, council: Sequence[int]) -> None:
        """One more task, with its council pinned."""
        members = tuple(self.contacts[place] for place in council)
        self.councils[task_id] = pin(self.operator, task_id, members)
        self.referee.add(task_id)

    # -- what bidders need ------------------------------------------------------------------------------------------

    def place_of(self, contact: Contact) -> int:
        """Where a contact is."""
        return self._places[contact.public]

    def council_for(self, place: int, task_id: str) -> Charter:
        """The council as the records of the task prove it."""
        return self.councils[task_id]

    def moved(self, task_id: str, council: Council) -> None:
        """Let the record name a newer council."""
        if council.charter is not None and council.configuration > self.councils[task_id].configuration:
            self.councils[task_id] = council.charter
            self.referee.look_at_cuts()

    def ask(
        self, me: Bidder, to: int, method: str, arguments: tuple[Any, ...], answered: Callable[[object], object]
    ) -> None:
        """Carry a question and its answer."""

        def arrive() -> None:
            peer = self.bidders[to]

            def reply(answer: object) -> None:
                if answer is not None:
                    self.radio.send(to, me.place, me.machine.take, answered, answer)

            def run() -> None:
                answer = peer.answer(me.place, method, arguments)
                if isinstance(answer, Deferred):
                    answer.addCallback(reply)
                else:
                    reply(answer)

            peer.machine.take(run)

        self.radio.send(me.place, to, arrive)

    def tell(self, source: int, contact: Contact, method: str, arguments: tuple[Any, ...]) -> None:
        """Carry what nobody answers."""
        to = self.place_of(contact)

        def arrive() -> None:
            self.bidders[to].machine.take(self.bidders[to].answer, source, method, arguments)

        self.radio.send(source, to, arrive)

    # -- lives ------------------------------------------------------------------------------------------------------

    def is_up(self, place: int) -> bool:
        """Whether a machine runs."""
        return self.bidders[place].machine.is_alive and not self.bidders[place].machine.is_still

    def kill(self, place: int) -> None:
        """End a machine as a loss of power does; what it has in a store stays."""
        self.bidders[place].machine.die()
        if not self.has_stores:
            self._stores[place] = MemoryStore()
        self.referee.history.note(Died, place, not self.has_stores)

    def born(self, place: int) -> Bidder:
        """The next life at a place."""
        self._lives += 1
        self.referee.history.note(Born, place, self._lives)
        rng = random.Random(f"{self._seed}/{place}/{self._lives}")
        machine = Machine(self.clock, self._rates[place], rng.uniform(0.0, 1e4))
        return Bidder(self, place, machine, self._stores[place], rng)
