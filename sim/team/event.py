"""Events of a run, as plain facts without judgement.

``at`` is the time on the simulator's clock, in seconds.  A ``place`` hosts nodes one after the other, and numbers their
lives; ``task`` is the name of a task.  A request and its answer are two events with the same ``number``, as other
events happen in between.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import NamedTuple


@dataclass(frozen=True, slots=True)
class Event:
    """An event at the time ``at``."""

    at: float


# -- clients ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Asked(Event):
    """A client started the operation ``what`` ("write", "read", "take", ...) on a ``subject``."""

    number: int
    client: Hashable
    what: str
    subject: Hashable
    argument: object = None


@dataclass(frozen=True, slots=True)
class Answered(Event):
    """The operation ``number`` succeeded with a result."""

    number: int
    result: object = None


@dataclass(frozen=True, slots=True)
class Unanswered(Event):
    """The client gave up: the operation may have been carried out, or may be later.

    ``is_unavailable``: the client was told that too few replicas are available.
    """

    number: int
    why: str
    is_unavailable: bool = False


# -- nodes --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Born(Event):
    """A life began; the node has this public key, id and address (empty if not needed)."""

    place: int
    life: int = 0
    public: bytes = b""
    node_id: bytes = b""
    address: str = ""


@dataclass(frozen=True, slots=True)
class Died(Event):
    """A life ended; ``forgets``: the next life may lack stored data."""

    place: int
    forgets: bool = False


@dataclass(frozen=True, slots=True)
class Settled(Event):
    """All faults have ended, and the repair interval has passed."""


# -- leases and devices -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Assumptions(Event):
    """The assumptions from now on: lease ttl, clock drift, stopping time of robots, maximum network delay."""

    ttl: float
    drift: float
    stop_time: float
    max_delay: float


@dataclass(frozen=True, slots=True)
class LeaseWon(Event):
    """An agent believes that it holds a lease, with a token that is new to it."""

    task: str
    place: int
    token: int


@dataclass(frozen=True, slots=True)
class LeaseHeld(Event):
    """``place`` won or renewed its lease; ``others`` also believe that they hold it, each by its own clock."""

    task: str
    place: int
    others: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class CommandSent(Event):
    """An agent sent a command.

    Its lease ends at ``ends_at`` by its own clock, and at ``true_end`` by an equal clock that was never suspended.
    """

    task: str
    place: int
    ends_at: float
    true_end: float


@dataclass(frozen=True, slots=True)
class CommandReceived(Event):
    """The gate of a device accepted or refused a command; the device moves until ``until`` without a further one."""

    task: str
    place: int
    token: int
    is_accepted: bool
    until: float
    true_end: float


@dataclass(frozen=True, slots=True)
class RobotStopped(Event):
    """An agent stopped its robot, which stands still from ``still_at`` on."""

    task: str
    place: int
    still_at: float


@dataclass(frozen=True, slots=True)
class MajorityReachable(Event):
    """Whether an agent and a majority of a task's council can communicate from now on."""

    task: str
    place: int
    is_reachable: bool


@dataclass(frozen=True, slots=True)
class CommandExpected(Event):
    """A command with a token ``above`` this one must follow within ``within`` seconds after ``since``."""

    task: str
    why: str
    above: int
    since: float
    within: float


# -- tasks and agents ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class FaultFree(Event):
    """This run has no faults and a perfect network; messages reach all nodes ``within`` so many seconds."""

    within: float


@dataclass(frozen=True, slots=True)
class ActiveTasks(Event):
    """The tasks on which an agent acts now, and the tasks whose leases it holds."""

    place: int
    acting: tuple[str, ...]
    holding: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class OutcomeStored(Event):
    """A majority of replicas has the outcome of a task."""

    task: str
    outcome: str


@dataclass(frozen=True, slots=True)
class OutcomeExpired(Event):
    """The record of a task's outcome has expired; the task has ended and may still be listed."""

    task: str


@dataclass(frozen=True, slots=True)
class OpenTask(Event):
    """At the end: an agent regards a task as open, and is in this state of it."""

    task: str
    place: int
    state: str
    is_listed: bool


class Report(NamedTuple):
    """A report used in a decision: its agent, its age, and its cost (None: not able)."""

    agent: str
    name: str
    epoch: int
    serial: int
    cost: float | None


@dataclass(frozen=True, slots=True)
class Decided(Event):
    """An agent decided a round by these reports, its own first; ``basis`` is the whole input."""

    place: int
    group: str
    reports: tuple[Report, ...]
    basis: Hashable
    assigned: str | None
    holder: str | None
    hysteresis: float


# -- records and contacts -----------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Stored(Event):
    """The store of a place has new content in a slot; another ``memory`` may lack content of an older one."""

    place: int
    memory: int
    slot: Hashable
    name: str
    sequence: int
    signature: bytes
    is_durable: bool
    is_genuine: bool


@dataclass(frozen=True, slots=True)
class ContactKnown(Event):
    """A node has a contact in its table."""

    place: int
    public: bytes
    address: str


@dataclass(frozen=True, slots=True)
class MembersListed(Event):
    """At the end: the ids of the members that a node regards as alive, in its order."""

    place: int
    ids: tuple[bytes, ...]


# -- tuples -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class TupleStored(Event):
    """A replica holds a tuple, on which these members decide."""

    mark: Hashable
    fields: Hashable
    council: tuple[bytes, ...]
    incarnations: tuple[bytes, ...]


@dataclass(frozen=True, slots=True)
class VoteAccepted(Event):
    """A council member accepted, under a ballot, that a tuple goes to ``taker``."""

    mark: Hashable
    ballot: Hashable
    taker: bytes
    member: bytes


@dataclass(frozen=True, slots=True)
class LivingMembers(Event):
    """The living members, with their incarnations: a new incarnation has forgotten its votes."""

    members: tuple[tuple[bytes, bytes], ...]


@dataclass(frozen=True, slots=True)
class AnswerRepeated(Event):
    """A member had another request for the tuple that it accepted for ``taker``, and answered this (None: invalid)."""

    fields: Hashable
    taker: bytes
    answer: bytes | None


# -- the wire -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class InvalidDatagram(Event):
    """An invalid datagram, which must change nothing, reached a node: digests of the node's state, and its reaction."""

    place: int
    kind: str
    datagram: bytes
    before: str
    after: str
    raised: str
    logged: str
    answers: tuple[tuple[bool, int], ...]
    """For each datagram sent in response: whether it went to the sender's address, and its size in bytes."""


@dataclass(frozen=True, slots=True)
class RequestExecuted(Event):
    """A node executed the request ``request``, which may happen once per life."""

    place: int
    life: int
    request: int


@dataclass(frozen=True, slots=True)
class UnvalidatedTraffic(Event):
    """At the end: bytes sent to an unvalidated address, and bytes received from it."""

    sent: int
    received: int


@dataclass(frozen=True, slots=True)
class TableSize(Event):
    """The number of entries in a table of a node, and its limit ``cap``."""

    place: int
    what: str
    size: int
    cap: int
