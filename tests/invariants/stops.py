"""Run random sequences of stops, releases, partitions, restarts and hostile messages on the stops of a small team.

The stop states are objects of the product. The network below them delays, repeats and loses messages; disks lose
unwritten data; replicas forget records and return old ones.

One invariant is checked after each step: once a robot's node has acknowledged a stop by an honest operator, the robot
stands still until it receives a release of this stop from a member that may stop the team. Another is checked at the
end, with a healthy network: an operator can release the whole team.

``python -m tests.invariants.stops --sequences 10000 --seed 1`` runs 10,000 sequences and prints the counts of events.
"""

from __future__ import annotations

import argparse
import random
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import msgpack
from twisted.internet.defer import Deferred, fail, succeed
from twisted.internet.task import Clock
from twisted.python.failure import Failure

from middleware.admission import roles
from middleware.entangled.contact import Contact
from middleware.entangled.data.memory import MemoryStore
from middleware.entangled.errors import EntangledError, NoAnswer, Refused, Unavailable
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address
from middleware.entangled.record import Record, Slot
from middleware.stop.stop_set import ID_BYTES, MAX_RELEASED, MAX_STOPS, parse_statement
from middleware.stop.stop_state import (
    METHOD,
    NOT_SAVED,
    NOTE_NAME,
    SLOT,
    STANDS_STILL,
    STOPS_KEY,
    StopState,
    expose_stops,
)

STEPS = 60
TEAM = {
    "ann": roles.OPERATOR,
    "bob": roles.OPERATOR,
    "web": roles.GATEWAY,
    "dog1": roles.DEVICE,
    "dog2": roles.DEVICE,
    "dog3": roles.DEVICE,
    "eye": roles.VIEWER,
    "boot": roles.BOOTSTRAP,
    "thief": roles.OPERATOR,
}
HONEST = ("ann", "bob", "web")
ROBOTS = ("dog1", "dog2", "dog3")
NODES = (*HONEST, *ROBOTS)
OUTSIDE = "invented"
"""The signer whose key belongs to no member."""


class Violation(AssertionError):
    """A robot that acknowledged a stop may move, or a team cannot be released."""


class Disk(MemoryStore):
    """A store that loses unwritten notes in a crash."""

    def __init__(self) -> None:
        super().__init__()
        self.safe: bytes | None = None
        self.waiting: list[tuple[bytes | None, Deferred[None]]] = []

    def wait_for_write(self) -> Deferred[None]:
        """Return a Deferred that fires when the disk has written the note."""
        done: Deferred[None] = Deferred()
        self.waiting.append((self.get_note(NOTE_NAME), done))
        return done

    def commit(self) -> None:
        """Write the pending note."""
        self.safe = self.get_note(NOTE_NAME)
        waiting, self.waiting = self.waiting, []
        for _, done in waiting:
            done.callback(None)

    def crash(self) -> None:
        """Lose the unwritten note."""
        self.waiting.clear()
        self._notes.pop(NOTE_NAME, None)
        if self.safe is not None:
            self.set_note(NOTE_NAME, self.safe)


@dataclass
class Life:
    """One run of a node, with the parts of the library that its stop state uses."""

    net: Net
    name: str
    stop_state: StopState = field(init=False)
    is_over: bool = False
    changed: Callable[[list[Record]], None] | None = None
    answer: Callable[..., Any] = field(init=False)

    def __post_init__(self) -> None:
        self.identity = self.net.identities[self.name]
        self.store = self.net.disks[self.name]
        self.endpoint = self.replica = self.admission = self
        self.records: list[Record] = []
        self.stop_state = expose_stops(self, self.net.rng, self.later, lambda stops, words: None)  # type: ignore[arg-type]
        if self.name in ROBOTS:
            self.stop_state.subscribe(self.obey)

    def obey(self) -> str:
        """Update the stop state as an agent does; return the activity of the robot."""
        if not self.stop_state.is_known:
            self.stop_state.request_stops()
        return STANDS_STILL if self.stop_state.is_motion_forbidden else "goes on"

    def expose(self, name: str, answer: Callable[..., Any], changes: bool, idempotent: bool) -> None:
        """Store the handler of calls to this node."""
        self.answer = answer

    def later(self, seconds: float, call: Callable[[], None]) -> None:
        """Schedule a call that is dropped when this run of the node ends."""
        self.net.clock.callLater(seconds, lambda: None if self.is_over else call())

    def may_call(self, public: bytes, method: str) -> bool:
        """Return whether the member may call the method now."""
        return self.net.may(public)

    def may_store(self, slot: Slot) -> bool:
        """Return whether the owner may write the slot now."""
        return self.net.may(slot.owner)

    def may_stay(self, slot: Slot) -> bool:
        """Return True: the node keeps every stored record, like the most permissive replica."""
        return True

    def call(self, contact: Contact, method: str, *arguments: object, changes: bool = False) -> Deferred[Any]:
        """Call another node."""
        return self.net.send(self.name, self.net.names[contact.public], arguments)

    def put(self, key: bytes, name: str, value: bytes, lifetime: str) -> Deferred[int]:
        """Store a record, which spreads by gossip."""
        self.net.write(self.name, value)
        return succeed(1)

    def get(self, key: bytes) -> Deferred[list[Record]]:
        """Read the records from a majority of the replicas."""
        near = [other for other in NODES if self.net.reaches(self.name, other)]
        if len(near) <= len(NODES) // 2:
            return fail(Unavailable(len(near), len(NODES) // 2 + 1))
        records = self.net.newest(near)
        self.net.reached(self.name, records)
        return succeed(records)

    def watch(self, key: bytes, changed: Callable[[list[Record]], None], keep: bool) -> Life:
        """Watch the records at this node; return this object as the watch."""
        self.changed = changed
        self.look()
        return self

    def look(self) -> None:
        """Notify the watch if the records have changed."""
        records = self.net.newest([self.name])
        if self.changed is not None and records != self.records:
            self.records = records
            self.net.reached(self.name, records)
            self.changed(records)


class Net:
    """A team, its messages in transit, and the stops that each robot must obey."""

    def __init__(self, seed: int, counts: Counter[str]) -> None:
        self.rng = random.Random(seed)
        self.counts = counts
        self.clock = Clock()
        self.identities = {name: Identity(self.rng.randbytes(32)) for name in (*TEAM, OUTSIDE)}
        self.names = {self.identities[name].public: name for name in TEAM}
        self.revoked: set[str] = set()
        self.disks = {name: Disk() for name in NODES}
        self.replicas: dict[str, dict[bytes, Record]] = {name: {} for name in NODES}
        self.old: list[Record] = []
        self.sent: list[tuple[str, str, tuple[Any, ...]]] = []
        self.sides = dict.fromkeys(TEAM, 0)
        self.lives: dict[str, Life] = {}
        self.owed: dict[str, set[bytes]] = {name: set() for name in ROBOTS}
        self.tracked: set[bytes] = set()
        for name in NODES:
            self.begin(name)

    # -- interface for the nodes ------------------------------------------------------------------------------------

    def may(self, public: bytes) -> bool:
        """Return whether the owner of this key is a member that may stop the team."""
        name = self.names.get(public, "")
        return name in TEAM and name not in self.revoked and roles.may_call((TEAM[name],), METHOD)

    def reaches(self, one: str, other: str) -> bool:
        """Return whether two nodes can communicate."""
        return self.sides[one] == self.sides[other] and other in self.lives

    def newest(self, names: list[str]) -> list[Record]:
        """Return the newest record of each owner at these nodes."""
        best: dict[bytes, Record] = {}
        for name in names:
            for owner, record in self.replicas[name].items():
                if record.supersedes(best.get(owner)):
                    best[owner] = record
        return [best[owner] for owner in sorted(best)]

    def write(self, name: str, value: bytes) -> None:
        """Write a new record of an owner to the owner's replica, or to a random replica if the owner is not a node."""
        own = self.identities[name].public
        known = [r.sequence for r in (*self.old, *self.newest(list(NODES))) if r.owner == own]
        record = Record(STOPS_KEY, SLOT, own, max(known, default=0) + 1, "team", 600.0, value, self.rng.randbytes(64))
        self.old.append(record)
        self.hold(name if name in NODES else self.rng.choice(NODES), record)

    def hold(self, name: str, record: Record) -> None:
        """Store a record at a replica if it is newer than the present record and its owner may write it."""
        owner = self.names.get(record.owner)
        if owner is not None and not self.may(record.owner):
            return
        if record.supersedes(self.replicas[name].get(record.owner)):
            self.replicas[name][record.owner] = record
            if name in self.lives:
                self.lives[name].look()

    def reached(self, name: str, records: list[Record]) -> None:
        """Record which releases reach a robot in records; only members that may stop the team count."""
        for record in records:
            if name in ROBOTS and self.may(record.owner) and _is_msgpack(record.value):
                self.released(name, msgpack.unpackb(record.value or b""))

    def released(self, name: str, fields: object) -> None:
        """Remove the released stops from the stops that the robot must obey."""
        statement = parse_statement(fields)
        if statement is not None:
            self.owed[name] -= set(statement.released)

    def send(self, sender: str, to: str, arguments: tuple[Any, ...]) -> Deferred[Any]:
        """Send a call; the request or its reply may be lost."""
        self.sent.append((sender, to, arguments))
        if not self.reaches(sender, to) or self.rng.random() < 0.1:
            return fail(NoAnswer("lost"))
        answered = self.deliver(sender, to, arguments)
        return fail(NoAnswer("lost")) if self.rng.random() < 0.1 else answered

    def deliver(self, sender: str, to: str, arguments: tuple[Any, ...]) -> Deferred[Any]:
        """Process a call as the endpoint of ``to`` does: check the role and the types, then call the method."""
        if not self.may(self.identities[sender].public):
            self.counts["refused"] += 1
            return fail(Refused("role"))
        if [type(each) for each in arguments] != [list, list, str]:
            self.counts["refused"] += 1
            return fail(Refused("not the arguments"))
        life = self.lives[to]
        peer = Contact(self.identities[sender].public, Address("10.0.0.1", 1))
        if to in ROBOTS:
            self.released(to, list(arguments))
        try:
            answered: Deferred[Any] = life.answer(peer, *arguments)
        except Refused:
            self.counts["refused"] += 1
            return fail(Failure())

        def acknowledged(answer: list[Any]) -> list[Any]:
            status, obeyed = answer
            if to in ROBOTS and life is self.lives.get(to) and not status.endswith(NOT_SAVED):
                ids = {stop for stop, _ in obeyed} & self.tracked
                # A release may have arrived between the stop and the end of the write.
                fresh = {stop for stop, _ in arguments[0]} & ids & set(life.stop_state.stops)
                self.owed[to] |= fresh
                self.counts["acknowledged"] += len(fresh)
            return answer

        return answered.addCallback(acknowledged)

    # -- events -----------------------------------------------------------------------------------------------------

    def begin(self, name: str) -> None:
        """Start a node."""
        life = self.lives[name] = Life(self, name)
        life.stop_state.request_stops() if name in ROBOTS else life.stop_state.follow()

    def contacts(self) -> list[Contact]:
        """Return the contacts of all nodes."""
        return [Contact(self.identities[name].public, Address("10.0.0.1", 1)) for name in NODES]

    def stop(self) -> None:
        """Let an honest operator stop the team."""
        name = self.orderer()
        if name:
            before = set(self.lives[name].stop_state.stops)
            asked = self.lives[name].stop_state.stop
            # The id must be known before the first reply arrives.
            state = self.rng.getstate()
            self.tracked.add(self.rng.randbytes(ID_BYTES))
            self.rng.setstate(state)
            asked(name, self.contacts()).addErrback(_expected)
            self.counts["stops"] += bool(set(self.lives[name].stop_state.stops) - before)

    def release(self) -> None:
        """Let an honest operator release some or all of the stops that it knows."""
        name = self.orderer()
        if name:
            known = list(self.lives[name].stop_state.stops)
            named = known if self.rng.random() < 0.6 else self.rng.sample(known, len(known) // 2)
            self.lives[name].stop_state.release(named, name, self.contacts()).addErrback(_expected)
            self.counts["releases"] += 1

    def orderer(self) -> str:
        """Return an honest operator that is online and not revoked, or an empty string."""
        up = [name for name in HONEST if name in self.lives and name not in self.revoked]
        return self.rng.choice(up) if up else ""

    def partition(self) -> None:
        """Partition the network, or heal it."""
        is_whole = self.rng.random() < 0.5
        self.sides = {name: 0 if is_whole else self.rng.randrange(2) for name in TEAM}
        self.counts["partitions"] += 1

    def restart(self) -> None:
        """Crash one node or all nodes, and restart them later."""
        for name in NODES if self.rng.random() < 0.1 else [self.rng.choice(NODES)]:
            life = self.lives.pop(name, None)
            if life is None:
                continue
            life.is_over = True
            self.disks[name].crash()
            self.counts["restarts"] += 1
            if self.rng.random() < 0.3:
                self.replicas[name].clear()
            self.clock.callLater(self.rng.random() * 20.0, self.come_back, name)

    def come_back(self, name: str) -> None:
        """Start a node if it is not running."""
        if name not in self.lives:
            self.begin(name)

    def forget(self) -> None:
        """Let a replica lose a record, as if the record had expired."""
        name = self.rng.choice(NODES)
        if self.replicas[name]:
            del self.replicas[name][self.rng.choice(list(self.replicas[name]))]
            if name in self.lives:
                self.lives[name].look()
            self.counts["records lost"] += 1

    def gossip(self) -> None:
        """Let pairs of replicas exchange records."""
        for _ in range(6):
            one, other = self.rng.sample(NODES, 2)
            if one in self.lives and self.reaches(one, other):
                for record in self.newest([one, other]):
                    self.hold(one, record)
                    self.hold(other, record)

    def repeat(self) -> None:
        """Repeat an earlier call of a present member, or let a replica return an old record."""
        self.counts["repeated"] += 1
        if self.sent and self.rng.random() < 0.6:
            sender, to, arguments = self.rng.choice(self.sent)
            if to in self.lives:
                self.deliver(sender, to, arguments).addErrback(_expected)
        elif self.old:
            self.hold(self.rng.choice(NODES), self.rng.choice(self.old))

    def revoke(self) -> None:
        """Revoke an operator; at least one honest operator remains."""
        name = self.rng.choice(("bob", "web", "thief"))
        if name not in self.revoked and self.rng.random() < 0.3:
            self.revoked.add(name)
            public = self.identities[name].public
            for replica in NODES:
                self.replicas[replica].pop(public, None)
                if replica in self.lives:
                    self.lives[replica].look()
            self.counts["revoked"] += 1

    def attack(self) -> None:
        """Send a hostile message.

        Its sender is a member that must not stop the team, or has an invented or stolen key.
        """
        self.counts["hostile"] += 1
        sender = self.rng.choice(("eye", "boot", "dog1", "thief", OUTSIDE))
        known = list(self.tracked)
        if sender == "thief" and self.rng.random() < 0.9:
            known = []  # a stolen key may release known stops, so most such attacks invent stops
        arguments = self.rng.choice(
            [
                lambda: (2 ** self.rng.choice((31, 53, 63)), self.rng.random() < 0.5, sender),
                lambda: (
                    [],
                    [self.rng.randbytes(ID_BYTES) for _ in range(self.rng.choice((1, MAX_RELEASED)))],
                    sender,
                ),
                lambda: ([[self.rng.randbytes(ID_BYTES), sender] for _ in range(MAX_STOPS)], [], sender),
                lambda: ([], known[:MAX_RELEASED], sender),
                lambda: ([[stop, sender] for stop in known[:MAX_STOPS]], [], sender),
                lambda: ([[b"", 0]], [2**53, [], {}], "x" * 100),
                lambda: ([], [b"x" * 16] * (MAX_RELEASED + 1), sender),
            ]
        )()
        if self.rng.random() < 0.5 or sender == OUTSIDE:
            self.write(sender, self.rng.choice((msgpack.packb(list(arguments)), b"\xc1", self.rng.randbytes(20))))
        else:
            to = self.rng.choice(NODES)
            if to in self.lives:
                self.deliver(sender, to, arguments).addErrback(_expected)

    # -- invariants -------------------------------------------------------------------------------------------------

    def check(self, what: str) -> None:
        """Check that a robot with a stop that has not been released cannot move."""
        for name in ROBOTS:
            life = self.lives.get(name)
            if life is not None and self.owed[name] and not life.stop_state.is_motion_forbidden:
                raise Violation(f"after {what} {name} may move, although {len(self.owed[name])} stops are not released")

    def step(self) -> None:
        """Run one random event."""
        events = (
            (self.stop, 4),
            (self.release, 3),
            (self.partition, 2),
            (self.restart, 3),
            (self.forget, 2),
            (self.gossip, 6),
            (self.repeat, 3),
            (self.attack, 5),
            (self.revoke, 1),
        )
        [event] = self.rng.choices([each for each, _ in events], [weight for _, weight in events])
        event()
        self.check(event.__name__)
        for name in NODES:
            if self.rng.random() < 0.4:
                self.disks[name].commit()
        self.tick(self.rng.random() * 5.0)
        self.check("a while")

    def tick(self, seconds: float) -> None:
        """Let time pass; let the agents update their stop states."""
        self.clock.advance(seconds)
        for name in ROBOTS:
            if name in self.lives and self.lives[name].stop_state.is_motion_forbidden:
                self.lives[name].stop_state.recheck()

    def end(self) -> None:
        """Restart all nodes, end the attacks, and let an operator release all stops that the devices report."""
        self.sides = dict.fromkeys(TEAM, 0)
        self.revoked.add("thief")
        gone = self.identities[OUTSIDE].public, *(self.identities[name].public for name in self.revoked)
        for _ in range(12):
            self.tick(30.0)
            for name in NODES:
                self.disks[name].commit()
                for owner in gone:
                    self.replicas[name].pop(owner, None)
            for _ in range(8):
                self.gossip()
            operator = self.orderer()
            named = {stop for name in NODES if name in self.lives for stop in self.lives[name].stop_state.stops}
            if operator and named:
                self.lives[operator].stop_state.release(sorted(named), operator, self.contacts()).addErrback(_expected)
            self.check("the end")
        standing = [name for name in ROBOTS if self.lives[name].stop_state.is_motion_forbidden]
        if standing:
            raise Violation(f"{', '.join(standing)} remain stopped after the release")


def run(seed: int, counts: Counter[str]) -> None:
    """Run one sequence; raise ``Violation`` if an invariant is violated."""
    net = Net(seed, counts)
    counts["sequences"] += 1
    for _ in range(STEPS):
        net.step()
    net.end()


def _expected(failure: Failure) -> None:
    failure.trap(EntangledError)


def _is_msgpack(value: bytes | None) -> bool:
    try:
        msgpack.unpackb(value or b"")
    except Exception:  # the decoder raises exceptions of many types on crafted bytes
        return False
    return True


def main() -> int:
    """Run the command; return 1 if a sequence failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.invariants.stops", description=__doc__)
    parser.add_argument("--sequences", type=int, default=10_000, help="number of sequences (default 10000)")
    parser.add_argument(
        "--seed", type=int, default=1, help="first seed; the next sequences use the next seeds (default 1)"
    )
    args = parser.parse_args()
    counts: Counter[str] = Counter()
    failed = 0
    for seed in range(args.seed, args.seed + args.sequences):
        try:
            run(seed, counts)
        except Violation as violation:
            failed += 1
            sys.stdout.write(f"seed {seed}: {violation}\n")
    sys.stdout.write(", ".join(f"{count} {name}" for name, count in counts.items()) + f", {failed} failed\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
