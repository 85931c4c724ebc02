"""The auctions of one node: send, retry and check messages at the node's endpoint.

Bids with an invalid signature of their agent, and announcements without a valid signature of a quorum member, are
rejected here.  ``docs/explanation/choosing-a-robot.md`` describes the remaining influence of a malicious peer.
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

from middleware.consensus.bidding.announcement import parse_announcement
from middleware.consensus.bidding.auction import MAX_COUNCIL, MAX_WAITING_S, Auction, parse_auction
from middleware.consensus.bidding.bid import Bid, is_cost, parse_bid
from middleware.consensus.bidding.merge_rule import MergeRule
from middleware.consensus.bidding.outgoing_message import (
    MAX_BIDS_PER_MESSAGE,
    FloodedBids,
    Notice,
    Offer,
    OutgoingMessage,
)
from middleware.consensus.bidding.participant import OnSummary, Participant
from middleware.consensus.bidding.path_choice import PathChoice
from middleware.consensus.strategy import ConsensusAlgorithm, Report
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError, NotRunning, Refused
from middleware.entangled.identity import Identity
from middleware.entangled.wire.admission_check import ROLE, explain
from middleware.errors import UnknownStrategy

REQUEST_TIMEOUT_S = 0.4
"""Timeout of one message in seconds: three tries on a path with a round-trip time of 100 ms.

A longer timeout delays the detection of failed peers; with a shorter timeout, slow peers appear to have failed.
"""
OFFER_METHOD, ANNOUNCE_METHOD, FLOOD_METHOD = "bid.offer", "bid.announce", "bid.cry"
FALLBACK_STRATEGY = "nearest"


class Bidding:
    """One agent's participation in ``auction``; ``on_summary`` is called with each announced set of reports."""

    def __init__(self, auction: Auction, on_summary: OnSummary, service: AuctionService) -> None:
        self.auction = auction
        self.on_summary = on_summary
        self._service = service
        self._last_report: Report | None = None
        self._has_published = False

    @property
    def has_bid(self) -> bool:
        """Whether there is a bid that was not withdrawn."""
        return self._last_report is not None

    def report(self, report: Report) -> None:
        """Bid, or replace the earlier bid; an unchanged bid is not sent again.

        Raises ``ValueError`` for an invalid cost.
        """
        if not self._has_published or report != self._last_report:
            self._publish(report)

    def withdraw(self) -> None:
        """Withdraw the bid, or abstain if there is no bid, so that the quorum members do not wait for this agent."""
        if not self._has_published or self._last_report is not None:
            self._publish(None)

    def expect_bidders(self, bidders: float) -> None:
        """At a quorum member, close the bidding as soon as ``bidders`` agents have bid or abstained.

        If ``bidders`` is infinite, the bidding is closed at the end of the waiting period.
        """
        self._service.expect_bidders(self.auction, bidders)

    def leave(self) -> None:
        """Stop listening to the auction; the node continues to forward bids."""
        self._service.leave(self)

    def _publish(self, report: Report | None) -> None:
        self._service.publish(self.auction, report)
        self._has_published, self._last_report = True, report


class RequestSender(Protocol):
    """The part of an endpoint that auctions use."""

    def ask(
        self, contact: Contact, method: str, *arguments: object, timeout: float | None = None, changes: bool = False
    ) -> Deferred[Any]:
        """Send a request, with retransmissions, until the peer answers or the timeout passes."""

    def notify(self, contact: Contact, method: str, *arguments: object) -> None:
        """Call a method of a peer once, without waiting for an answer."""


@dataclass(frozen=True)
class Environment:
    """The data about a node that its auctions use: its own contact, its contacts, the team's size, and the strategies.

    ``may_bid(key, public)`` returns whether the role of the owner of ``public`` permits bids under the auction's
    ``key``.
    """

    me: Callable[[], Contact]
    contacts: Callable[[], Iterable[Contact]]
    team_size: Callable[[], int]
    strategy_for: Callable[[str], ConsensusAlgorithm]
    may_bid: Callable[[bytes, bytes], bool] = lambda key, public: True


MAX_PARTICIPANTS = 256
MAX_IDLE_S = 300.0
"""Seconds of inactivity after which a participant is removed if this node's own agent does not take part in the
auction."""
OWN_OPENER = b""


@dataclass
class _TableEntry:
    participant: Participant
    opener: bytes
    touched_at: float


class ParticipantTable:
    """Participants by the digest of their auction; those in auctions of this node's own agent are never evicted."""

    def __init__(self) -> None:
        self._entries: dict[bytes, _TableEntry] = {}

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self) -> Iterator[Participant]:
        return iter([entry.participant for entry in self._entries.values()])

    def get(self, digest: bytes) -> Participant | None:
        """Return the participant in the auction with this digest."""
        entry = self._entries.get(digest)
        return entry.participant if entry is not None else None

    def touch(self, digest: bytes, now: float) -> None:
        """Record activity of a participant."""
        entry = self._entries.get(digest)
        if entry is not None:
            entry.touched_at = now

    def add(self, participant: Participant, opener: bytes, now: float) -> list[Participant]:
        """Add ``participant``, and return the evicted participants.

        ``opener`` is the id of the node that requested it, or ``OWN_OPENER``.
        """
        idle = [
            d
            for d, entry in self._entries.items()
            if entry.opener != OWN_OPENER and entry.touched_at < now - MAX_IDLE_S
        ]
        evicted = [self._entries.pop(digest).participant for digest in idle]
        while len(self._entries) >= MAX_PARTICIPANTS:
            counts = Counter(entry.opener for entry in self._entries.values() if entry.opener != OWN_OPENER)
            if not counts:
                break
            busiest = counts.most_common(1)[0][0]
            digest = next(digest for digest, entry in self._entries.items() if entry.opener == busiest)
            evicted.append(self._entries.pop(digest).participant)
        self._entries[participant.auction.digest] = _TableEntry(participant, opener, now)
        return evicted

    def mark_own(self, digest: bytes, is_own: bool, opener: bytes = b"left") -> None:
        """Mark whether this node's own agent takes part in the auction."""
        entry = self._entries.get(digest)
        if entry is not None:
            entry.opener = OWN_OPENER if is_own else opener


class AuctionService:
    """The auctions of one node."""

    _log = Logger()

    def __init__(
        self,
        identity: Identity,
        endpoint: RequestSender,
        environment: Environment,
        clock: IReactorTime,
        rng: random.Random,
    ) -> None:
        self._identity = identity
        self._endpoint = endpoint
        self._environment = environment
        self._clock = clock
        self._rng = rng
        self._path_choice = PathChoice()
        self._participants = ParticipantTable()
        self._timers: dict[bytes, IDelayedCall] = {}
        self._sending: set[bytes] = set()
        self._biddings: dict[bytes, list[Bidding]] = {}
        self._is_stopped = False

    def take_part(self, auction: Auction, on_summary: OnSummary) -> Bidding:
        """Take part in ``auction``.

        ``on_summary`` is called with each announced set of reports; if there is one already, it is called immediately.
        """
        participant = self._get_participant(auction, OWN_OPENER)
        bidding = Bidding(auction, on_summary, self)
        self._biddings.setdefault(auction.digest, []).append(bidding)
        self._participants.mark_own(auction.digest, True)
        if participant.standing_reports:
            on_summary(participant.standing_reports)
        return bidding

    def stop(self) -> None:
        """Cancel all timers and send nothing more."""
        self._is_stopped = True
        for timer in self._timers.values():
            if timer.active():
                timer.cancel()
        self._timers.clear()

    # -- requests of peers ------------------------------------------------------------------------------------------

    def answer_offer(
        self, peer: Contact, auction: list[object], bids: list[object], age_ms: int, is_shared: bool
    ) -> list[object] | None:
        """Process a peer's bids; return the announcement, or None if there is none yet.

        Raises ``Refused`` for invalid bids, and if too many other nodes send their bids to this node.
        """
        about = _require_auction(auction)
        if not 0 <= age_ms <= 1000 * MAX_WAITING_S:
            raise Refused(f"the age of an offer must be 0 to {1000 * MAX_WAITING_S:g} milliseconds")
        checked = self._check_bids(about, bids)
        # Only a bidder itself, not a forwarding node, may state that its bid is sent to all quorum members.
        is_own = all(bid.public == peer.public for bid in checked)
        participant = self._get_participant(about, peer.node_id)
        if not participant.has_room(peer):
            raise Refused(
                "too many nodes send their bids to this node; use a different contact that is nearer to the key"
            )
        now = self._clock.seconds()
        announcement = participant.on_offer(checked, peer, age_ms / 1000, is_shared and is_own, now)
        self._send_due(participant)
        return announcement.pack() if announcement is not None else None

    def answer_announcement(self, peer: Contact, auction: list[object], announcement: list[object]) -> None:
        """Process an announcement of a quorum member; any peer may forward it."""
        about = _require_auction(auction)
        participant = self._participants.get(about.digest)
        if participant is not None:  # a node that does not take part in the auction ignores the announcement
            self._process_announcement(participant, announcement)
            self._send_due(participant)

    def answer_flood(self, peer: Contact, auction: list[object], bids: list[object]) -> None:
        """Process bids flooded by a neighbour that reaches no quorum member."""
        about = _require_auction(auction)
        if about.exclusive:
            raise Refused("bids for an exclusive task must be sent to its quorum members")
        checked = self._check_bids(about, bids)
        participant = self._get_participant(about, peer.node_id)
        participant.on_flood(checked, peer, self._clock.seconds())
        self._send_due(participant)

    # -- inside -----------------------------------------------------------------------------------------------------

    def _get_participant(self, auction: Auction, opener: bytes) -> Participant:
        known = self._participants.get(auction.digest)
        if known is not None:
            return known
        try:
            strategy = self._environment.strategy_for(auction.strategy)
        except UnknownStrategy:
            strategy = self._environment.strategy_for(FALLBACK_STRATEGY)
        rule = MergeRule(strategy, self._log_fault)
        participant = Participant(
            auction,
            self._environment.me(),
            rule,
            self._environment.contacts,
            self._rng,
            self._identity.sign,
            lambda reports: self._notify(auction.digest, reports),
        )
        for evicted in self._participants.add(participant, opener, self._clock.seconds()):
            self._cancel_timer(evicted.auction.digest)
        return participant

    def _check_bids(self, auction: Auction, content: list[object]) -> list[Bid]:
        """Decode bids and check their signatures; raise ``Refused`` for an invalid one."""
        if len(content) > MAX_BIDS_PER_MESSAGE:
            raise Refused(f"a message may have at most {MAX_BIDS_PER_MESSAGE} bids, not {len(content)}")
        participant = self._participants.get(auction.digest)
        bids = []
        for each in content:
            bid = parse_bid(each)
            if bid is None:
                raise Refused("a bid must have a key, a finite cost of at least 0, a revision and a signature")
            if not self._environment.may_bid(auction.key, bid.public):
                continue  # do not reject the message, because other bids in it may be permitted
            known = participant.summary.get(bid.agent) if participant is not None else None
            if known is not None and known.rank == bid.rank:
                bids.append(known)  # already checked
            elif bid.is_genuine(auction):
                bids.append(bid)
            else:
                raise Refused("the signature of a bid for this auction is not valid")
        if content and not bids:
            raise Refused(f"no bid is permitted: {explain(ROLE)}", ROLE)
        return bids

    def _process_announcement(self, participant: Participant, content: object) -> None:
        """Check and process an announcement; raise ``Refused`` if it is invalid."""
        announcement = parse_announcement(content)
        if announcement is None:
            raise Refused("an announcement must have a number, the rank of a quorum member, reports and a signature")
        if participant.announcement is not None and announcement.precedence <= participant.announcement.precedence:
            return
        if not announcement.is_genuine(participant.auction):
            raise Refused("the announcement is not signed by a quorum member of the task")
        participant.on_announcement(announcement, self._clock.seconds())
        if participant.is_superseded and participant.own_bid is not None:
            self._bid(participant, participant.own_bid.report)

    def publish(self, auction: Auction, report: Report | None) -> None:
        """Make this node's bid in ``auction``, or withdraw it (None).  Raise ``ValueError`` for an invalid cost."""
        if report is not None:
            if not is_cost(report.cost):
                raise ValueError(f"cost must be finite and at least 0, not {report.cost!r}")
            if report.agent != self._identity.node_id.hex():
                raise ValueError("a node may bid only for its own agent")
        participant = self._get_participant(auction, OWN_OPENER)
        self._bid(participant, report)
        self._send_due(participant)

    def _bid(self, participant: Participant, report: Report | None) -> None:
        bid = Bid(self._identity.public, report, participant.next_revision).sign(self._identity, participant.auction)
        participant.make_bid(bid, self._path_choice.choose(self._environment.team_size()), self._clock.seconds())

    def expect_bidders(self, auction: Auction, bidders: float) -> None:
        """Close the bidding as soon as ``bidders`` agents have bid or abstained."""
        participant = self._get_participant(auction, OWN_OPENER)
        participant.expect_bidders(bidders)
        self._send_due(participant)

    def leave(self, bidding: Bidding) -> None:
        """Stop notifying ``bidding``."""
        digest = bidding.auction.digest
        remaining = [each for each in self._biddings.pop(digest, []) if each is not bidding]
        if remaining:
            self._biddings[digest] = remaining
        else:
            self._participants.mark_own(digest, False)

    def _notify(self, digest: bytes, reports: tuple[Report, ...]) -> None:
        for bidding in list(self._biddings.get(digest, ())):
            try:
                bidding.on_summary(reports)
            except Exception:  # third-party code may raise anything
                self._log.failure("the callback for announcements of {task} failed", task=bidding.auction.task_id)

    def _log_fault(self, method: str, error: Exception) -> None:
        self._log.error("a strategy's {method} raised {error!r}; using nearest instead", method=method, error=error)

    def _send_due(self, participant: Participant) -> None:
        """Send all messages that are due, and set the timer for the next messages."""
        digest = participant.auction.digest
        if self._is_stopped or digest in self._sending or self._participants.get(digest) is not participant:
            return
        self._sending.add(digest)
        self._participants.touch(digest, self._clock.seconds())
        try:
            while messages := participant.take_due_messages(self._clock.seconds()):
                for message in messages:
                    self._send(participant, message)
        finally:
            self._sending.discard(digest)
        self._set_timer(participant)

    def _set_timer(self, participant: Participant) -> None:
        self._cancel_timer(participant.auction.digest)
        if participant.due != math.inf and not self._is_stopped:
            wait = max(0.0, participant.due - self._clock.seconds())
            self._timers[participant.auction.digest] = self._clock.callLater(wait, self._send_due, participant)

    def _cancel_timer(self, digest: bytes) -> None:
        timer = self._timers.pop(digest, None)
        if timer is not None and timer.active():
            timer.cancel()

    def _send(self, participant: Participant, message: OutgoingMessage) -> None:
        head = participant.auction.pack()
        if isinstance(message, FloodedBids):
            try:
                self._endpoint.notify(message.to, FLOOD_METHOD, head, [bid.pack() for bid in message.bids])
            except EntangledError as error:
                self._log.debug("flooded bids were not sent: {error}", error=error)
            return
        if isinstance(message, Notice):
            arguments: tuple[object, ...] = (ANNOUNCE_METHOD, head, message.announcement.pack())
        else:
            bids = [bid.pack() for bid in message.bids]
            arguments = (OFFER_METHOD, head, bids, _to_milliseconds(message.age), message.is_shared)
        method, *others = arguments
        request = self._endpoint.ask(message.to, str(method), *others, timeout=REQUEST_TIMEOUT_S, changes=True)
        request.addCallbacks(
            self._on_answer, self._on_failure, callbackArgs=(participant, message), errbackArgs=(participant, message)
        )
        request.addErrback(lambda failure: self._log.failure("bids or an announcement could not be sent", failure))

    def _on_answer(self, answer: object, participant: Participant, message: OutgoingMessage) -> None:
        if isinstance(message, Offer) and answer is not None:
            try:
                self._process_announcement(participant, answer)
            except Refused as error:
                self._log.info("{peer} returned an invalid announcement: {error}", peer=message.to.address, error=error)
        participant.on_answer(message, self._clock.seconds())
        self._send_due(participant)

    def _on_failure(self, failure: Any, participant: Participant, message: OutgoingMessage) -> None:
        if failure.check(EntangledError) is None:
            self._log.failure("sending bids failed", failure)
        if failure.check(NotRunning) is None:
            participant.on_failure(message, self._clock.seconds())
            self._send_due(participant)


def _require_auction(content: list[object]) -> Auction:
    auction = parse_auction(content)
    if auction is None:
        raise Refused(
            f"an auction must have a task, an epoch, 1 to {MAX_COUNCIL} quorum members, a strategy and a waiting period"
        )
    return auction


def _to_milliseconds(age: float) -> int:
    return min(int(1000 * MAX_WAITING_S), max(0, round(1000 * age)))
