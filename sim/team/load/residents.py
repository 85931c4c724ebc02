"""What workloads share: who of a team lives and has entered it, the truth that lookups are held against, and a pace."""

from __future__ import annotations

import random
from bisect import bisect_left, insort

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.identity import ID_BYTES
from middleware.entangled.node import EntangledNode
from sim.team.team import Node, Team, core
from sim.team.workload import Workload


class Pace:
    """``rate`` a second, from when ``due`` is first asked on; ``most`` in all, 0 without end."""

    def __init__(self, clock: IReactorTime, rate: float, most: int = 0) -> None:
        self._clock = clock
        self._rate = rate
        self._most = most
        self._began: float | None = None
        self._given = 0

    @property
    def is_over(self) -> bool:
        """Whether as many were due as ever will be."""
        return bool(self._most) and self._given >= self._most

    def due(self) -> int:
        """How many became due since this was asked last."""
        now = self._clock.seconds()
        if self._began is None:
            self._began = now
        total = int((now - self._began) * self._rate + 1e-9)
        if self._most:
            total = min(total, self._most)
        due, self._given = total - self._given, total
        return due


BITS = 8 * ID_BYTES


class Census:
    """The ids of those that live, sorted.

    Ids that share their first bits stand side by side in the order of their numbers, so those closest to a key are
    found without looking at everybody: the narrowest such stretch around the key that has enough of them holds them.
    """

    def __init__(self) -> None:
        self._numbers: list[int] = []

    def __len__(self) -> int:
        return len(self._numbers)

    def __contains__(self, node_id: bytes) -> bool:
        return self._place(int.from_bytes(node_id)) is not None

    def born(self, node_id: bytes) -> None:
        """One more lives; nothing happens where it did already."""
        number = int.from_bytes(node_id)
        if self._place(number) is None:
            insort(self._numbers, number)

    def died(self, node_id: bytes) -> None:
        """One lives no more; nothing happens where it did not."""
        place = self._place(int.from_bytes(node_id))
        if place is not None:
            del self._numbers[place]

    def closest(self, key: bytes, count: int, without: bytes = b"") -> list[bytes]:
        """The ids of the ``count`` closest to ``key``, the closest first; ``without`` is passed over."""
        goal = int.from_bytes(key)
        passed = int.from_bytes(without) if without else -1
        first, end = 0, len(self._numbers)
        for bits in range(1, BITS + 1):  # the more first bits are shared, the narrower
            low = goal >> (BITS - bits) << (BITS - bits)
            next_first = bisect_left(self._numbers, low, first, end)
            next_end = bisect_left(self._numbers, low + (1 << (BITS - bits)), next_first, end)
            if next_end - next_first <= count:  # one of them may be passed over
                break
            first, end = next_first, next_end
        near = [number for number in self._numbers[first:end] if number != passed]
        near.sort(key=lambda number: number ^ goal)
        return [number.to_bytes(ID_BYTES) for number in near[:count]]

    def _place(self, number: int) -> int | None:
        place = bisect_left(self._numbers, number)
        return place if place < len(self._numbers) and self._numbers[place] == number else None


class Residents:
    """Kept up to date from before the first node joins; who is still joining is none yet."""

    def __init__(self, team: Team) -> None:
        self._team = team
        self.census = Census()
        self._lives: dict[int, EntangledNode] = {}
        self._order: list[int] = []
        self._place_in_order: dict[int, int] = {}
        team.attend(self._born, self._died)

    def __len__(self) -> int:
        return len(self._order)

    def node(self, place: int) -> EntangledNode:
        """The node of a place in its present life; ``KeyError`` where it does not live or has not entered."""
        return self._lives[place]

    def lives(self, place: int, life: EntangledNode) -> bool:
        """Whether ``life`` goes on: a node that came back to its place is another one."""
        return self._lives.get(place) is life

    def any(self, dice: random.Random, count: int = 1) -> list[int]:
        """``count`` different places, or as many as there are."""
        return dice.sample(self._order, min(count, len(self._order)))

    def places(self) -> list[int]:
        """All of them."""
        return sorted(self._order)

    def _born(self, place: int, node: Node) -> None:
        life = core(node)

        def entered(is_in: bool) -> None:
            if is_in:
                self._lives[place] = life
                self.census.born(life.identity.node_id)
                self._place_in_order[place] = len(self._order)
                self._order.append(place)

        self._team.entered(place).addCallback(entered)

    def _died(self, place: int, node: Node) -> None:
        if not self.lives(place, core(node)):
            return
        del self._lives[place]
        self.census.died(core(node).identity.node_id)
        gap, last = self._place_in_order.pop(place), self._order.pop()
        if last != place:  # the last one takes its place: to close the gap would be to move ten thousand
            self._order[gap] = last
            self._place_in_order[last] = gap


class Load(Workload):
    """A workload of clients at nodes that have entered ``team``, with a random generator named ``name``."""

    def __init__(self, team: Team, name: str) -> None:
        self._team = team
        self._clock = team.clock
        self._rng = team.generator(name)
        self._residents = Residents(team)
