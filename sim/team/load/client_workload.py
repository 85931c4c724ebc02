"""Shared parts of workloads: the joined nodes of a team, a sorted list of node ids, and a pacer for operations."""

from __future__ import annotations

import random
from bisect import bisect_left, insort

from twisted.internet.interfaces import IReactorTime

from middleware.entangled.identity import ID_BYTES
from middleware.entangled.node import EntangledNode
from sim.team.team import Node, Team, get_entangled
from sim.team.workload import Workload


class Pacer:
    """Paces operations: ``rate`` per second after the first ``take_due``, at most ``most`` in total (0: unlimited)."""

    def __init__(self, clock: IReactorTime, rate: float, most: int = 0) -> None:
        self._clock = clock
        self._rate = rate
        self._max_total = most
        self._began: float | None = None
        self._taken = 0

    @property
    def is_over(self) -> bool:
        """Whether the total number of operations has been reached."""
        return bool(self._max_total) and self._taken >= self._max_total

    def take_due(self) -> int:
        """Return the number of operations that became due since the last call."""
        now = self._clock.seconds()
        if self._began is None:
            self._began = now
        total = int((now - self._began) * self._rate + 1e-9)
        if self._max_total:
            total = min(total, self._max_total)
        due, self._taken = total - self._taken, total
        return due


BITS = 8 * ID_BYTES


class NodeIdIndex:
    """The sorted ids of the living nodes.

    Ids with a common prefix are adjacent in numerical order, so the ids closest to a key are found without a full
    scan: they are in the range of the longest prefix of the key that enough ids share.
    """

    def __init__(self) -> None:
        self._numbers: list[int] = []

    def __len__(self) -> int:
        return len(self._numbers)

    def __contains__(self, node_id: bytes) -> bool:
        return self._find(int.from_bytes(node_id)) is not None

    def add(self, node_id: bytes) -> None:
        """Add an id if it is not in the index."""
        number = int.from_bytes(node_id)
        if self._find(number) is None:
            insort(self._numbers, number)

    def remove(self, node_id: bytes) -> None:
        """Remove an id if it is in the index."""
        place = self._find(int.from_bytes(node_id))
        if place is not None:
            del self._numbers[place]

    def find_closest(self, key: bytes, count: int, without: bytes = b"") -> list[bytes]:
        """Return the ``count`` ids closest to ``key``, closest first, without the id ``without``."""
        goal = int.from_bytes(key)
        passed = int.from_bytes(without) if without else -1
        first, end = 0, len(self._numbers)
        for bits in range(1, BITS + 1):  # a longer common prefix is a narrower range
            low = goal >> (BITS - bits) << (BITS - bits)
            next_first = bisect_left(self._numbers, low, first, end)
            next_end = bisect_left(self._numbers, low + (1 << (BITS - bits)), next_first, end)
            if next_end - next_first <= count:  # because ``without`` may be one of these ids
                break
            first, end = next_first, next_end
        near = [number for number in self._numbers[first:end] if number != passed]
        near.sort(key=lambda number: number ^ goal)
        return [number.to_bytes(ID_BYTES) for number in near[:count]]

    def _find(self, number: int) -> int | None:
        place = bisect_left(self._numbers, number)
        return place if place < len(self._numbers) and self._numbers[place] == number else None


class JoinedNodes:
    """The joined nodes of a team; has to be created before the first node joins."""

    def __init__(self, team: Team) -> None:
        self._team = team
        self.id_index = NodeIdIndex()
        self._nodes: dict[int, EntangledNode] = {}
        self._order: list[int] = []
        self._place_in_order: dict[int, int] = {}
        team.watch_lives(self._on_birth, self._on_death)

    def __len__(self) -> int:
        return len(self._order)

    def node(self, place: int) -> EntangledNode:
        """Return the joined node of a place; raise ``KeyError`` if no node has joined there."""
        return self._nodes[place]

    def is_alive(self, place: int, life: EntangledNode) -> bool:
        """Return whether the node ``life`` at a place is still alive; a restarted node is a different object."""
        return self._nodes.get(place) is life

    def any(self, rng: random.Random, count: int = 1) -> list[int]:
        """Return ``count`` different random places, or all places if there are fewer."""
        return rng.sample(self._order, min(count, len(self._order)))

    def list_places(self) -> list[int]:
        """Return all places."""
        return sorted(self._order)

    def _on_birth(self, place: int, node: Node) -> None:
        life = get_entangled(node)

        def entered(is_in: bool) -> None:
            if is_in:
                self._nodes[place] = life
                self.id_index.add(life.identity.node_id)
                self._place_in_order[place] = len(self._order)
                self._order.append(place)

        self._team.when_joined(place).addCallback(entered)

    def _on_death(self, place: int, node: Node) -> None:
        if not self.is_alive(place, get_entangled(node)):
            return
        del self._nodes[place]
        self.id_index.remove(get_entangled(node).identity.node_id)
        gap, last = self._place_in_order.pop(place), self._order.pop()
        if last != place:  # the last place fills the gap; a shift would move up to ten thousand entries
            self._order[gap] = last
            self._place_in_order[last] = gap


class ClientWorkload(Workload):
    """A workload of clients at joined nodes of ``team``, with a random generator named ``name``."""

    def __init__(self, team: Team, name: str) -> None:
        self._team = team
        self._clock = team.clock
        self._rng = team.make_rng(name)
        self._joined = JoinedNodes(team)
