"""Residents: those of a team that live and have entered it, and which life of whom it is."""

from __future__ import annotations

import random

from middleware.entangled.node import EntangledNode
from sim.team.load.census import Census
from sim.team.team import Node, Team, core


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
