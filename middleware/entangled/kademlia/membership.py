"""Membership: how a node enters the network, hears of all members, and notices who comes, goes and comes back.

Every ping carries a digest of the live members; where two nodes differ, one asks the other for its list and pings whom
it did not know (nobody enters unproved).  So in a small team everybody knows everybody, and after a partition the two
sides find each other again through any pair, whether the node that all joined by is still there or not.
"""

from __future__ import annotations

import random
from collections.abc import Sequence

from twisted.internet.defer import Deferred, DeferredList
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from middleware.entangled.background import Background
from middleware.entangled.errors import NoAnswer, NotRunning, Refused
from middleware.entangled.kademlia.contact import Contact, unpacked
from middleware.entangled.kademlia.overlay import Overlay, contacts_of
from middleware.entangled.kademlia.roster import MAX_MEMBERS
from middleware.entangled.network.network import Address
from middleware.entangled.wire.endpoint import Endpoint

SILENCE = 3.0
"""Seconds without a word after which a contact is asked whether it is still there, in a team of ``SMALL``."""
SMALL = 10
MAX_SILENCE = 9.0
PROBE = 1.0
REFRESH = 3600.0
"""Seconds after which a bucket that nobody searched is refreshed (Kademlia, section 2.3)."""
BACKOFF = (0.2, 5.0)
MAX_FORMER = 32
"""Addresses of known nodes and lost contacts that are tried when nobody is left."""
AGAIN = 4.0
"""Seconds before an absent member, or one that was only named, is tried again."""
LARGE_FOR = 60.0
"""Seconds for which one word that the network is too large to be known whole holds against those who do not see it."""
BREATH = 0.02
"""Seconds that a newcomer lets its first reads, and those of others, have before it meets the next few strangers, and
as much again at most."""
AT_ONCE = 8
"""Strangers that are met at the same time: a handshake takes 0.3 ms of a core on each side."""
PAGE = 20
"""Members in one message."""


class Membership:
    """The comings and goings around one node."""

    _log = Logger()

    def __init__(
        self, overlay: Overlay, endpoint: Endpoint, clock: IReactorTime, rng: random.Random, chores: Background
    ) -> None:
        self._overlay = overlay
        self._endpoint = endpoint
        self._clock = clock
        self._rng = rng
        self._chores = chores
        self._former: dict[Address, None] = {}
        self._tried_at: dict[bytes, float] = {}
        self._listed_at: dict[bytes, float] = {}
        self._returning = False
        self._large_until = float("-inf")
        self._joining = False
        endpoint.expose("ping", self._answer_ping, changes=True, idempotent=True)
        endpoint.expose("members", self._answer_members)
        endpoint.expose("known", self._answer_known)

    def start(self) -> None:
        """Keep the contacts fresh from now on."""
        self._chores.every(PROBE, self._probe)

    async def join(self, known: Sequence[Address], remembered: Sequence[Contact] = ()) -> None:
        """Greet the known nodes, with back-off until one answers.

        ``remembered`` are greeted beside them, and waited for only where there are known nodes: without any, this may
        be the first node of its network.  A known node that turns out to be this one is waited for no longer.
        """
        others, pause = list(known), BACKOFF[0]
        for contact in remembered:
            self._overlay.roster.remembered(contact, self._clock.seconds())
        addresses = [contact.address for contact in remembered]
        self._former |= dict.fromkeys([*known, *addresses])
        while others or addresses:
            if await self._greeted(others, addresses):
                return
            if self._chores.is_stopped:
                raise NotRunning("the node stopped while it was joining")
            if not others:
                break
            names = ", ".join(map(str, others))
            self._log.info("no answer from {known}; trying again in {s:.1f} s", known=names, s=pause)
            await self._chores.sleep(pause * (0.75 + self._rng.random() / 2))
            pause = min(pause * 2, BACKOFF[1])
        self._overlay.is_whole = True

    async def settle(self) -> None:
        """Look up the own id (Kademlia, section 2.3), so that this node knows where it is and is known there."""
        if not self._overlay.is_whole:
            await self._chores.sleep(self._breath())
        if not self._overlay.is_whole:
            await self._overlay.lookup(self._overlay.own_id)
        self._overlay.is_placed = True

    def lost(self, contact: Contact) -> None:
        """Keep in mind where ``contact`` was."""
        self._former.pop(contact.address, None)
        self._former[contact.address] = None
        if len(self._former) > MAX_FORMER:
            del self._former[next(iter(self._former))]

    # -- inside -----------------------------------------------------------------------------------------------------

    async def _greeted(self, known: list[Address], remembered: Sequence[Address]) -> bool:
        """Whether any of them is there; takes those out of ``known`` at which this node itself answers."""
        addresses = list(dict.fromkeys([*known, *remembered]))
        greetings = await DeferredList([self._endpoint.greet(address) for address in addresses], consumeErrors=True)
        found = []
        for address, (ok, contact) in zip(addresses, greetings, strict=True):
            if ok and contact.node_id == self._overlay.own_id:
                known[:] = [other for other in known if other != address]
            elif ok:
                found.append(contact)
        pings = [Deferred.fromCoroutine(self._ping(contact)) for contact in found]
        return any([ok for ok, _ in await DeferredList(pings, consumeErrors=True)])

    async def _ping(self, contact: Contact) -> None:
        # Who does not know all members yet has no list to compare.
        digest = self._overlay.roster.digest() if self._overlay.is_whole else b""
        answer = await self._overlay.ask(contact, "ping", digest, changes=True)
        self._compare(contact, answer)

    def _compare(self, contact: Contact, digest: object) -> None:
        """Ask ``contact`` for its members where it knows others than this node does."""
        now = self._clock.seconds()
        if now < self._large_until or not digest or (self._joining and not self._overlay.is_whole):
            return
        if self._overlay.is_whole and digest == self._overlay.roster.digest():
            return
        if now - self._listed_at.get(contact.node_id, -AGAIN) < AGAIN:
            return
        if len(self._listed_at) > 4 * MAX_MEMBERS:
            self._listed_at.clear()
        self._listed_at[contact.node_id] = now
        self._chores.fork(self._list(contact) if self._overlay.is_whole else self._first_list(contact))

    async def _first_list(self, contact: Contact) -> None:
        """Meet the members of the network that was just joined, after a moment for those who wait for a first read.

        A newcomer has no say before it has met them: whom the question does not reach is asked again, or another.
        """
        self._joining = True
        try:
            while not self._chores.is_stopped:
                await self._chores.sleep(self._breath())
                try:
                    return await self._list(contact)
                except NoAnswer:
                    there = self._overlay.roster.live()
                    if not there:
                        return  # who greets next is asked
                    contact = there[self._rng.randrange(len(there))]
        finally:
            self._joining = False

    def _breath(self) -> float:
        return BREATH * (1 + self._rng.random())

    async def _list(self, contact: Contact) -> None:
        """Ping everybody whom ``contact`` knows and this node does not."""
        after, strangers = b"", []
        for _ in range(1 + MAX_MEMBERS // PAGE):
            answer = await self._overlay.ask(contact, "members", after)
            if answer is None:
                self._large_until = self._clock.seconds() + LARGE_FOR
                self._overlay.is_whole, self._overlay.is_large = False, True
                return
            found = contacts_of(answer)
            strangers += [c for c in found if self._is_worth_a_try(c)]
            if len(found) < PAGE:
                break
            after = found[-1].node_id
        for first in range(0, len(strangers), AT_ONCE):
            pings = [Deferred.fromCoroutine(self._ping(stranger)) for stranger in strangers[first : first + AT_ONCE]]
            await DeferredList(pings, consumeErrors=True)
            if first + AT_ONCE < len(strangers):
                await self._chores.sleep(self._breath())
        if not self._overlay.is_whole and not self._overlay.roster.is_settled:
            await self._count_absent()
        self._overlay.is_whole = self._clock.seconds() > self._large_until
        self._overlay.is_large = not self._overlay.is_whole

    async def _count_absent(self) -> None:
        """Count as absent whom others know and this newcomer cannot reach, or it would take its side of a cut for all.

        Nobody is counted whom no more than half of those asked name: one that lies makes no members up.
        """
        asked = [self._overlay.ask(contact, "known") for contact in self._overlay.roster.live()[:AT_ONCE]]
        answers = await DeferredList([Deferred.fromCoroutine(each) for each in asked], consumeErrors=True)
        opinions = [_known_of(answer) for ok, answer in answers if ok and isinstance(answer, list)]
        for contact in dict.fromkeys(contact for opinion in opinions for contact in opinion):
            named = [opinion[contact] for opinion in opinions if contact in opinion]
            if 2 * len(named) > len(opinions) and contact.node_id != self._overlay.own_id:
                self._overlay.roster.remembered(contact, self._clock.seconds() - max(named))

    def _is_worth_a_try(self, contact: Contact) -> bool:
        if contact.node_id == self._overlay.own_id or self._overlay.roster.get(contact.node_id) is not None:
            return False
        now = self._clock.seconds()
        if now - self._tried_at.get(contact.node_id, -AGAIN) < AGAIN:
            return False
        if len(self._tried_at) > 4 * MAX_MEMBERS:
            self._tried_at.clear()
        self._tried_at[contact.node_id] = now
        return True

    async def _return(self) -> None:
        """Look for those that were known once: a radio that was out costs a node all its contacts."""
        self._returning = True
        try:
            if await self._greeted([], list(self._former)):
                await self._overlay.lookup(self._overlay.own_id)
        finally:
            self._returning = False

    async def _seek(self, contact: Contact) -> None:
        """See whether an absent member is back at its address; a greeting costs a sixth of a handshake."""
        found = await self._endpoint.greet(contact.address)
        if found.node_id != self._overlay.own_id:
            await self._ping(found)

    def _probe(self) -> None:
        overlay, now = self._overlay, self._clock.seconds()
        overlay.roster.strike(now)
        contacts = overlay.contacts()
        if not contacts and self._former and not self._returning:
            self._chores.fork(self._return())
        # With n members each pair needs one ping in a while, so the while grows with n: the sum stays what it was.
        patience = min(MAX_SILENCE, SILENCE * max(1.0, len(contacts) / SMALL))
        for contact in contacts:
            if overlay.silence(contact) > patience:
                self._chores.fork(self._ping(contact))
        absent = [c for c in overlay.roster.absent() if now - self._tried_at.get(c.node_id, -AGAIN) >= AGAIN]
        if absent:
            contact = absent[self._rng.randrange(len(absent))]
            self._tried_at[contact.node_id] = now
            self._chores.fork(self._seek(contact))
        for index in overlay.table.stale_buckets(now, REFRESH)[:1]:
            target = overlay.table.refresh_target(index, self._rng)
            overlay.table.searched(target, now)
            if not overlay.is_complete:
                self._chores.fork(overlay.lookup(target))

    def _answer_ping(self, peer: Contact, digest: bytes = b"") -> bytes:
        self._overlay.heard(peer)
        self._compare(peer, digest)
        return self._overlay.roster.digest()

    def _answer_known(self, peer: Contact) -> list[object] | None:
        """KNOWN: the settled members, and for how long each has been absent; a newcomer has nothing to say."""
        if not self._overlay.roster.is_settled:
            return None
        known = [(self._overlay.me(), 0.0), *self._overlay.roster.known(self._clock.seconds())]
        return [[contact.packed(), int(away)] for contact, away in known]

    def _answer_members(self, peer: Contact, after: bytes) -> list[object] | None:
        if len(after) not in (0, len(peer.node_id)):
            raise Refused("members takes nothing or a node id of 20 bytes")
        if self._overlay.roster.is_full:
            return None
        later = [c for c in self._overlay.roster.live() if c.node_id > after]
        return [c.packed() for c in later[:PAGE]]


def _known_of(answer: list[object]) -> dict[Contact, int]:
    """The members in an answer to KNOWN, and the seconds of their absence; what is none is left out."""
    found: dict[Contact, int] = {}
    for fields in answer[:MAX_MEMBERS]:
        named, away = fields if isinstance(fields, list) and len(fields) == 2 else (None, None)
        contact = unpacked(named)
        if contact is not None and type(away) is int and away >= 0:
            found[contact] = away
    return found
