"""Measure bidding for up to 10,000 agents: messages, time and agreement.

The bidding code and the routing tables are production code. The links are simulated by a heap of events, with a one-way
delay of 20 ms + Exp(10 ms) and independent loss; messages are retransmitted after the same delays as in the endpoint.
Signatures are omitted, because they affect only processor time.
"""

from __future__ import annotations

import argparse
import hashlib
import heapq
import json
import math
import random
import sys
import time
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.measure import percentile
from middleware.consensus.bidding.announcement import Announcement
from middleware.consensus.bidding.auction import Auction
from middleware.consensus.bidding.bid import Bid
from middleware.consensus.bidding.merge_rule import MergeRule
from middleware.consensus.bidding.outgoing_message import FloodedBids, Notice, Offer, OutgoingMessage
from middleware.consensus.bidding.participant import Participant
from middleware.consensus.bidding.path_choice import PathChoice
from middleware.consensus.strategy import Report, load_strategy
from middleware.entangled.contact import Contact
from middleware.entangled.kademlia.distance import select_closest
from middleware.entangled.kademlia.routing_table import RoutingTable
from middleware.entangled.network.network import Address

BITS = 160
K = 8
RETRANSMISSION_DELAYS_S = (0.0, 0.1, 0.25)
ANSWER_LIMIT_S = 0.4
"""Seconds until the retransmissions of a message, and until its failure, as at the endpoint with the default
timeout."""
SMALL_COUNCIL, LARGE_COUNCIL, LARGE_FROM = 3, 5, 50
MIN_RIGHT_SHARE = 0.99
MESSAGES = {3: 10.0, 30: 10.0, 100: 6.0, 1_000: 6.0, 10_000: 6.0}
BUSIEST = 1_000
AGREEMENT = {0.0: {100: 0.2, 1_000: 0.3, 10_000: 0.4}, 0.1: {100: 0.6, 1_000: 0.8, 10_000: 1.0}}


class Ring:
    """``n`` contacts with random ids, and their routing tables."""

    def __init__(self, n: int, rng: random.Random) -> None:
        self.contacts = [Contact(rng.randbytes(32), Address("10.0.0.1", 1 + i % 65_000)) for i in range(n)]
        self._sorted = sorted((int.from_bytes(c.node_id), i) for i, c in enumerate(self.contacts))
        self._ids = [number for number, _ in self._sorted]
        self._rng = rng

    def make_table(self, place: int) -> RoutingTable:
        """Return the routing table of the node at index ``place``: up to k contacts of each range of distances."""
        own = self._ids_of(place)
        table = RoutingTable(self.contacts[place].node_id, K)
        for bit in reversed(range(BITS)):
            low = ((own >> bit) ^ 1) << bit
            first, end = bisect_left(self._ids, low), bisect_left(self._ids, low + (1 << bit))
            for at in self._rng.sample(range(first, end), min(K, end - first)):
                table.record_contact(self.contacts[self._sorted[at][1]], 0.0)
            near = low & ~((1 << (bit + 1)) - 1)
            if bisect_left(self._ids, near + (1 << (bit + 1))) - bisect_left(self._ids, near) <= 1:
                break
        return table

    def _ids_of(self, place: int) -> int:
        return int.from_bytes(self.contacts[place].node_id)


@dataclass
class LinkFaults:
    """Faults: the shares of lost datagrams, of failed agents (``dead``) and of duplicated datagrams."""

    loss: float = 0.0
    dead: float = 0.0
    duplicate: float = 0.0
    delay: Callable[[random.Random], float] = lambda rng: 0.02 + rng.expovariate(100.0)


@dataclass
class Outcome:
    """The result of an auction; ``took`` has each agent's seconds from the waiting period to the right decision."""

    messages: float
    busiest: int
    right: float
    agreement_times: list[float] = field(repr=False)
    gathered: float
    digest: str


class AuctionSimulation:
    """``n`` agents that all bid for one task within ``spread`` seconds; equal seeds give equal runs."""

    def __init__(
        self,
        n: int,
        seed: int,
        faults: LinkFaults,
        waiting: float = 0.5,
        spread: float = 0.1,
        way: str = "",
        council_is_dead: bool = False,
        exclusive: bool = True,
    ) -> None:
        self.rng = random.Random(f"{seed}/links")
        self.now = 0.0
        self.ring = Ring(n, random.Random(f"{seed}/ring"))
        contacts = self.ring.contacts
        task = f"task-{seed}"
        key = Auction(task, 1, (contacts[0],)).key
        council = select_closest(contacts, key, LARGE_COUNCIL if n >= LARGE_FROM else SMALL_COUNCIL)
        self.auction = Auction(task, 1, tuple(council), waiting_period=waiting, exclusive=exclusive)
        self.way = way or PathChoice().choose(n)
        self.faults = faults
        self.sent = [0] * n
        self.handled = [0] * n
        self.views: list[tuple[Report, ...]] = [()] * n
        self.changed_at = [math.inf] * n
        self.gathered = math.inf
        self._places = {c.node_id: i for i, c in enumerate(contacts)}
        self._heap: list[tuple[float, int, Callable[..., None], tuple[object, ...]]] = []
        self._order = 0
        self._due = [math.inf] * n
        self._rule = MergeRule(load_strategy("nearest"))
        members = {self._places[c.node_id] for c in council}
        rng = random.Random(f"{seed}/dead")
        self.dead = {i for i in range(n) if i not in members and rng.random() < faults.dead}
        if council_is_dead:
            self.dead |= members
        self.parties = [self._get_party(i) for i in range(n)]
        self.costs = [self.rng.uniform(1.0, 100.0) for _ in range(n)]
        for i in range(n):
            if i not in self.dead:
                self.schedule(self.rng.uniform(0.0, spread) if i else 0.0, self.bid, i, self.costs[i])
        self.best = self.find_right_winner()

    def find_right_winner(self) -> str:
        """Return the right winner: the cheapest live agent."""
        alive = [(self.costs[i], self.get_uuid(i)) for i in range(len(self.costs)) if i not in self.dead]
        return min(alive)[1]

    def get_uuid(self, place: int) -> str:
        """Return the uuid of the agent at index ``place``."""
        return self.ring.contacts[place].node_id.hex()

    def schedule(self, moment: float, call: Callable[..., None], *arguments: object) -> None:
        """Schedule ``call`` at ``moment``."""
        self._order += 1
        heapq.heappush(self._heap, (moment, self._order, call, arguments))

    def bid(self, place: int, cost: float | None, revision: int = 0) -> None:
        """Let the agent at index ``place`` bid, or withdraw its bid."""
        public = self.ring.contacts[place].public
        report = None if cost is None else Report(self.get_uuid(place), cost)
        self.parties[place].make_bid(Bid(public, report, revision), self.way, self.now)
        self.send_pending(place)

    def run(self, until: float) -> None:
        """Process all events up to the time ``until``."""
        while self._heap and self._heap[0][0] <= until:
            self.now, _, call, arguments = heapq.heappop(self._heap)
            call(*arguments)
        self.now = until

    def make_outcome(self) -> Outcome:
        """Return the result so far."""
        alive = [i for i in range(len(self.costs)) if i not in self.dead]
        right = [i for i in alive if self.get_assigned(i) == self.best]
        over = self.auction.waiting_period
        took = sorted(max(0.0, self.changed_at[i] - over) for i in right)
        text = "".join(f"{self.sent[i]}/{self.changed_at[i]:.9f};" for i in alive)
        digest = hashlib.blake2s(text.encode(), digest_size=8).hexdigest()
        return Outcome(
            sum(self.sent) / len(alive), max(self.handled), len(right) / len(alive), took, self.gathered, digest
        )

    def get_assigned(self, place: int) -> str | None:
        """Return the winner in the view of the agent at index ``place``."""
        return self._rule.decide(self.views[place])[0]

    # -- links ------------------------------------------------------------------------------------------------------

    def send_pending(self, place: int) -> None:
        """Send the pending messages of a node, and schedule its next call."""
        participant = self.parties[place]
        for message in participant.take_due_messages(self.now):
            self._send_message(place, message)
        due = participant.due
        if due != math.inf and due < self._due[place]:
            self._due[place] = due
            self.schedule(max(due, self.now), self._on_timer, place, due)

    def _on_timer(self, place: int, due: float) -> None:
        if self._due[place] == due:
            self._due[place] = math.inf
            self.send_pending(place)

    def _send_message(self, place: int, message: OutgoingMessage) -> None:
        to = self._places[message.to.node_id]
        if isinstance(message, FloodedBids):
            self._send(place, to, self._deliver_flood, place, to, message)
            return
        state: dict[str, object] = {}
        for wait in RETRANSMISSION_DELAYS_S:
            self.schedule(self.now + wait, self._send_attempt, place, to, message, state)
        self.schedule(self.now + ANSWER_LIMIT_S, self._handle_timeout, place, message, state)

    def _send_attempt(self, place: int, to: int, message: OutgoingMessage, state: dict[str, object]) -> None:
        if "settled" not in state:
            self._send(place, to, self._deliver, place, to, message, state)

    def _send(self, place: int, to: int, call: Callable[..., None], *arguments: object) -> None:
        self.sent[place] += 1
        self.handled[place] += 1
        copies = 2 if self.faults.duplicate and self.rng.random() < self.faults.duplicate else 1
        for _ in range(copies):
            if self.rng.random() >= self.faults.loss and to not in self.dead:
                self.schedule(self.now + self.faults.delay(self.rng), self._on_received, to, call, arguments)

    def _on_received(self, to: int, call: Callable[..., None], arguments: tuple[object, ...]) -> None:
        self.handled[to] += 1
        call(*arguments)

    def _deliver_flood(self, place: int, to: int, flood: FloodedBids) -> None:
        self.parties[to].on_flood(flood.bids, self.ring.contacts[place], self.now)
        self.send_pending(to)

    def _deliver(self, place: int, to: int, message: OutgoingMessage, state: dict[str, object]) -> None:
        if "reply" not in state or self.faults.duplicate:  # a duplicate also runs the method, which is idempotent
            state["reply"] = self._handle(place, to, message)
        self._send(to, place, self._handle_reply, place, message, state)
        self.send_pending(to)

    def _handle(self, place: int, to: int, message: OutgoingMessage) -> Announcement | None:
        participant, sender = self.parties[to], self.ring.contacts[place]
        if isinstance(message, Offer):
            reply = participant.on_offer(message.bids, sender, message.age, message.is_shared, self.now)
            has_best = any(report.agent == self.best for report in participant.summary.standing)
            if has_best and self.auction.find_rank(self.ring.contacts[to].node_id) == 0:
                self.gathered = min(self.gathered, self.now)
            return reply
        assert isinstance(message, Notice)
        participant.on_announcement(message.announcement, self.now)
        return None

    def _handle_reply(self, place: int, message: OutgoingMessage, state: dict[str, object]) -> None:
        if "settled" in state:
            return
        state["settled"] = True
        reply = state["reply"]
        if isinstance(reply, Announcement):
            self.parties[place].on_announcement(reply, self.now)
        self.parties[place].on_answer(message, self.now)
        self.send_pending(place)

    def _handle_timeout(self, place: int, message: OutgoingMessage, state: dict[str, object]) -> None:
        if "settled" not in state:
            state["settled"] = True
            self.parties[place].on_failure(message, self.now)
            self.send_pending(place)

    def _get_party(self, place: int) -> Participant:
        known: list[Contact] = []

        def contacts() -> list[Contact]:
            if not known:
                table = self.ring.make_table(place)
                # Ten thousand full routing tables do not fit into memory.  Each node therefore knows only the
                # contacts on its path to the key; only flooding needs all of them.
                everybody = table.list_contacts()
                known.extend(select_closest(everybody, self.auction.key, K) if self.auction.exclusive else everybody)
            return known

        rng = random.Random(f"{self.auction.task_id}/{place}")
        return Participant(
            self.auction,
            self.ring.contacts[place],
            self._rule,
            contacts,
            rng,
            lambda message: b"",
            lambda reports: self._update_view(place, reports),
        )

    def _update_view(self, place: int, reports: tuple[Report, ...]) -> None:
        before = self._rule.decide(self.views[place])[0]
        self.views[place] = reports
        if self._rule.decide(reports)[0] != before:
            self.changed_at[place] = self.now


def measure(n: int, loss: float, dead: float, runs: int, seed: int, **options: object) -> dict[str, object]:
    """Return the figures of ``runs`` auctions."""
    outcomes = []
    for run in range(runs):
        crowd = AuctionSimulation(n, seed + run, LinkFaults(loss, dead), **options)  # type: ignore[arg-type]
        crowd.run(8.0)
        outcomes.append(crowd.make_outcome())
    took = [t for outcome in outcomes for t in outcome.agreement_times]
    row: dict[str, object] = {
        "n": n,
        "way": PathChoice().choose(n),
        "loss": loss,
        "dead": dead,
        "runs": runs,
        "messages": sum(o.messages for o in outcomes) / runs,
        "busiest": max(o.busiest for o in outcomes),
        "p50": percentile(took, 0.5),
        "p95": percentile(took, 0.95),
        "last": max(took, default=math.inf),
        "right": sum(o.right for o in outcomes) / runs,
    }
    row["missed"] = [name for name, holds in check_targets(row) if not holds]
    return row


def check_targets(row: dict[str, object]) -> list[tuple[str, bool]]:
    """Return the targets of the row, and whether it met them."""
    n, loss, dead = row["n"], row["loss"], row["dead"]
    assert isinstance(n, int) and isinstance(loss, float)
    goals = []
    if loss <= 0.1 and not dead:
        goals.append(("messages", float(str(row["messages"])) <= MESSAGES.get(n, 10.0)))
        limit = AGREEMENT.get(loss, {}).get(n)
        if limit is not None:
            goals.append(("agreement", float(str(row["p95"])) <= limit))
        goals.append(("right", float(str(row["right"])) >= MIN_RIGHT_SHARE))
        goals.append(("busiest", int(str(row["busiest"])) <= BUSIEST))
    return goals


def main(arguments: list[str]) -> int:
    """Print the table; return 1 if a target was missed."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bidding", description=__doc__)
    parser.add_argument("--n", type=int, nargs="+", default=[3, 30, 100, 1_000, 10_000], help="numbers of agents")
    parser.add_argument("--loss", type=float, nargs="+", default=[0.0, 0.1, 0.3], help="shares of lost datagrams")
    parser.add_argument("--dead", type=float, nargs="+", default=[0.0, 0.01], help="shares of failed agents")
    parser.add_argument("--runs", type=int, default=0, help="auctions per row (0: fewer with more agents)")
    parser.add_argument("--spread", type=float, default=0.1, help="seconds within which all agents bid")
    parser.add_argument("--waiting", type=float, default=0.5, help="the waiting period in seconds")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", help="write the rows to this file as well")
    args = parser.parse_args(arguments)
    print(
        "     n way     loss  dead  runs  messages/agent  busiest  agreed p50   p95  last  right     targets",
        flush=True,
    )
    rows = []
    for n in args.n:
        for dead in args.dead:
            for loss in args.loss:
                runs = args.runs or max(1, min(40, 3_000 // n))
                started_at = time.process_time()
                row = measure(n, loss, dead, runs, args.seed, waiting=args.waiting, spread=args.spread)
                row["cpu"] = time.process_time() - started_at
                rows.append(row)
                verdict = "yes" if not row["missed"] else "NO: " + ", ".join(row["missed"])  # type: ignore[arg-type]
                print(
                    f"{n:6} {row['way']:7} {loss:4.0%} {dead:5.0%} {runs:5} {row['messages']:15.2f} {row['busiest']:8} "
                    f"{row['p50']:11.3f} {row['p95']:5.3f} {row['last']:5.3f} {row['right']:8.4%}  {verdict}",
                    flush=True,
                )
    if args.json:
        Path(args.json).write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 1 if any(row["missed"] for row in rows) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
