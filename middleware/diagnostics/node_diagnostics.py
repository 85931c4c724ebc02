"""Diagnostics of a node for other nodes: store contents, contacts, traffic and link quality.

A request starts a measurement of the paths to peers; all other data is already present in the node.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

from middleware.directory.prefix import is_place
from middleware.directory.presence import DEVICES
from middleware.entangled.contact import Contact
from middleware.entangled.data.store import count_bytes
from middleware.entangled.identity import derive_node_id
from middleware.entangled.record import hash_key
from middleware.entangled.wire.admission_check import OPEN_TEAM_WARNING
from middleware.node import SwarmNode
from middleware.tasks.task import TASKS, group_key, parse_tasks

INVENTORY_METHOD, NETWORK_METHOD, LINKS_METHOD = "device.inventory", "device.network", "device.links"
MAX_RECORDS = 16
"""Maximum number of records that are listed."""
MAX_CONTACTS = 64
"""Maximum number of contacts that are listed; the contacts with the most recent datagrams come first."""
MAX_REFUSALS = 16
"""Maximum number of refusals that are listed, the newest first."""
MAX_MEMBERS = 256
ENDING_S = 14 * 86_400.0
"""A certificate that ends within this number of seconds is reported as about to expire."""
STOPS_KEY = hash_key("halt")


def expose_diagnostics(node: SwarmNode) -> None:
    """Expose ``device.inventory``, ``device.network`` and ``device.links`` at ``node``."""
    node.entangled.endpoint.expose(INVENTORY_METHOD, lambda peer: describe_store(node))
    node.entangled.endpoint.expose(NETWORK_METHOD, lambda peer: describe_network(node))
    node.entangled.endpoint.expose(LINKS_METHOD, lambda peer: describe_links(node))


def describe_store(node: SwarmNode) -> dict[str, Any]:
    """Return the contents of the store of ``node``: counts by kind, and the newest records.

    Each entry of ``newest`` is [kind, name, bytes, lifetime]; ``deleted`` is the number of tombstones.
    """
    store = node.store
    kinds = _find_kinds(node)
    records = store.records()
    held = [(kinds.get(record.key, "other"), record) for record in records if not record.is_tombstone]
    newest = [
        [kind, record.name, count_bytes(record), record.lifetime] for kind, record in reversed(held[-MAX_RECORDS:])
    ]
    usage = store.usage
    return {
        "records": len(held),
        "deleted": len(records) - len(held),
        "bytes": usage.bytes,
        "most_bytes": usage.max_bytes,
        "kinds": dict(Counter(kind for kind, _ in held)),
        "newest": newest,
    }


def describe_network(node: SwarmNode) -> dict[str, Any]:
    """Return the contacts, the traffic and the recent lookups of ``node``.

    ``rtt_ms`` is the round-trip time of a contact, ``heard_s`` the seconds since its last datagram; None if unknown.
    """
    overlay, endpoint = node.entangled.overlay, node.entangled.endpoint
    traffic = endpoint.traffic

    def describe(contact: Contact) -> dict[str, Any]:
        round_trip, silence = endpoint.round_trip(contact), overlay.silence(contact)
        return {
            "uuid": contact.node_id.hex(),
            "rtt_ms": None if round_trip is None else round(1000 * round_trip, 2),
            "heard_s": round(silence, 2) if math.isfinite(silence) else None,
        }

    contacts = sorted(overlay.contacts(), key=lambda contact: (overlay.silence(contact), contact.node_id))
    return {
        "contacts": [describe(contact) for contact in contacts[:MAX_CONTACTS]],
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
                "ms": _to_ms(each.seconds),
            }
            for each in reversed(overlay.lookups)
        ],
    }


def describe_links(node: SwarmNode) -> dict[str, Any]:
    """Return the links from ``node`` to its peers (as ``LinkMetrics.read``), and the recent refusals.

    A refusal has these fields: ``who`` (the member's name, the beginning of its key, or empty), ``at`` (an address),
    ``side`` as in ``Rejection``, ``code``, ``reason``, ``ago`` (seconds since it last occurred) and ``count``.
    """
    now = node.clock.seconds()
    rejections = node.entangled.endpoint.rejections.list_recent(now)[:MAX_REFUSALS]
    return {
        "links": node.link_metrics.read(),
        "refusals": [
            {
                "who": _find_name(node, each.who),
                "at": each.address,
                "side": each.side,
                "code": each.code,
                "reason": each.reason,
                "ago": round(now - each.last_at, 1),
                "count": each.count,
            }
            for each in rejections
        ],
    }


def describe_team(node: SwarmNode) -> dict[str, Any]:
    """Return the team of ``node``; times are Unix timestamps.

    For an open team, ``unprotected`` describes the missing protection.  For a closed team, ``name`` is its name,
    ``fingerprint`` is the fingerprint that ``swarm doctor`` prints, and ``me`` is the uuid of this node.  ``members``
    contains the members with their roles and the end of their certificates; members whose certificate ends within
    ``ENDING_S`` are first.
    """
    closed = node.team
    if closed is None:
        return {"kind": "open", "unprotected": OPEN_TEAM_WARNING}
    now, me = node.wall(), closed.admission.me
    found = sorted(closed.list_members(), key=lambda each: (each.not_after - now >= ENDING_S, each.name))
    return {
        "kind": "closed",
        "name": closed.membership.team,
        "fingerprint": closed.admission.fingerprint.hex(),
        "me": node.uuid,
        "until": me.not_after,
        "is_renewable": me.is_renewable,
        "is_ending": me.not_after - now < ENDING_S,
        "known": len(found),
        "members": [
            {
                "uuid": derive_node_id(each.public).hex(),
                "name": each.name,
                "roles": list(each.roles),
                "until": each.not_after,
                "is_renewable": each.is_renewable,
                "is_ending": each.not_after - now < ENDING_S,
            }
            for each in found[:MAX_MEMBERS]
        ],
    }


def _find_name(node: SwarmNode, public: bytes) -> str:
    member = node.team.admission.find_member(public) if node.team is not None and public else None
    return public.hex()[:16] if member is None else member.name


def _to_ms(seconds: float) -> float:
    return round(1000 * seconds, 1)


def _find_kinds(node: SwarmNode) -> dict[bytes, str]:
    # Imported on the first request, to save memory.
    from middleware.consensus.decision_record import decision_records_key

    tasks = parse_tasks(node.store.get(TASKS))
    places = {record.key for record in node.store.records() if is_place(record.key, derive_node_id(record.owner))}
    named = {**dict.fromkeys(places, "devices"), DEVICES: "devices", TASKS: "tasks", STOPS_KEY: "halt"}
    return {
        **named,
        **{group_key(task): "bids and results" for task in tasks},
        **{decision_records_key(task): "verdicts" for task in tasks},
    }
