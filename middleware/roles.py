"""Roles: who may call what, and who may write what; one table, which both sides of every call go by.  Pure.

A member has one role or several, and may do what any of them may.  A *device* senses, bids and acts; an *operator*
orders people's wishes; a *viewer* looks on; a *gateway* brings people in, as a web node does, and so may what a device
and an operator may; a *bootstrap* lets newcomers in.  Whatever keeps the network itself together is open to all of
them, for every member carries a part of it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from middleware.entangled.identity import node_id
from middleware.entangled.record import Slot, hashed_key
from middleware.prefix import is_place

DEVICE, OPERATOR, VIEWER, GATEWAY, BOOTSTRAP = "device", "operator", "viewer", "gateway", "bootstrap"
ROLES = (DEVICE, OPERATOR, VIEWER, GATEWAY, BOOTSTRAP)

ALL = frozenset(ROLES)
ACTING = frozenset({DEVICE, GATEWAY})
ORDERING = frozenset({OPERATOR, GATEWAY})
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

KINDS: Mapping[str, frozenset[str]] = {
    PRESENCE: ALL,
    TASKS: ORDERING,
    HALT: ORDERING,
    DEPLOYMENTS: ORDERING,
    SOURCE: ORDERING,
    SIGNED_OUT: frozenset({GATEWAY}),
    MEMBER: ACTING,
    RESULT: ORDERING,
    COUNCIL: WORKING,  # read with the signatures of the council before it only
    ENDED: ACTING,  # read with the signatures of the council that granted the lease only
    ORDER: ORDERING,
    VERDICT: ACTING,
    OTHER: WRITING,
}
_BY_KEY = {hashed_key(kind): kind for kind in (PRESENCE, TASKS, HALT, DEPLOYMENTS, SIGNED_OUT)}
_BY_NAME = frozenset({MEMBER, RESULT, ORDER, VERDICT, SOURCE, COUNCIL, ENDED})


def kind_of(slot: Slot) -> str:
    """What kind of record belongs there: by a key that is fixed, else by the slot's name (up to a ``/``).

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
