"""Survey: what devices answer when they are asked over the network.

However many look at the network, each device is asked once a second; what it says is not believed to be lawful.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred, DeferredList, maybeDeferred, succeed

from middleware.entangled.errors import EntangledError, Refused
from middleware.entangled.record import Record
from middleware.node import SwarmNode
from middleware.presence import DEVICES, Device, devices_of
from middleware.survey import INVENTORY, NETWORK, inventory, network
from webnode.board import Survey
from webnode.errors import Refusal
from webnode.field import MAX_ENTRIES, Json, count, distance, number, text
from webnode.ground import Ground

PATIENCE_S = 1.2
"""How long a device has to answer; below what the caller of a route waits."""
FRESH_S = 1.0
MAX_ASKED = 64
"""Devices that are asked for the view of the network, in the order of joining."""


def survey(ground: Ground) -> Survey | None:
    """The asker of this node."""
    return TeamSurvey(ground.node, lambda: ground.desk.read(DEVICES))


class TeamSurvey:
    """Asks over ``node``; ``devices`` are the records of those that are here."""

    def __init__(self, node: SwarmNode, devices: Callable[[], list[Record]]) -> None:
        self._node = node
        self._devices = devices
        self._asked_at = float("-inf")
        self._network: Json = None
        self._waiting: list[Deferred[Json]] | None = None

    def network(self) -> Deferred[Json]:
        """Who knows whom, and how far they are; ``silent`` are the uuids of those that did not answer."""
        if self._waiting is None:
            if self._node.clock.seconds() - self._asked_at < FRESH_S:
                return succeed(self._network)
            self._ask_all()
        if self._waiting is None:  # everybody has answered at once
            return succeed(self._network)
        waiter: Deferred[Json] = Deferred(self._waiting.remove)
        self._waiting.append(waiter)
        return waiter

    def inventory(self, uuid: str) -> Deferred[Json]:
        """What a device stores; fails with ``Refusal`` 409 or 504."""
        found = next((pair for pair in devices_of(self._devices()) if pair[0].uuid == uuid), None)
        if found is None:
            raise Refusal("device", "it has left the network", "wait until it is back", 409)
        device, record = found
        return self._ask(device, record, INVENTORY).addCallbacks(_inventory_view, _refused, errbackArgs=(device.name,))

    # -- inside -----------------------------------------------------------------------------------------------------

    def _ask_all(self) -> None:
        pairs = devices_of(self._devices())
        names = {device.uuid: device.name for device, _ in pairs}
        pairs = pairs[:MAX_ASKED]
        self._waiting = []

        def ended(outcomes: list[tuple[bool, Any]]) -> None:
            # In the order of joining, whoever was quicker.
            told = [(device.uuid, outcome) for (device, _), (_, outcome) in zip(pairs, outcomes, strict=True)]
            views = {uuid: _network_view(outcome, names) for uuid, outcome in told if isinstance(outcome, dict)}
            self._network = {"devices": views, "silent": [uuid for uuid, _ in told if uuid not in views]}
            self._asked_at = self._node.clock.seconds()
            waiting, self._waiting = self._waiting or [], None
            for waiter in waiting:
                waiter.callback(self._network)

        asked = [maybeDeferred(self._ask, device, record, NETWORK) for device, record in pairs]
        DeferredList(asked, consumeErrors=True).addCallback(ended)

    def _ask(self, device: Device, record: Record, method: str) -> Deferred[Any]:
        if device.uuid == self._node.uuid:
            return succeed((inventory if method == INVENTORY else network)(self._node))
        contact = self._node.contact_of(record)
        if contact is None:
            raise Refusal("device", f"{device.name} says no address", "wait a moment, then try again", 409)
        return self._node.entangled.endpoint.ask(contact, method, timeout=PATIENCE_S)


def _refused(failure: Any, name: str) -> None:
    failure.trap(EntangledError)
    if failure.check(Refused):
        raise Refusal("device", f"{name} says no: {failure.getErrorMessage()}", "bring it to this version", 409)
    raise Refusal("device", f"{name} did not answer", "wait until it is back, then try again", 504)


def _entries(value: object) -> list[Any]:
    return value[:MAX_ENTRIES] if isinstance(value, list) else []


def _network_view(told: dict[Any, Any], names: dict[str, str]) -> Json:
    contacts = [each for each in _entries(told.get("contacts")) if isinstance(each, dict) and text(each.get("uuid"))]
    lookups = [each for each in _entries(told.get("lookups")) if isinstance(each, dict)]
    return {
        "contacts": [
            {
                "uuid": text(each["uuid"], limit=64),
                "name": names.get(each["uuid"], text(each["uuid"], limit=8)),
                "rtt_ms": distance(each.get("rtt_ms")),
                "heard_s": distance(each.get("heard_s")),
            }
            for each in contacts
        ],
        "known": count(told.get("known")),
        "sent": count(told.get("sent")),
        "received": count(told.get("received")),
        "lost": count(told.get("lost")),
        "lookups": [
            {
                "key": text(each.get("key"), limit=40),
                **{name: count(each.get(name)) for name in ("asked", "hops", "found")},
                "ms": number(each.get("ms")),
            }
            for each in lookups
        ],
    }


def _inventory_view(told: Any) -> Json:
    told = told if isinstance(told, dict) else {}
    kinds = told.get("kinds")
    newest = [each for each in _entries(told.get("newest")) if isinstance(each, list) and len(each) == 4]
    return {
        **{name: count(told.get(name)) for name in ("records", "deleted", "bytes", "most_bytes")},
        "kinds": {text(k): count(v) for k, v in list(kinds.items())[:MAX_ENTRIES]} if isinstance(kinds, dict) else {},
        "newest": [[text(kind), text(name, limit=64), count(size), text(life)] for kind, name, size, life in newest],
    }
