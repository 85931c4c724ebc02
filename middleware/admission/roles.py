"""Roles: who may call what, and who may write what; one table, which both sides of every call go by.  Pure.

A member has one role or several, and may do what any of them may.  A *device* senses, bids and acts; an *operator*
orders people's wishes; a *viewer* looks on; a *gateway* brings people in, as a web node does, and so may what a device
and an operator may; a *bootstrap* lets newcomers in.  Whatever keeps the network itself together is open to all of
them, for every member carries a part of it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NamedTuple

from middleware.directory.prefix import is_place
from middleware.entangled.identity import node_id
from middleware.entangled.record import Slot, hashed_key

DEVICE, OPERATOR, VIEWER, GATEWAY, BOOTSTRAP = "device", "operator", "viewer", "gateway", "bootstrap"
ROLES = (DEVICE, OPERATOR, VIEWER, GATEWAY, BOOTSTRAP)

ALL = frozenset(ROLES)
ACTING = frozenset({DEVICE, GATEWAY})
ORDERING = frozenset({OPERATOR, GATEWAY})
PUSHING = frozenset({OPERATOR})
WORKING = ACTING | ORDERING
WRITING = ALL - {VIEWER}

METHODS: Mapping[str, frozenset[str]] = {
    # The network itself.
    "ping": ALL,
    "find_node": ALL,
    "members": ALL,
    "known": ALL,
    "settled": ALL,
    "store": ALL,  # each record is judged by its kind
    "find_value": ALL,
    "certificates": ALL,
    "cache": ALL,
    "watch": ALL,
    "push": ALL,
    "alive": ALL,
    "missing": ALL,
    "let_go": ALL,
    "goodbye": ALL,
    "digests": ALL,
    "places": ALL,
    "lacking": ALL,
    "fetch": ALL,
    # The tuple space.
    "decree.enrol": ALL,
    "decree.claim": WRITING,
    "decree.confirm": WRITING,
    "decree.release": WRITING,
    # What the operator signed.
    "roll.tell": ALL,
    "roll.compare": ALL,
    "roll.fetch": ALL,
    "roll.secret": ALL,
    # Ways to each other.
    "reach.introduce": ALL,
    "reach.meet": ALL,
    "reach.seen": ALL,
    # The right to act.  Members of a council are nodes near the task's key that may say ``lease.freed``.
    "lease.prepare": WORKING,
    "lease.propose": ACTING,
    "lease.release": ACTING,
    "lease.freed": WRITING,  # the word of a council
    "lease.close": ACTING,  # under the token that was granted
    "lease.cancel": ORDERING,
    "lease.change": WORKING,
    "lease.install": WORKING,
    # Bids are signed and carried by others; who may bid at all is a matter of its kind of record.
    "bid.offer": ALL,
    "bid.announce": ALL,  # the word of a council
    "bid.cry": ALL,
    # Devices and people.
    "device.message": ORDERING,
    "device.disconnect": ORDERING,
    "device.halt": ORDERING,
    "device.settings": ALL,
    "device.tune": ORDERING,
    "device.inventory": ALL,
    "device.network": ALL,
    "device.links": ALL,
    "device.fault": ORDERING,
    "device.faults": ALL,
    "device.assign": ORDERING,
    "stream.open": ALL,
    "stream.part": WORKING,
}
OTHER_METHODS = WORKING
"""Who may call what a program exposes beside these."""

PRESENCE, TASKS, HALT, DEPLOYMENTS, SIGNED_OUT = "devices", "tasks", "halt", "deployments", "signed-out"
MEMBER, RESULT, ORDER, VERDICT, SOURCE = "member", "result", "order", "verdict", "source"
COUNCIL, ENDED = "council", "done"
OTHER = "other"

BY_KEY, BY_NAME, REST = "key", "name", "rest"
"""How the records of a namespace are recognised: by a key of that name, by the slot's name up to a ``/``, or as what is
in none of the others."""


class Namespace(NamedTuple):
    """A kind of record: the roles of the owners that may write it, how it is recognised, and what it is for.

    ``example`` is a slot of it, as the text of its key and the slot's name.  Where it ``lasts``, a record that replicas
    hold when its owner is revoked stays there until it runs out: the team remains in the state in which it was.
    """

    roles: frozenset[str]
    by: str
    text: str
    example: tuple[str, str]
    lasts: bool = False

    def slot(self, owner: bytes) -> Slot:
        """The slot of ``owner`` that the example names."""
        key, name = self.example
        return Slot(hashed_key(key), owner, name)


NAMESPACES: Mapping[str, Namespace] = {
    PRESENCE: Namespace(
        ALL, BY_KEY, "what a device says of itself, at its own places of the directory", (PRESENCE, "dog1")
    ),
    TASKS: Namespace(ORDERING, BY_KEY, "the tasks of the team", (TASKS, "task7")),
    HALT: Namespace(ORDERING, BY_KEY, "the emergency stop and its release", (HALT, "halt"), lasts=True),
    DEPLOYMENTS: Namespace(PUSHING, BY_KEY, "the modules that are pushed to the team", (DEPLOYMENTS, "follow")),
    SIGNED_OUT: Namespace(
        frozenset({GATEWAY}), BY_KEY, "the sessions of the page that ended", (SIGNED_OUT, SIGNED_OUT)
    ),
    SOURCE: Namespace(PUSHING, BY_NAME, "the source of a pushed module", ("source/7", SOURCE)),
    MEMBER: Namespace(ACTING, BY_NAME, "the report of a device in the group of a task", ("task/task7", MEMBER)),
    RESULT: Namespace(ORDERING, BY_NAME, "how a task ended, by an operator", ("task/task7", RESULT)),
    COUNCIL: Namespace(
        WORKING, BY_NAME, "the council of a task, signed by the council before it", ("task/task7", COUNCIL)
    ),
    ENDED: Namespace(
        ACTING, BY_NAME, "how a task ended, signed by the council that granted the lease", ("task/task7", ENDED)
    ),
    ORDER: Namespace(ORDERING, BY_NAME, "what an operator wants of a task under way", ("task/task7", ORDER)),
    VERDICT: Namespace(ACTING, BY_NAME, "why an agent decided as it did", ("task/task7/why", f"{VERDICT}/1")),
    OTHER: Namespace(WRITING, REST, "tuples, and whatever programs keep in the DHT", ("group/7", "anything")),
}
"""Each kind of record, and who may write it.  A record that may not be written by its owner, by the owner's certificate
as it is at present, is neither held nor shown nor believed anywhere."""

KINDS: Mapping[str, frozenset[str]] = {kind: namespace.roles for kind, namespace in NAMESPACES.items()}
_BY_KEY = {hashed_key(kind): kind for kind, namespace in NAMESPACES.items() if namespace.by == BY_KEY}
_BY_NAME = frozenset(kind for kind, namespace in NAMESPACES.items() if namespace.by == BY_NAME)


def kind_of(slot: Slot) -> str:
    """The kind of the records in ``slot``: by a key that is fixed, else by the slot's name (up to a ``/``).

    In a large team a device has a place of its own in the directory (``prefix``).
    """
    kind = _BY_KEY.get(slot.key)
    if kind is None:
        name = slot.name.partition("/")[0]
        kind = name if name in _BY_NAME else PRESENCE if is_place(slot.key, node_id(slot.owner)) else OTHER
    return kind


def may_call(roles: Collection[str], method: str) -> bool:
    """Whether a member with these roles may call ``method``."""
    return not METHODS.get(method, OTHER_METHODS).isdisjoint(roles)


def may_store(roles: Collection[str], slot: Slot, name: str = "") -> bool:
    """Whether a member with these roles may write in ``slot``, which is its own.

    A member announces itself under the ``name`` of its certificate only, where it has one.
    """
    kind = kind_of(slot)
    is_named = kind != PRESENCE or not name or slot.name == name
    return is_named and not KINDS[kind].isdisjoint(roles)


def lasts(slot: Slot) -> bool:
    """Whether what is held in ``slot`` stays when its owner is revoked."""
    return NAMESPACES[kind_of(slot)].lasts
