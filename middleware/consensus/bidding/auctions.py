"""Dissemination: a node's parties in auctions, on its endpoint: what is sent, asked again, believed and refused.

Every bid is checked against its agent's signature and every announcement against that of a member of the pinned
council, before a party hears of it.  What a peer may do with that stands in ``docs/explanation/choosing-a-robot.md``.
"""

from __future__ import annotations

import math
import random
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IDelayedCall, IReactorTime
from twisted.logger import Logger

from middleware.consensus.bidding.announcement import announcement_of
from middleware.consensus.bidding.auction import MAX_WAITING, Auction, auction_of
from middleware.consensus.bidding.bid import Bid, bid_of, is_cost
from middleware.consensus.bidding.errand import MAX_BIDS, Cry, Errand, Notice, Offer
from middleware.consensus.bidding.party import OnSummary, Party
from middleware.consensus.bidding.rule import Rule
from middleware.consensus.bidding.scale import Scale
from middleware.consensus.strategy import ConsensusAlgorithm, Report
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError, NotRunning, Refused
from middleware.entangled.identity import Identity
from middleware.entangled.wire.door import ROLE, meaning
from middleware.errors import UnknownStrategy

ERRAND_S = 0.4
"""Seconds for an errand: three tries on a path of 100 ms.  More of them finds slow peers, less goes round dead ones."""
OFFER, ANNOUNCE, CRY = "bid.offer", "bid.announce", "bid.cry"
FALLBACK = "nearest"


class Bidding:
    """One agent's place in ``auction``; ``on_summary`` is told of the reports that the council announces."""

    def __init__(self, auction: Auction, on_summary: OnSummary, dissemination: Dissemination) -> None:
        self.auction = auction
        self.on_summary = on_summary
        self._dissemination = dissemination
        self._last: Report | None = None
        self._has_bid = False

    @property
    def is_standing(self) -> bool:
        """Whether there is a bid that was not taken back."""
        return self._last is not None

    def report(self, report: Report) -> None:
        """Bid, or bid anew; an equal bid is not sent again.  Raises ``ValueError`` for a cost that is none."""
        if not self._has_bid or report != self._last:
            self._next(report)

    def withdraw(self) -> None:
        """Take the bid back; before the first one: abstain, so that nobody waits for this agent."""
        if not self._has_bid or self._last is not None:
            self._next(None)

    def expect(self, bidders: float) -> None:
        """Where this node is of the council: close the bidding as soon as that many have bid or abstained.

        Infinity: when the waiting period is over.
        """
        self._dissemination.expect(self.auction, bidders)

    def leave(self) -> None:
        """Hear no more of it; the node goes on carrying the bids of others."""
        self._dissemination.leave(self)

    def _next(self, report: Report | None) -> None:
        self._dissemination.publish(self.auction, report)
        self._has_bid, self._last = True, report


class Wire(Protocol):
    """What is needed of an endpoint."""

    def ask(
        self, contact: Contact, method: str, *arguments: object, timeout: float | None = None, changes: bool = False
    ) -> Deferred[Any]:
        """Ask a peer, and try again until it answers or the time is over."""

    def tell(self, contact: Contact, method: str, *arguments: object) -> None:
        """Call a peer's method once, without answer."""


@dataclass(frozen=True)
class Surroundings:
    """What a node knows of the others: itself, whom it knows, how many they are, and the strategies by name.

    ``may_bid`` says whether the member of a public key may take part in what has a key, by its role.
    """

    me: Callable[[], Contact]
    contacts: Callable[[], Iterable[Contact]]
    team_size: Callable[[], int]
    strategy_for: Callable[[str], ConsensusAlgorithm]
    may_bid: Callable[[bytes, bytes], bool] = lambda key, public: True


MAX_PARTIES = 256
LIFE_S = 300.0
"""Seconds after which a party in which nothing happens is forgotten, unless it is this node's own."""
OWN = b""


@dataclass
class _Held:
    party: Party
    opener: bytes
    touched_at: float


class Parties:
    """Parties by the digest of their auction; those that this node entered itself are never driven out."""

    def __init__(self) -> None:
        self._held: dict[bytes, _Held] = {}

    def __len__(self) -> int:
        return len(self._held)

    def __iter__(self) -> Iterator[Party]:
        return iter([held.party for held in self._held.values()])

    def get(self, digest: bytes) -> Party | None:
        """The party in the auction with this digest."""
        held = self._held.get(digest)
        return held.party if held is not None else None

    def touch(self, digest: bytes, now: float) -> None:
        """Take note that something happened in a party."""
        held = self._held.get(digest)
        if held is not None:
            held.touched_at = now

    def add(self, party: Party, opener: bytes, now: float) -> list[Party]:
        """Keep ``party``, which ``opener`` (a node id, or ``OWN``) asked for; those that had to go for it."""
        idle = [d for d, held in self._held.items() if held.opener != OWN and held.touched_at < now - LIFE_S]
        gone = [self._held.pop(digest).party for digest in idle]
        while len(self._held) >= MAX_PARTIES:
            counts = Counter(held.opener for held in self._held.values() if held.opener != OWN)
            if not counts:
                break
            busiest = counts.most_common(1)[0][0]
            digest = next(digest for digest, held in self._held.items() if held.opener == busiest)
            gone.append(self._held.pop(digest).party)
        self._held[party.auction.digest] = _Held(party, opener, now)
        return gone

    def own(self, digest: bytes, is_own: bool, opener: bytes = b"left") -> None:
        """Let a party be this node's own, or no longer."""
        held = self._held.get(digest)
        if held is not None:
            held.opener = OWN if is_own else opener


class Dissemination:
    """The auctions of one node."""

    _log = Logger()

    def __init__(
        self, identity: Identity, wire: Wire, around: Surroundings, clock: IReactorTime, rng: random.Random
    ) -> None:
        self._identity = identity
        self._wire = wire
        self._around = around
        self._clock = clock
        self._rng = rng
        self._scale = Scale()
        self._parties = Parties()
        self._timers: dict[bytes, IDelayedCall] = {}
        self._pumping: set[bytes] = set()
        self._biddings: dict[bytes, list[Bidding]] = {}
        self._is_stopped = False

    def enter(self, auction: Auction, on_summary: OnSummary) -> Bidding:
        """Take part in ``auction``; ``on_summary`` is told what is announced, at once where something was."""
        party = self._party(auction, OWN)
        bidding = Bidding(auction, on_summary, self)
        self._biddings.setdefault(auction.digest, []).append(bidding)
        self._parties.own(auction.digest, True)
        if party.told:
            on_summary(party.told)
        return bidding

    def stop(self) -> None:
        """Cancel every timer; nothing is sent any more."""
        self._is_stopped = True
        for timer in self._timers.values():
            if timer.active():
                timer.cancel()
        self._timers.clear()

    # -- what peers ask ---------------------------------------------------------------------------------------------

    def answer_offer(
        self, peer: Contact, auction: list[object], bids: list[object], age_ms: int, is_shared: bool
    ) -> list[object] | None:
        """Take a peer's bids; the announcement, where there is one.  Raises ``Refused`` where they cannot come here."""
        about = _auction(auction)
        if not 0 <= age_ms <= 1000 * MAX_WAITING:
            raise Refused("an offer is at most ten minutes old, in milliseconds")
        given = self._genuine(about, bids)
        # Who says that it tells the whole council itself can say so of its own bid only.
        is_own = all(bid.public == peer.public for bid in given)
        party = self._party(about, peer.node_id)
        if not party.has_room(peer):
            raise Refused("as many as may send their bids here do so; any other contact nearer to the key will do")
        now = self._clock.seconds()
        announcement = party.offered(given, peer, age_ms / 1000, is_shared and is_own, now)
        self._pump(party)
        return announcement.packed() if announcement is not None else None

    def answer_announcement(self, peer: Contact, auction: list[object], announcement: list[object]) -> None:
        """Take what a member of the council announces, whoever brings it."""
        about = _auction(auction)
        party = self._parties.get(about.digest)
        if party is not None:  # who takes no part need not know
            self._heard(party, announcement)
            self._pump(party)

    def take_cry(self, peer: Contact, auction: list[object], bids: list[object]) -> None:
        """Take bids that a neighbour cries while no council is in reach."""
        about = _auction(auction)
        if about.exclusive:
            raise Refused("the bids for an exclusive task go to its council alone")
        given = self._genuine(about, bids)
        party = self._party(about, peer.node_id)
        party.cried(given, peer, self._clock.seconds())
        self._pump(party)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _party(self, auction: Auction, opener: bytes) -> Party:
        known = self._parties.get(auction.digest)
        if known is not None:
            return known
        try:
            strategy = self._around.strategy_for(auction.strategy)
        except UnknownStrategy:
            strategy = self._around.strategy_for(FALLBACK)
        rule = Rule(strategy, self._blame)
        party = Party(
            auction,
            self._around.me(),
            rule,
            self._around.contacts,
            self._rng,
            self._identity.sign,
            lambda reports: self._tell(auction.digest, reports),
        )
        for gone in self._parties.add(party, opener, self._clock.seconds()):
            self._disarm(gone.auction.digest)
        return party

    def _genuine(self, auction: Auction, content: list[object]) -> list[Bid]:
        """The bids in a message, all of them signed by their agents; raises ``Refused``."""
        if len(content) > MAX_BIDS:
            raise Refused(f"a message has at most {MAX_BIDS} bids")
        party = self._parties.get(auction.digest)
        bids = []
        for each in content:
            bid = bid_of(each)
            if bid is None:
                raise Refused("a bid has a key, a finite cost that is not negative, a revision and a signature")
            if not self._around.may_bid(auction.key, bid.public):
                continue  # whoever carries it may carry others, too
            known = party.summary.of(bid.agent) if party is not None else None
            if known is not None and known.rank == bid.rank:
                bids.append(known)  # a copy of what was checked; its signature may be another
            elif bid.is_genuine(auction):
                bids.append(bid)
            else:
                raise Refused("a bid that its agent did not sign for this auction")
        if content and not bids:
            raise Refused(f"no bid that counts: {meaning(ROLE)}", ROLE)
        return bids

    def _heard(self, party: Party, content: object) -> None:
        """Believe an announcement that a member of the council signed; raises ``Refused``."""
        announcement = announcement_of(content)
        if announcement is None:
            raise Refused("an announcement has a number, a place in the council, reports and a signature")
        if party.announcement is not None and announcement.precedence <= party.announcement.precedence:
            return
        if not announcement.is_genuine(party.auction):
            raise Refused("an announcement that no member of the task's council signed")
        party.announced(announcement, self._clock.seconds())
        if party.is_outlived and party.own is not None:
            self._bid(party, party.own.report)

    def publish(self, auction: Auction, report: Report | None) -> None:
        """Make this node's bid in ``auction``, or take it back.  Raises ``ValueError`` for a cost that is none."""
        if report is not None:
            if not is_cost(report.cost):
                raise ValueError(f"{report.cost!r} is no cost: it must be finite and not negative")
            if report.agent != self._identity.node_id.hex():
                raise ValueError("a node bids for its own agent only")
        party = self._party(auction, OWN)
        self._bid(party, report)
        self._pump(party)

    def _bid(self, party: Party, report: Report | None) -> None:
        bid = Bid(self._identity.public, report, party.next_revision).signed(self._identity, party.auction)
        party.bid(bid, self._scale.counted(self._around.team_size()), self._clock.seconds())

    def expect(self, auction: Auction, bidders: float) -> None:
        """Close the bidding as soon as that many have bid or abstained."""
        party = self._party(auction, OWN)
        party.expect(bidders)
        self._pump(party)

    def leave(self, bidding: Bidding) -> None:
        """Tell ``bidding`` nothing any more."""
        digest = bidding.auction.digest
        here = [each for each in self._biddings.pop(digest, []) if each is not bidding]
        if here:
            self._biddings[digest] = here
        else:
            self._parties.own(digest, False)

    def _tell(self, digest: bytes, reports: tuple[Report, ...]) -> None:
        for bidding in list(self._biddings.get(digest, ())):
            try:
                bidding.on_summary(reports)
            except Exception:  # somebody else's code
                self._log.failure("while telling what was announced for {task}", task=bidding.auction.task_id)

    def _blame(self, method: str, error: Exception) -> None:
        self._log.error("a strategy's {method} raised {error!r}; the nearest are taken", method=method, error=error)

    def _pump(self, party: Party) -> None:
        """Send what is to be sent, and look again when it is due."""
        digest = party.auction.digest
        if self._is_stopped or digest in self._pumping or self._parties.get(digest) is not party:
            return
        self._pumping.add(digest)
        self._parties.touch(digest, self._clock.seconds())
        try:
            while errands := party.errands(self._clock.seconds()):
                for errand in errands:
                    self._send(party, errand)
        finally:
            self._pumping.discard(digest)
        self._arm(party)

    def _arm(self, party: Party) -> None:
        self._disarm(party.auction.digest)
        if party.due != math.inf and not self._is_stopped:
            wait = max(0.0, party.due - self._clock.seconds())
            self._timers[party.auction.digest] = self._clock.callLater(wait, self._pump, party)

    def _disarm(self, digest: bytes) -> None:
        timer = self._timers.pop(digest, None)
        if timer is not None and timer.active():
            timer.cancel()

    def _send(self, party: Party, errand: Errand) -> None:
        head = party.auction.packed()
        if isinstance(errand, Cry):
            try:
                self._wire.tell(errand.to, CRY, head, [bid.packed() for bid in errand.bids])
            except EntangledError as error:
                self._log.debug("a cry was not sent: {error}", error=error)
            return
        if isinstance(errand, Notice):
            arguments: tuple[object, ...] = (ANNOUNCE, head, errand.announcement.packed())
        else:
            bids = [bid.packed() for bid in errand.bids]
            arguments = (OFFER, head, bids, _milliseconds(errand.age), errand.is_shared)
        method, *others = arguments
        asked = self._wire.ask(errand.to, str(method), *others, timeout=ERRAND_S, changes=True)
        asked.addCallbacks(self._answered, self._failed, callbackArgs=(party, errand), errbackArgs=(party, errand))
        asked.addErrback(lambda failure: self._log.failure("while carrying bids", failure))

    def _answered(self, answer: object, party: Party, errand: Errand) -> None:
        if isinstance(errand, Offer) and answer is not None:
            try:
                self._heard(party, answer)
            except Refused as error:
                self._log.info("{peer} returned {error}", peer=errand.to.address, error=error)
        party.answered(errand, self._clock.seconds())
        self._pump(party)

    def _failed(self, failure: Any, party: Party, errand: Errand) -> None:
        if failure.check(EntangledError) is None:
            self._log.failure("while carrying bids", failure)
        if failure.check(NotRunning) is None:
            party.failed(errand, self._clock.seconds())
            self._pump(party)


def _auction(content: list[object]) -> Auction:
    auction = auction_of(content)
    if auction is None:
        raise Refused("an auction has a task, an epoch, one to nine council members, a strategy and a waiting period")
    return auction


def _milliseconds(age: float) -> int:
    return min(int(1000 * MAX_WAITING), max(0, round(1000 * age)))
