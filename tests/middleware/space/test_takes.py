"""Tests of many takers at the same time: nothing is confirmed twice and nothing is lost, whatever dies."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from benchmarks.takers import Trial
from benchmarks.village import VillageTrial
from middleware.entangled.node import EntangledNode
from middleware.entangled.quorum.acceptor import Acceptor, Stand
from middleware.entangled.quorum.ballot import Ballot
from middleware.entangled.quorum.proposer import Outcome
from middleware.entangled.quorum.register import Reply
from middleware.entangled.space.council import Council
from middleware.entangled.space.keeper import Keeper
from middleware.entangled.space.posting import Place, Posted
from middleware.entangled.space.seat import TERMS, Answers, Seat
from middleware.entangled.space.tuplespace import TupleSpace

TUPLES = 100


class TakesTests(SynchronousTestCase):
    def _checked(self, trial: Trial) -> Trial:
        trial.run()
        trial.stop()
        self.assertEqual(trial.violations(), [], f"seed {trial.seed}, loss {trial.storm.loss}")
        return trial

    def test_calm(self) -> None:
        """Eight takers share two hundred tuples, and each tuple is told to exactly one of them."""
        trial = self._checked(VillageTrial(1, 200))
        self.assertEqual(len(trial.told), 200)

    def test_loss(self) -> None:
        """With up to half of the datagrams lost, each tuple is still confirmed exactly once."""
        for seed, loss in [(2, 0.1), (3, 0.3), (4, 0.5)]:
            self._checked(VillageTrial(seed, TUPLES, loss))

    def test_churn_and_partitions(self) -> None:
        """Publishers, members and takers die in the middle and come back, links are cut: once each, and none lost."""
        for seed in range(10, 14):
            self._checked(VillageTrial(seed, TUPLES, (seed % 6) / 10, True))

    def test_whole_nodes(self) -> None:
        """So it is with records that are replicated by whole nodes, some of which die, over a wire that loses some."""
        self._checked(Trial(1, 15, 0.1, True, nodes=10))

    def test_replay(self) -> None:
        """The same seed makes the same run, to the last datagram."""
        digests = []
        for _ in range(2):
            trial = VillageTrial(5, 40, 0.2, True)
            trial.run()
            trial.stop()
            digests.append(trial.board.digest())
        self.assertEqual(digests[0], digests[1])

    def test_members_that_lost_their_memory_keep_silent(self) -> None:
        """A member that comes back without its votes has no say about older tuples, so none is confirmed twice."""
        for seed in range(30, 33):
            trial = ForgottenLife(seed, TUPLES, 0.1, True)
            trial.aftermath = 20.0
            trial.run()
            trial.stop()
            self.assertEqual(trial.witness.split() + trial.twice(), [], f"seed {seed}")


class ForgottenLife(VillageTrial):
    def start(self, place: int) -> None:
        if self.nodes[place] is None:
            self.stores[place].note("decree/incarnation", b"")
        super().start(place)


# -- faults on purpose ------------------------------------------------------------------------------------------------


class FaultTests(SynchronousTestCase):
    """Each of these faults is noticed: the checks above can fail."""

    def _noticed(self, fault: type[VillageTrial], word: str, seeds: Sequence[int] = range(30, 36)) -> None:
        """Some of ``seeds`` shows a violation with ``word`` in it."""
        for seed in seeds:
            trial = fault(seed, TUPLES, 0.2, True)
            trial.aftermath = 20.0
            trial.run()
            trial.stop()
            if any(word in text for text in trial.violations()):
                return
        self.fail("the fault went unnoticed")

    def test_no_ballots(self) -> None:
        """A member that agrees to whoever asks lets two take one tuple."""
        self._noticed(NoBallots, "accepted for two")

    def test_confirm_at_minority(self) -> None:
        """A taker that is content with one member's word takes what others get as well."""
        self._noticed(MinorityConfirm, "was told to")

    def test_forgotten_votes(self) -> None:
        """A member that forgets its votes now and then and speaks on lets two take one tuple."""
        self._noticed(ForgottenVotes, "accepted for two")

    def test_taken_not_written(self) -> None:
        """A taker that notes nothing leaves the tuple to be read by others after it was taken."""
        self._noticed(NoNotes, "was read after")

    def test_lease_without_end(self) -> None:
        """A claim that never ends takes the tuple to the grave of its taker."""
        self._noticed(EndlessLease, "was never taken")

    def test_slot_used_too_early(self) -> None:
        """A publisher that does not wait until a tuple is gone writes over it."""
        self._noticed(OneSlot, "was never taken")


class AgreeableAcceptor(Acceptor[Place]):
    def _stand(self, *_: Any) -> Stand:
        return Stand.FREE


class EndlessAcceptor(Acceptor[Place]):
    def prepare(
        self, key: Place, configuration: int, ballot: Ballot, ttl: float, now: float, reserve: float = 0.0
    ) -> Reply:
        return super().prepare(key, configuration, ballot, ttl, now, 600.0)


class FaultySeat(Seat):
    kind: type[Acceptor[Place]]

    def _load(self) -> Acceptor[Place]:
        return self.kind(super()._load().log, TERMS)


class NoBallots(VillageTrial):
    kind: type[Acceptor[Place]] = AgreeableAcceptor

    def furnish(self, node: EntangledNode, space: TupleSpace, rng: random.Random) -> None:
        node.seat = FaultySeat(node.endpoint, node.store, self.clock, rng)
        node.seat.kind = self.kind


class EndlessLease(NoBallots):
    kind = EndlessAcceptor


class HastyCouncil(Council):
    async def confirm(self, posted: Sequence[Posted], ballot: Ballot, value: bytes) -> list[Outcome]:
        return await super().confirm([replace(one, council=one.council[:1]) for one in posted], ballot, value)


class MinorityConfirm(VillageTrial):
    def furnish(self, node: EntangledNode, space: TupleSpace, rng: random.Random) -> None:
        space._taker._council = HastyCouncil(space._taker._ask, self.clock, rng, space._chores)


class ForgetfulSeat(Seat):
    def answer_claim(self, *question: Any) -> Answers:
        if len(self) > 2:
            self._votes.log.registers.clear()
            self._votes.log._buckets.clear()
        return super().answer_claim(*question)


class ForgottenVotes(VillageTrial):
    def furnish(self, node: EntangledNode, space: TupleSpace, rng: random.Random) -> None:
        node.seat = ForgetfulSeat(node.endpoint, node.store, self.clock, rng)


class SilentKeeper(Keeper):
    async def note(self, place: Place, taker: bytes) -> None:
        pass


class OneSlotKeeper(Keeper):
    def _slot(self, key: bytes) -> str:
        super()._slot(key)
        return "only"


class NoNotes(VillageTrial):
    kind: type[Keeper] = SilentKeeper

    def furnish(self, node: EntangledNode, space: TupleSpace, rng: random.Random) -> None:
        space._keeper = space._taker._keeper = self.kind(node, rng, space._chores)


class OneSlot(NoNotes):
    kind = OneSlotKeeper
