"""Roles: the permissions to call methods and to write records, in one table that both sides of a call use.

A member has one or several roles, and the union of their permissions.  A *device* senses, bids and acts; an *operator*
issues tasks and orders; a *viewer* only reads; a *gateway* (a web node) acts on behalf of people, with the permissions
of device and operator, but cannot push modules; a *bootstrap* node admits newcomers.  Methods that maintain the network
are open to all roles, because every member takes part in it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import NamedTuple

from middleware.directory.prefix import is_place
from middleware.entangled.identity import derive_node_id
from middleware.entangled.record import Slot, hash_key

DEVICE, OPERATOR, VIEWER, GATEWAY, BOOTSTRAP = "device", "operator", "viewer", "gateway", "bootstrap"
ROLES = (DEVICE, OPERATOR, VIEWER, GATEWAY, BOOTSTRAP)

ALL = frozenset(ROLES)
ACTING = frozenset({DEVICE, GATEWAY})
ORDERING = frozenset({OPERATOR, GATEWAY})
PUSHING = frozenset({OPERATOR})
WORKING = ACTING | ORDERING
WRITING = ALL - {VIEWER}

METHODS: Mapping[str, frozenset[str]] = {
    # Overlay network and replication.
    "ping": ALL,
    "find_node": ALL,
    "members": ALL,
    "known": ALL,
    "settled": ALL,
    "store": ALL,  # each record is checked by its kind
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
    # Membership list.
    "roll.tell": ALL,
    "roll.compare": ALL,
    "roll.fetch": ALL,
    "roll.secret": ALL,
    # NAT traversal.
    "reach.introduce": ALL,
    "reach.meet": ALL,
    "reach.seen": ALL,
    # Leases.  Members of a quorum are nodes near the task's key that may call ``lease.freed``.
    "lease.prepare": WORKING,
    "lease.propose": ACTING,
    "lease.release": ACTING,
    "lease.freed": WRITING,  # sent by a quorum
    "lease.close": ACTING,  # under the token that was granted
    "lease.cancel": ORDERING,
    "lease.change": WORKING,
    "lease.install": WORKING,
    # Bids are signed and forwarded by other nodes; the kind of record decides which roles may bid.
    "bid.offer": ALL,
    "bid.announce": ALL,  # sent by a quorum
    "bid.cry": ALL,
    # Devices and operators.
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
"""Roles that may call a method that is not listed in ``METHODS``."""

PRESENCE, TASKS, HALT, DEPLOYMENTS, SIGNED_OUT = "devices", "tasks", "halt", "deployments", "signed-out"
MEMBER, RESULT, ORDER, DECISION_RECORD, SOURCE = "member", "result", "order", "verdict", "source"
COUNCIL, ENDED = "council", "done"
OTHER = "other"

BY_KEY, BY_NAME, REST = "key", "name", "rest"
"""How to recognise the records of a namespace: by a key of that name, by the slot's name up to a ``/``, or because no
other namespace matches."""


class Namespace(NamedTuple):
    """A kind of record: roles whose members may write it, way to recognise it, and purpose.

    ``example`` is a slot, as the text of its key and the slot's name.  Records of a namespace that ``is_lasting`` stay
    at their replicas until they expire even if their owner is revoked, so a revocation does not change the team's
    state.
    """

    roles: frozenset[str]
    by: str
    text: str
    example: tuple[str, str]
    is_lasting: bool = False

    def slot(self, owner: bytes) -> Slot:
        """Return the slot of ``owner`` with the example's key and name."""
        key, name = self.example
        return Slot(hash_key(key), owner, name)


NAMESPACES: Mapping[str, Namespace] = {
    PRESENCE: Namespace(
        ALL, BY_KEY, "the presence of a device, at its own places of the directory", (PRESENCE, "dog1")
    ),
    TASKS: Namespace(ORDERING, BY_KEY, "the tasks of the team", (TASKS, "task7")),
    HALT: Namespace(ORDERING, BY_KEY, "the emergency stop and its release", (HALT, "halt"), is_lasting=True),
    DEPLOYMENTS: Namespace(PUSHING, BY_KEY, "the modules that are pushed to the team", (DEPLOYMENTS, "follow")),
    SIGNED_OUT: Namespace(
        frozenset({GATEWAY}), BY_KEY, "the sessions of the page that ended", (SIGNED_OUT, SIGNED_OUT)
    ),
    SOURCE: Namespace(PUSHING, BY_NAME, "the source of a pushed module", ("source/7", SOURCE)),
    MEMBER: Namespace(ACTING, BY_NAME, "the report of a device in the group of a task", ("task/task7", MEMBER)),
    RESULT: Namespace(ORDERING, BY_NAME, "the result of a task, by an operator", ("task/task7", RESULT)),
    COUNCIL: Namespace(
        WORKING, BY_NAME, "the council of a task, signed by the council before it", ("task/task7", COUNCIL)
    ),
    ENDED: Namespace(
        ACTING, BY_NAME, "the result of a task, signed by the council that granted the lease", ("task/task7", ENDED)
    ),
    ORDER: Namespace(ORDERING, BY_NAME, "an operator's order for a running task", ("task/task7", ORDER)),
    DECISION_RECORD: Namespace(
        ACTING, BY_NAME, "the decision record of an agent", ("task/task7/why", f"{DECISION_RECORD}/1")
    ),
    OTHER: Namespace(WRITING, REST, "tuples, and other records of programs in the DHT", ("group/7", "anything")),
}
"""Each kind of record with the roles that may write it.  If the current certificate of a record's owner does not permit
the record, nodes neither accept, store nor return it."""

KINDS: Mapping[str, frozenset[str]] = {kind: namespace.roles for kind, namespace in NAMESPACES.items()}
_BY_KEY = {hash_key(kind): kind for kind, namespace in NAMESPACES.items() if namespace.by == BY_KEY}
_BY_NAME = frozenset(kind for kind, namespace in NAMESPACES.items() if namespace.by == BY_NAME)


def classify_slot(slot: Slot) -> str:
    """Return the kind of the records in ``slot``: by its key, otherwise by its name up to a ``/``.

    In a large team, devices are listed under many keys (``middleware.directory.prefix``).
    """
    kind = _BY_KEY.get(slot.key)
    if kind is None:
        name = slot.name.partition("/")[0]
        kind = name if name in _BY_NAME else PRESENCE if is_place(slot.key, derive_node_id(slot.owner)) else OTHER
    return kind


def may_call(roles: Collection[str], method: str) -> bool:
    """Return whether a member with these roles may call ``method``."""
    return not METHODS.get(method, OTHER_METHODS).isdisjoint(roles)


def may_store(roles: Collection[str], slot: Slot, name: str = "") -> bool:
    """Return whether a member with these roles may write in its own ``slot``.

    A member with a certificate may publish its presence only under the certificate's ``name``.
    """
    kind = classify_slot(slot)
    is_named = kind != PRESENCE or not name or slot.name == name
    return is_named and not KINDS[kind].isdisjoint(roles)


def is_lasting(slot: Slot) -> bool:
    """Return whether records in ``slot`` stay when their owner is revoked."""
    return NAMESPACES[classify_slot(slot)].is_lasting
