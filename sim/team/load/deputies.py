"""Deputies: those of all places of a team, for as long as their nodes live."""

from __future__ import annotations

from weakref import WeakKeyDictionary

from sim.team.load.deputy import Deputy
from sim.team.team import Node, Team


class Deputies:
    """Made once a team (``deputies_of``): bare nodes are given the rooms in which bids are carried as they are born."""

    def __init__(self, team: Team) -> None:
        self._clock = team.clock
        self._rng = team.generator
        self._present: dict[int, Deputy] = {}
        self._lives = 0
        team.attend(self._born, self._died)

    def of(self, place: int) -> Deputy | None:
        """The deputy of a place; None where its node does not live."""
        return self._present.get(place)

    def present(self) -> list[Deputy]:
        """Those whose nodes live, by place."""
        return [self._present[place] for place in sorted(self._present)]

    def lives(self, deputy: Deputy) -> bool:
        """Whether its node goes on."""
        return self._present.get(deputy.place) is deputy

    def _born(self, place: int, node: Node) -> None:
        self._lives += 1
        dice = self._rng(f"rooms/{place}/{self._lives}")
        self._present[place] = Deputy(place, node, self._clock, dice)

    def _died(self, place: int, node: Node) -> None:
        deputy = self._present.get(place)
        if deputy is not None and deputy.node is node:
            del self._present[place]
            deputy.stop()


_KNOWN: WeakKeyDictionary[Team, Deputies] = WeakKeyDictionary()


def deputies_of(team: Team) -> Deputies:
    """The deputies of ``team``, the same for all workloads: a node has one place for bids only."""
    known = _KNOWN.get(team)
    if known is None:
        known = _KNOWN[team] = Deputies(team)
    return known
