"""Query devices over the network for diagnostics.

Each device is queried at most once a second, however many pages ask; replies are not trusted and therefore sanitized.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from twisted.internet.defer import Deferred, DeferredList, maybeDeferred, succeed

from middleware.diagnostics.node_diagnostics import (
    INVENTORY_METHOD,
    LINKS_METHOD,
    NETWORK_METHOD,
    describe_links,
    describe_network,
    describe_store,
    describe_team,
)
from middleware.entangled.control.link_quality import LinkQuality
from middleware.entangled.errors import EntangledError, Refused
from middleware.entangled.nat.path_kind import PATH_KINDS
from middleware.entangled.wire.rejection import SIDES
from middleware.frontend.client import TeamClient
from middleware.node import SwarmNode
from webnode.errors import Refusal
from webnode.sanitize import MAX_ENTRIES, Json, clean_count, clean_distance, clean_number, clean_text

ANSWER_LIMIT_S = 1.2
"""Timeout of a device's reply in seconds; less than the time limit of a route."""
MAX_AGE_S = 1.0
MAX_QUERIED = 64
"""Maximum number of devices queried, in the order of joining."""
LOCAL_QUERIES: dict[str, Callable[[SwarmNode], dict[str, Any]]] = {
    INVENTORY_METHOD: describe_store,
    NETWORK_METHOD: describe_network,
    LINKS_METHOD: describe_links,
}


class Diagnostics:
    """Queries the devices that ``client`` knows; the device of ``node`` is read locally."""

    def __init__(self, node: SwarmNode, client: TeamClient) -> None:
        self._node = node
        self._client = client
        self._queries = {NETWORK_METHOD: _Query(_make_network_view), LINKS_METHOD: _Query(_make_links_view)}

    def query_network(self) -> Deferred[Json]:
        """Fire with each device's contacts and round-trip times; ``silent`` lists devices without a reply."""
        return self._query(NETWORK_METHOD)

    def query_links(self) -> Deferred[Json]:
        """Fire with the path and its quality from each device to the others; ``here`` is the uuid of this node."""
        return self._query(LINKS_METHOD)

    def describe_team(self) -> Json:
        """Return the kind of team, and its members if it is closed."""
        return describe_team(self._node)

    def query_inventory(self, uuid: str) -> Deferred[Json]:
        """Fire with the records that a device stores; fails with ``Refusal`` 409 or 504."""
        device = self._client.view.find_device(uuid)
        if device is None:
            raise Refusal("device", "the device has left the network", "wait until the device is back", 409)
        return self._query_device(uuid, INVENTORY_METHOD).addCallbacks(
            _make_inventory_view, _raise_refusal, errbackArgs=(device.name,)
        )

    # -- inside -----------------------------------------------------------------------------------------------------

    def _query(self, method: str) -> Deferred[Json]:
        """Fire with the replies of all devices, queried at most once in ``MAX_AGE_S``."""
        query = self._queries[method]
        if query.waiting is None:
            if self._node.clock.seconds() - query.ended_at < MAX_AGE_S:
                return succeed(query.reply)
            self._query_all(method, query)
        if query.waiting is None:  # all devices have replied synchronously
            return succeed(query.reply)
        waiter: Deferred[Json] = Deferred(query.waiting.remove)
        query.waiting.append(waiter)
        return waiter

    def _query_all(self, method: str, query: _Query) -> None:
        devices = self._client.view.devices
        names = {device.uuid: device.name for device in devices}
        devices = devices[:MAX_QUERIED]
        query.waiting = []

        def finish(outcomes: list[tuple[bool, Any]]) -> None:
            # In the order of joining, whatever the order of the replies.
            replies = [(device.uuid, outcome) for device, (_, outcome) in zip(devices, outcomes, strict=True)]
            views = {uuid: query.view(outcome, names) for uuid, outcome in replies if isinstance(outcome, dict)}
            silent: list[Json] = [uuid for uuid, _ in replies if uuid not in views]
            query.reply = {"here": self._node.uuid, "devices": views, "silent": silent}
            query.ended_at = self._node.clock.seconds()
            waiting, query.waiting = query.waiting or [], None
            for waiter in waiting:
                waiter.callback(query.reply)

        answers = [maybeDeferred(self._query_device, device.uuid, method) for device in devices]
        DeferredList(answers, consumeErrors=True).addCallback(finish)

    def _query_device(self, uuid: str, method: str) -> Deferred[Any]:
        if uuid == self._node.uuid:
            return succeed(LOCAL_QUERIES[method](self._node))
        return self._client.call(uuid, method, timeout=ANSWER_LIMIT_S)


@dataclass
class _Query:
    """One kind of query to all devices: its sanitizing function, the newest replies, and the callers that wait."""

    view: Callable[[dict[Any, Any], dict[str, str]], Json]
    reply: Json = None
    ended_at: float = float("-inf")
    waiting: list[Deferred[Json]] | None = None


def _raise_refusal(failure: Any, name: str) -> None:
    failure.trap(EntangledError)
    if failure.check(Refused):
        raise Refusal(
            "device", f"{name} refused: {failure.getErrorMessage()}", "update the device to this version", 409
        )
    raise Refusal("device", f"{name} did not answer", "wait until the device is back, then try again", 504)


def _read_list(value: object) -> list[Any]:
    return value[:MAX_ENTRIES] if isinstance(value, list) else []


def _make_network_view(reply: dict[Any, Any], names: dict[str, str]) -> Json:
    contacts = [
        each for each in _read_list(reply.get("contacts")) if isinstance(each, dict) and clean_text(each.get("uuid"))
    ]
    lookups = [each for each in _read_list(reply.get("lookups")) if isinstance(each, dict)]
    return {
        "contacts": [
            {
                "uuid": clean_text(each["uuid"], limit=64),
                "name": names.get(each["uuid"], clean_text(each["uuid"], limit=8)),
                "rtt_ms": clean_distance(each.get("rtt_ms")),
                "heard_s": clean_distance(each.get("heard_s")),
            }
            for each in contacts
        ],
        "known": clean_count(reply.get("known")),
        "sent": clean_count(reply.get("sent")),
        "received": clean_count(reply.get("received")),
        "lost": clean_count(reply.get("lost")),
        "lookups": [
            {
                "key": clean_text(each.get("key"), limit=40),
                **{name: clean_count(each.get(name)) for name in ("asked", "hops", "found")},
                "ms": clean_number(each.get("ms")),
            }
            for each in lookups
        ],
    }


def _make_links_view(reply: dict[Any, Any], names: dict[str, str]) -> Json:
    links = [each for each in _read_list(reply.get("links")) if isinstance(each, dict) and clean_text(each.get("id"))]
    refusals = [each for each in _read_list(reply.get("refusals")) if isinstance(each, dict)]
    return {
        "links": [_make_link_view(each, names) for each in links],
        "refusals": [_make_refusal_view(each) for each in refusals],
    }


def _make_link_view(reply: dict[Any, Any], names: dict[str, str]) -> Json:
    """Return one path and its score, which is None without a measurement."""
    path_kind, by = reply.get("way"), clean_text(reply.get("by"), limit=64)
    loss, round_trip, jitter = (clean_distance(reply.get(name)) for name in ("loss", "round_trip", "jitter"))
    loss = None if loss is None else min(loss, 1.0)
    return {
        "uuid": clean_text(reply["id"], limit=64),
        "name": names.get(reply["id"], clean_text(reply["id"], limit=8)),
        "way": path_kind if path_kind in PATH_KINDS else "none",
        "by": names.get(by, by[:8]),
        "address": clean_text(reply.get("address"), limit=64),
        "for_s": clean_distance(reply.get("for")),
        "score": None if loss is None else LinkQuality(loss, round_trip, jitter, path_kind == "carried").score,
        "loss": loss,
        "rtt_ms": None if round_trip is None else round(1000 * round_trip, 2),
        "jitter_ms": None if jitter is None else round(1000 * jitter, 2),
    }


def _make_refusal_view(reply: dict[Any, Any]) -> Json:
    reason, _, remedy = clean_text(reply.get("reason")).partition("; ")
    side = reply.get("side")
    return {
        "who": clean_text(reply.get("who"), limit=64),
        "at": clean_text(reply.get("at"), limit=64),
        "side": side if side in SIDES else "we",
        "code": clean_text(reply.get("code"), limit=32),
        "why": reason,
        "remedy": remedy,
        "ago_s": clean_number(reply.get("ago")),
        "count": clean_count(reply.get("count"), 1),
    }


def _make_inventory_view(reply: Any) -> Json:
    reply = reply if isinstance(reply, dict) else {}
    kinds = reply.get("kinds")
    newest = [each for each in _read_list(reply.get("newest")) if isinstance(each, list) and len(each) == 4]
    return {
        **{name: clean_count(reply.get(name)) for name in ("records", "deleted", "bytes", "most_bytes")},
        "kinds": {clean_text(k): clean_count(v) for k, v in list(kinds.items())[:MAX_ENTRIES]}
        if isinstance(kinds, dict)
        else {},
        "newest": [
            [clean_text(kind), clean_text(name, limit=64), clean_count(size), clean_text(life)]
            for kind, name, size, life in newest
        ],
    }
