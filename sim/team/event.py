"""Define the events of a run; an event does not say whether it violates an invariant.

``at`` is the time on the simulator's clock, in seconds. A ``place`` is the number of a simulated host, on which nodes
run one after the other; each run of a node is a *life*, and lives are numbered per place. ``task`` is the name of a
task. A request and its answer are separate events with the same ``number``, because other events happen in between.
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
    """The client gave up: the operation may have been executed, or may still be executed.

    ``is_unavailable`` is whether the client got the error that too few replicas are available.
    """

    number: int
    why: str
    is_unavailable: bool = False


# -- nodes --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Born(Event):
    """A life began: a node with this public key, id and address (empty if not needed) started."""

    place: int
    life: int = 0
    public: bytes = b""
    node_id: bytes = b""
    address: str = ""


@dataclass(frozen=True, slots=True)
class Died(Event):
    """A life ended because the node stopped; with ``forgets``, the next node may lack stored data."""

    place: int
    forgets: bool = False


@dataclass(frozen=True, slots=True)
class Settled(Event):
    """All faults have ended, and the repair interval has passed."""


# -- leases and devices -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Assumptions(Event):
    """The assumptions from now on: TTL of leases, clock drift, stopping time of robots, maximum network delay."""

    ttl: float
    drift: float
    stop_time: float
    max_delay: float


@dataclass(frozen=True, slots=True)
class LeaseWon(Event):
    """An agent obtained a lease, with a token that the agent has not held yet."""

    task: str
    place: int
    token: int


@dataclass(frozen=True, slots=True)
class LeaseHeld(Event):
    """``place`` won or renewed a lease; the places ``others`` also hold this lease, each by its own clock."""

    task: str
    place: int
    others: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class CommandSent(Event):
    """An agent sent a command.

    The agent's lease ends at ``ends_at`` by the agent's clock, and at ``true_end`` by an equal clock that was never
    suspended.
    """

    task: str
    place: int
    ends_at: float
    true_end: float


@dataclass(frozen=True, slots=True)
class CommandReceived(Event):
    """The gate of a device accepted or refused a command; without further commands it moves until ``until``."""

    task: str
    place: int
    token: int
    is_accepted: bool
    until: float
    true_end: float


@dataclass(frozen=True, slots=True)
class RobotStopped(Event):
    """An agent stopped its robot; the robot stands still from ``still_at`` on."""

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
    """A command with a higher token than ``above`` must follow within ``within`` seconds after ``since``."""

    task: str
    why: str
    above: int
    since: float
    within: float


# -- tasks and agents ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class FaultFree(Event):
    """This run has no faults and a perfect network; messages reach all nodes within ``within`` seconds."""

    within: float


@dataclass(frozen=True, slots=True)
class ActiveTasks(Event):
    """The tasks on which an agent acts now, and the tasks whose leases it holds."""

    place: int
    acting: tuple[str, ...]
    holding: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class OutcomeStored(Event):
    """A majority of replicas stores the outcome of a task."""

    task: str
    outcome: str


@dataclass(frozen=True, slots=True)
class OutcomeExpired(Event):
    """The record of a task's outcome has expired; the task has ended and may still be listed."""

    task: str


@dataclass(frozen=True, slots=True)
class OpenTask(Event):
    """At the end of the run an agent regards a task as open; ``state`` is the state of the agent in this task."""

    task: str
    place: int
    state: str
    is_listed: bool


class Report(NamedTuple):
    """A report used in a decision: its agent, its age, and its cost (None: the agent cannot do the task)."""

    agent: str
    name: str
    epoch: int
    serial: int
    cost: float | None


@dataclass(frozen=True, slots=True)
class Decided(Event):
    """An agent decided a round from these reports, its own report first; ``basis`` is the whole input."""

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
    """The store of a place has new content in a slot; a store with a new number ``memory`` may lack older content."""

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
    """A node has a contact in its routing table."""

    place: int
    public: bytes
    address: str


@dataclass(frozen=True, slots=True)
class MembersListed(Event):
    """At the end of the run: the ids of the members that a node regards as alive, in the node's order."""

    place: int
    ids: tuple[bytes, ...]


# -- tuples -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class TupleStored(Event):
    """A replica stores a tuple; these council members decide on its taker."""

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
    """The living council members, with their incarnations; a new incarnation has lost the votes of the member."""

    members: tuple[tuple[bytes, bytes], ...]


@dataclass(frozen=True, slots=True)
class AnswerRepeated(Event):
    """A member that had accepted ``taker`` for a tuple answered a further request with ``answer`` (None: invalid)."""

    fields: Hashable
    taker: bytes
    answer: bytes | None


# -- the wire -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class InvalidDatagram(Event):
    """An invalid datagram, which must change nothing, reached a node: digests of its state, and its reactions."""

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
    """A node executed the request ``request``, which is permitted only once per life of the node."""

    place: int
    life: int
    request: int


@dataclass(frozen=True, slots=True)
class UnvalidatedTraffic(Event):
    """At the end of the run: bytes sent to an unvalidated address, and bytes received from this address."""

    sent: int
    received: int


@dataclass(frozen=True, slots=True)
class TableSize(Event):
    """The number of entries in a table of a node, and the limit ``cap`` of the table."""

    place: int
    what: str
    size: int
    cap: int
