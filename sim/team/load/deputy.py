"""Deputy: what bids for the agent of one place and claims in its name, whichever kind its node is.

A swarm node has these rooms; beside a bare node of the library they are the same ones, wired in the same way.  So an
auction among ten thousand can be measured with what surrounds it in a team, or without.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import cached_property, partial
from typing import Any

from twisted.internet.interfaces import IReactorTime

from middleware.consensus.bidding.auction import Auction
from middleware.consensus.bidding.auctions import Bidding, Dissemination, Surroundings
from middleware.consensus.bidding.party import OnSummary
from middleware.consensus.bidding.scale import team_size
from middleware.consensus.lease.lessee import Lessee
from middleware.consensus.strategy import strategy_for
from middleware.entangled.contact import Contact
from middleware.entangled.node import EntangledNode
from middleware.node import LEASE_VERBS, SwarmNode
from middleware.tasks.councils import Councils
from middleware.tasks.task import Task
from sim.team.load.tally import Tally
from sim.team.team import Node, core


class Rooms:
    """The rooms beside a bare node that let it bid, carry bids, and sit in councils."""

    def __init__(self, node: EntangledNode, tally: Tally, clock: IReactorTime, rng: random.Random) -> None:
        self._node = node
        self._tally = tally
        self._clock = clock
        self._rng = rng
        self._born_at = clock.seconds()
        self._ends: list[Callable[[], None]] = []
        for verb in LEASE_VERBS:
            answer = partial(self._answer_lease, f"lease.{verb}")
            node.endpoint.expose(f"lease.{verb}", answer, changes=True, idempotent=True)

    @cached_property
    def councils(self) -> Councils:
        """The councils of tasks, as ``SwarmNode.councils``; nobody writes down where one moves to."""
        seen = self._node.store, self._clock, self._rng, self._born_at
        return Councils(self._node, *seen, moved=lambda task: None, may_sit=lambda public: True)

    @cached_property
    def dissemination(self) -> Dissemination:
        """How bids travel through the node, as ``SwarmNode.dissemination``."""
        node = self._node

        def size() -> int:
            return team_size(node.identity.node_id, node.overlay.contacts(), node.overlay.is_large)

        around = Surroundings(lambda: node.contact, node.overlay.contacts, size, strategy_for)
        dissemination = Dissemination(node.identity, self._tally, around, self._clock, self._rng)
        self._ends.append(dissemination.stop)
        return dissemination

    def stop(self) -> None:
        """The node is gone."""
        for end in self._ends:
            end()

    def _answer_lease(self, method: str, peer: Contact, *arguments: Any) -> object:
        return self.councils.desk.answer(method, peer, arguments)


class Deputy:
    """One place's agent, as far as bidding and claiming goes, for one life of its ``node``; ``tally`` counts."""

    def __init__(self, place: int, node: Node, clock: IReactorTime, rng: random.Random) -> None:
        self.place = place
        self.node = node
        bare = core(node)
        self.uuid = bare.identity.node_id.hex()
        self.tally = Tally(bare.endpoint)
        self._rooms: Rooms | SwarmNode = node if isinstance(node, SwarmNode) else Rooms(node, self.tally, clock, rng)
        # As a swarm node exposes them, and counted; each of them may run again, so each that comes is answered.
        expose = bare.endpoint.expose
        expose("bid.offer", self._answer_offer, changes=True, idempotent=True)
        expose("bid.announce", self._answer_announcement, changes=True, idempotent=True)
        expose("bid.cry", self._take_cry, changes=True)

    def bidding(self, auction: Auction, on_summary: OnSummary) -> Bidding:
        """Take part in ``auction``."""
        return self._dissemination.enter(auction, on_summary)

    def lessee(self, task: Task, changed: Callable[[], None]) -> Lessee:
        """The claimant of the right to act on ``task``."""
        return self._rooms.councils.lessee(task, changed, 0)

    async def pinned(self, task: Task) -> Task:
        """A new ``task`` with its council."""
        return await self._rooms.councils.pinned(task)

    def stop(self) -> None:
        """Its node is gone; a swarm node has stopped its rooms itself."""
        if isinstance(self._rooms, Rooms):
            self._rooms.stop()

    @cached_property
    def _dissemination(self) -> Dissemination:
        dissemination = self._rooms.dissemination
        dissemination._wire = self.tally
        return dissemination

    def _answer_offer(
        self, peer: Contact, auction: list[object], bids: list[object], age_ms: int, is_shared: bool
    ) -> list[object] | None:
        self.tally.asked()
        return self._dissemination.answer_offer(peer, auction, bids, age_ms, is_shared)

    def _answer_announcement(self, peer: Contact, auction: list[object], announcement: list[object]) -> None:
        self.tally.asked()
        self._dissemination.answer_announcement(peer, auction, announcement)

    def _take_cry(self, peer: Contact, auction: list[object], bids: list[object]) -> None:
        self.tally.asked(is_answered=False)
        self._dissemination.take_cry(peer, auction, bids)
