"""Survey: what a node answers when it is asked what it stores and whom it knows.

Nothing is measured for the answer: it is what the node has seen anyway.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

from middleware.entangled.data.store import weight
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.record import hashed_key
from middleware.node import SwarmNode
from middleware.presence import DEVICES
from middleware.tasks import TASKS, group_key, tasks_of

INVENTORY, NETWORK = "device.inventory", "device.network"
NEWEST = 16
"""Records that are listed one by one."""
MAX_CONTACTS = 64
"""Contacts that are told, those heard last."""
HALT = hashed_key("halt")


def answer_survey(node: SwarmNode) -> None:
    """Have ``node`` answer ``device.inventory`` and ``device.network``."""
    node.entangled.endpoint.expose(INVENTORY, lambda peer: inventory(node))
    node.entangled.endpoint.expose(NETWORK, lambda peer: network(node))


def inventory(node: SwarmNode) -> dict[str, Any]:
    """What the store of ``node`` holds: how much of each kind, and its newest records one by one.

    ``newest`` are [kind, name, bytes, lifetime]; ``deleted`` counts the slots that say only that they are empty.
    """
    store = node.store
    kinds = _kinds(node)
    records = store.records()
    held = [(kinds.get(record.key, "other"), record) for record in records if not record.is_tombstone]
    newest = [[kind, record.name, weight(record), record.lifetime] for kind, record in reversed(held[-NEWEST:])]
    usage = store.usage
    return {
        "records": len(held),
        "deleted": len(records) - len(held),
        "bytes": usage.bytes,
        "most_bytes": usage.max_bytes,
        "kinds": dict(Counter(kind for kind, _ in held)),
        "newest": newest,
    }


def network(node: SwarmNode) -> dict[str, Any]:
    """Whom ``node`` knows, how far they are and when they were heard; its traffic; and its newest lookups.

    ``rtt_ms`` is None where nobody was timed yet, ``heard_s`` where nothing was heard.
    """
    overlay, endpoint = node.entangled.overlay, node.entangled.endpoint
    traffic = endpoint.traffic

    def told(contact: Contact) -> dict[str, Any]:
        round_trip, silence = endpoint.round_trip(contact), overlay.silence(contact)
        return {
            "uuid": contact.node_id.hex(),
            "rtt_ms": None if round_trip is None else round(1000 * round_trip, 2),
            "heard_s": round(silence, 2) if math.isfinite(silence) else None,
        }

    contacts = sorted(overlay.contacts(), key=lambda contact: (overlay.silence(contact), contact.node_id))
    return {
        "contacts": [told(contact) for contact in contacts[:MAX_CONTACTS]],
        "known": len(contacts),
        "sent": traffic.get("sent", 0),
        "received": traffic.get("received", 0),
        "lost": sum(endpoint.counters.values()) + traffic.get("unsent", 0),
        "lookups": [
            {
                "key": each.key.hex(),
                "asked": each.asked,
                "hops": each.hops,
                "found": each.found,
                "ms": _ms(each.seconds),
            }
            for each in reversed(overlay.lookups)
        ],
    }


def _ms(seconds: float) -> float:
    return round(1000 * seconds, 1)


def _kinds(node: SwarmNode) -> dict[bytes, str]:
    # Imported by the first who is asked: a node that never is is spared the memory.
    from middleware.verdict import verdicts_key

    tasks = tasks_of(node.store.get(TASKS))
    named = {DEVICES: "devices", TASKS: "tasks", HALT: "halt"}
    return {
        **named,
        **{group_key(task): "bids and results" for task in tasks},
        **{verdicts_key(task): "verdicts" for task in tasks},
    }
