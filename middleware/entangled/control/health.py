"""Health: what a running node says of itself and of the ways to its peers, for whoever looks what is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from twisted.internet.defer import Deferred, DeferredList
from twisted.internet.interfaces import IReactorTime
from twisted.internet.task import deferLater

from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError
from middleware.entangled.network.network import is_relayed
from middleware.entangled.node import EntangledNode

ASKED = 10
"""Questions to each peer."""
APART = 0.1
LIMIT = 1.5
MAX_LINKS = 32
"""Peers whose ways are measured: 32 x 10 questions in a second are 50 kB each way."""


def health(node: EntangledNode) -> Mapping[str, Any]:
    """The node's contacts, what its store holds and may hold, and who does not let it in, and why."""
    usage = node.store.usage
    return {
        "id": node.identity.node_id.hex(),
        "address": str(node.contact.address),
        "contacts": len(node.overlay.contacts()),
        "rows": usage.rows,
        "max_rows": usage.max_rows,
        "bytes": usage.bytes,
        "max_bytes": usage.max_bytes,
        "trouble": node.store.trouble,
        "refusals": [[code, str(contact.address)] for contact, code in node.endpoint.refusals.values()],
    }


async def links(node: EntangledNode, clock: IReactorTime) -> list[Mapping[str, Any]]:
    """The way to each peer, and how long it took for each of ``ASKED`` small questions, None where it did not answer.

    All times are seconds; ``for`` says how long the peer is reached that way, None where it is not.
    """
    contacts = sorted(node.overlay.contacts(), key=lambda contact: contact.node_id)[:MAX_LINKS]
    asked = [Deferred.fromCoroutine(_times(node, clock, contact)) for contact in contacts]
    answers = await DeferredList(asked, consumeErrors=True)
    return [
        {**way(node, clock, contact), "times": times}
        for contact, (ok, times) in zip(contacts, answers, strict=True)
        if ok
    ]


def way(node: EntangledNode, clock: IReactorTime, contact: Contact) -> dict[str, Any]:
    """How a peer is reached: ``way`` is a ``passage.Kind``, ``by`` the id of who carries, or empty."""
    passage = node.reach.ways.passage(contact)
    return {
        "id": contact.node_id.hex(),
        "address": str(passage.address or contact.address),
        "way": passage.kind,
        "by": passage.by.hex(),
        "for": None if passage.since is None else round(clock.seconds() - passage.since, 1),
        "relayed": is_relayed(passage.address or contact.address),
    }


async def timed(node: EntangledNode, clock: IReactorTime, contact: Contact) -> float | None:
    """How long a peer takes for one small question, in seconds; None where it does not answer."""
    begun = clock.seconds()
    try:
        await node.call(contact, "ping", b"", timeout=LIMIT, changes=True)
    except EntangledError:
        return None
    return clock.seconds() - begun


async def _times(node: EntangledNode, clock: IReactorTime, contact: Contact) -> list[float | None]:
    await timed(node, clock, contact)  # opens the session, where there is none
    asked = []
    for _ in range(ASKED):
        asked.append(Deferred.fromCoroutine(timed(node, clock, contact)))
        await deferLater(clock, APART)
    return [seconds for _, seconds in await DeferredList(asked, consumeErrors=True)]
