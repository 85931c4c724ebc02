"""Events: what can happen in a run, as plain facts; no event says whether it was right.

``at`` is the moment on the clock of the world, in seconds.  A ``place`` is where nodes live one after the other, each
life with a number of its own; ``task`` is the name of one.  What a client asked and what came of it are two events with
one ``number``, for between them other things happen.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import NamedTuple


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happened ``at`` a moment."""

    at: float


# -- clients ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Asked(Event):
    """A client began ``what`` ("write", "read", "take", ...) on a ``subject``."""

    number: int
    client: Hashable
    what: str
    subject: Hashable
    argument: object = None


@dataclass(frozen=True, slots=True)
class Answered(Event):
    """What was asked under ``number`` was done, and this is what the client got."""

    number: int
    result: object = None


@dataclass(frozen=True, slots=True)
class Unanswered(Event):
    """The client gave up: what it asked for may have been done, or may be yet.

    ``is_unavailable``: it was told that too few are there.
    """

    number: int
    why: str
    is_unavailable: bool = False


# -- the world ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Born(Event):
    """A life began; the node has this public key, id and address (empty where nobody asks)."""

    place: int
    life: int = 0
    public: bytes = b""
    node_id: bytes = b""
    address: str = ""


@dataclass(frozen=True, slots=True)
class Died(Event):
    """A life ended; ``forgets``: the next one may lack what this one had stored."""

    place: int
    forgets: bool = False


@dataclass(frozen=True, slots=True)
class Settled(Event):
    """All faults are over, and the time in which everything mends itself has passed."""


# -- leases and devices -------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Terms(Event):
    """What is assumed from now on: the ttl, how wrong clocks are, how long robots take to stop, the slowest way."""

    ttl: float
    drift: float
    stop_time: float
    slowest: float


@dataclass(frozen=True, slots=True)
class Won(Event):
    """An agent believes to hold a lease with a token that it did not have before."""

    task: str
    place: int
    token: int


@dataclass(frozen=True, slots=True)
class Held(Event):
    """``place`` won or renewed its lease; ``others`` believe to hold one as well, each by its own clock."""

    task: str
    place: int
    others: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Issued(Event):
    """An agent sent a command.

    Its lease ends at ``ends`` as its clock goes, at ``truly`` on a clock like it that never stood still.
    """

    task: str
    place: int
    ends: float
    truly: float


@dataclass(frozen=True, slots=True)
class Commanded(Event):
    """The gate of a device took a command, or refused it; it moves until ``until`` unless it is told again."""

    task: str
    place: int
    token: int
    is_accepted: bool
    until: float
    truly: float


@dataclass(frozen=True, slots=True)
class Halted(Event):
    """The robot of an agent was told to stop, and stands at ``still``."""

    task: str
    place: int
    still: float


@dataclass(frozen=True, slots=True)
class Reached(Event):
    """Whether an agent and a majority of a task's council hear each other from now on."""

    task: str
    place: int
    is_reached: bool


@dataclass(frozen=True, slots=True)
class Awaited(Event):
    """From now on a command with a token ``above`` is waited for: at most ``within`` seconds after ``since``."""

    task: str
    why: str
    above: int
    since: float
    within: float


# -- tasks and agents ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Calm(Event):
    """This run has no fault and no weather; whatever is said is heard by all ``within`` so many seconds."""

    within: float


@dataclass(frozen=True, slots=True)
class Engaged(Event):
    """The tasks on which an agent acts now, and those whose leases it holds."""

    place: int
    acting: tuple[str, ...]
    holding: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Concluded(Event):
    """A majority has the outcome of a task."""

    task: str
    outcome: str


@dataclass(frozen=True, slots=True)
class Expired(Event):
    """The record of a task's outcome has run out; the task is over and may still be listed."""

    task: str


@dataclass(frozen=True, slots=True)
class Open(Event):
    """At the end: an agent holds a task for one that is not over, and is in this state about it."""

    task: str
    place: int
    state: str
    is_docketed: bool


class Report(NamedTuple):
    """A report that a decision used: whose, how old, and the cost in it (None: it cannot)."""

    agent: str
    name: str
    epoch: int
    serial: int
    cost: float | None


@dataclass(frozen=True, slots=True)
class Decided(Event):
    """An agent decided a round: from these reports, its own first; ``basis`` is all that went into it."""

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
    """The store of a place holds something new in a slot; another ``memory`` may lack what an older one had."""

    place: int
    memory: int
    slot: Hashable
    name: str
    sequence: int
    signature: bytes
    is_lasting: bool
    is_genuine: bool


@dataclass(frozen=True, slots=True)
class Met(Event):
    """A node has a contact in its table."""

    place: int
    public: bytes
    address: str


@dataclass(frozen=True, slots=True)
class Counted(Event):
    """At the end: the ids of the members that a node takes for alive, in their order."""

    place: int
    ids: tuple[bytes, ...]


# -- tuples -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Posted(Event):
    """Some replica holds a tuple, which these members decide about."""

    mark: Hashable
    fields: Hashable
    council: tuple[bytes, ...]
    incarnations: tuple[bytes, ...]


@dataclass(frozen=True, slots=True)
class Voted(Event):
    """A member of its council accepted, under a ballot, that a tuple goes to ``taker``."""

    mark: Hashable
    ballot: Hashable
    taker: bytes
    member: bytes


@dataclass(frozen=True, slots=True)
class Seated(Event):
    """The members that live now, and the incarnation of each: another one has forgotten its votes."""

    members: tuple[tuple[bytes, bytes], ...]


@dataclass(frozen=True, slots=True)
class Repeated(Event):
    """A member was asked again what it accepted for ``taker``, and said this (None: nothing lawful)."""

    fields: Hashable
    taker: bytes
    said: bytes | None


# -- the wire -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Shot(Event):
    """A datagram that must change nothing came to a node: what stands for all that it remembers, and what it did."""

    place: int
    kind: str
    datagram: bytes
    before: str
    after: str
    raised: str
    logged: str
    answers: tuple[tuple[bool, int], ...]
    """Of each datagram that was sent because of it: whether to where it came from, and its size in bytes."""


@dataclass(frozen=True, slots=True)
class Ran(Event):
    """A node ran what was asked of it under ``question``, which may run once in a life."""

    place: int
    life: int
    question: int


@dataclass(frozen=True, slots=True)
class Strange(Event):
    """At the end: the bytes that were sent to an address that proved nothing, and those that came from it."""

    sent: int
    got: int


@dataclass(frozen=True, slots=True)
class Size(Event):
    """A table of a node has so many entries, and may have ``cap``."""

    place: int
    what: str
    size: int
    cap: int
