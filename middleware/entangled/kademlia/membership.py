"""Membership: how a node enters the network, hears of all members, and notices who comes, goes and comes back.

Every ping carries a digest of the live members; where two nodes differ, one asks the other for its list and pings whom
it did not know (nobody enters unproved).  So in a small team everybody knows everybody, and after a partition the two
sides find each other again through any pair, whether the node that all joined by is still there or not.

A network of more than ``MAX_MEMBERS`` is too large for that.  There a node sounds out its contacts (``sounding``).
"""

from __future__ import annotations

import random
from collections.abc import Sequence

from twisted.internet.defer import Deferred, DeferredList
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from middleware.entangled.background import Background
from middleware.entangled.bounded import keep
from middleware.entangled.contact import Contact, unpacked
from middleware.entangled.errors import NoAnswer, NotRunning, Refused
from middleware.entangled.kademlia.detour import Detour
from middleware.entangled.kademlia.overlay import Overlay, contacts_of
from middleware.entangled.kademlia.roster import MAX_MEMBERS
from middleware.entangled.kademlia.sounding import PROBE, Sounding
from middleware.entangled.network.network import Address
from middleware.entangled.wire.endpoint import Endpoint

SILENCE = 3.0
"""Seconds without a word after which a contact is asked whether it is still there, in a team of ``SMALL``."""
SMALL = 10
MAX_SILENCE = 9.0
REFRESH = 3600.0
"""Seconds after which a bucket that nobody searched is refreshed (Kademlia, section 2.3)."""
BACKOFF = (0.2, 5.0)
HINT_AFTER = 4
"""Tries in vain after which a person is told, once, where to look: a node of another team hears no answer at all."""
MAX_FORMER = 32
"""Addresses of known nodes and lost contacts that are tried when nobody is left."""
AGAIN = 4.0
"""Seconds before an absent member, or one that was only named, is tried again."""
LARGE_FOR = 60.0
"""Seconds for which one word that the network is too large to be known whole holds against those who do not see it.
Who hears no such word for as long again begins to know the members anew."""
BREATH = 0.02
"""Seconds that a newcomer lets its first reads, and those of others, have before it meets the next few strangers, and
as much again at most."""
AT_ONCE = 8
"""Strangers that are met at the same time: a handshake takes 0.3 ms of a core on each side."""
_BY_TABLE = b"-"
"""Stands for the digest of who has none, since it goes by its table: nobody's list is like it."""
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
        self.sounding = Sounding(overlay, endpoint, rng, chores, self._keep_up)
        self._joining = False
        self._is_entered = False
        self.detour = Detour(overlay, endpoint, clock, rng, chores, self._enter)
        endpoint.expose("ping", self._answer_ping, changes=True, idempotent=True)
        endpoint.expose("members", self._answer_members, early=True)
        endpoint.expose("known", self._answer_known, early=True)

    def start(self) -> None:
        """Keep the contacts fresh from now on."""
        self._chores.every(PROBE, self._probe)

    async def join(self, known: Sequence[Address], remembered: Sequence[Contact] = ()) -> None:
        """Greet the known nodes, with back-off until one answers.

        ``remembered`` are greeted beside them, and waited for only where there are known nodes: without any, this may
        be the first node of its network.  A known node that turns out to be this one is waited for no longer.
        """
        others, pause, tries = list(known), BACKOFF[0], 0
        for contact in remembered:
            self._overlay.roster.remembered(contact, self._clock.seconds())
        addresses = [contact.address for contact in remembered if not contact.address.is_virtual]
        self._former |= dict.fromkeys([*known, *addresses])
        while others or addresses:
            if await self._greeted(others, addresses) or self._is_entered:
                return
            if self._chores.is_stopped:
                raise NotRunning("the node stopped while it was joining")
            if not others:
                break
            names = ", ".join(map(str, others))
            self._log.info("no answer from {known}; trying again in {s:.1f} s", known=names, s=pause)
            tries += 1
            if tries == HINT_AFTER:
                self._log.warn("nobody lets this node in; swarm doctor SETTINGS says why")
            await self._chores.sleep(pause * (0.75 + self._rng.random() / 2))
            pause = min(pause * 2, BACKOFF[1])
        # Others may have come in meanwhile, and said that there are too many.
        if not self._is_entered and not self._overlay.is_large:
            self._overlay.is_whole = True

    @property
    def is_entered(self) -> bool:
        """Whether another way than a known node led into the network."""
        return self._is_entered

    async def meet(self, address: Address) -> bool:
        """Greet whoever of the team is said to listen at ``address``: its network and this node's become one.

        Returns whether it is another node; raises ``NoAnswer``.
        """
        found = await self._endpoint.greet(address)
        if found.node_id == self._overlay.own_id:
            return False
        await self._enter(found)
        return True

    async def settle(self) -> None:
        """Look up the own id (Kademlia, section 2.3), so that this node knows where it is and is known there."""
        if not self._overlay.is_whole:
            await self._chores.sleep(self._breath())
        if not self._overlay.is_whole:
            await self._overlay.lookup(self._overlay.own_id)
        self._overlay.is_placed = True
        if self._overlay.is_large:
            self._chores.fork(self.sounding.look_around())

    def lost(self, contact: Contact) -> None:
        """Keep in mind where ``contact`` was."""
        self.sounding.lost()
        if contact.address.is_virtual:
            return
        keep(self._former, contact.address, None, MAX_FORMER)

    def forget(self, contact: Contact) -> None:
        """Do not look for ``contact`` any more."""
        self._former.pop(contact.address, None)

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

    async def _enter(self, contact: Contact) -> None:
        """Enter the network by whom a detour led to."""
        await self._ping(contact)
        self._is_entered = True

    async def _ping(self, contact: Contact) -> None:
        # Who does not know all members yet has no list to compare.
        digest = self._overlay.roster.digest() if self._overlay.is_whole else b""
        answer = await self._overlay.ask(contact, "ping", digest, changes=True)
        if answer == b"" and not self._overlay.is_placed and not self._overlay.is_whole:
            self._heard_large(0.0)  # it goes by its table; for how long is asked as soon as this node is placed
        self._compare(contact, _BY_TABLE if answer == b"" else answer)

    def _compare(self, contact: Contact, digest: object) -> None:
        """Ask ``contact`` for its members where it knows others than this node does."""
        now = self._clock.seconds()
        if self._overlay.is_large or not digest or (self._joining and not self._overlay.is_whole):
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
            answer = await self._overlay.ask(contact, "members", after, is_light=self._overlay.is_large)
            if answer is None or (type(answer) is int and answer > 0):
                return self._heard_large(LARGE_FOR if answer is None else min(float(answer), LARGE_FOR))
            if self._overlay.is_large or type(answer) is int:
                return None  # of one who has yet to hear it, or whose word is over
            found = contacts_of(answer)
            for named in found:
                self._overlay.on_named(named, contact)
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
        self._overlay.is_whole = not self._overlay.is_large

    def _heard_large(self, seconds: float) -> None:
        """Take it that the network is too large to be known whole, for so many ``seconds``."""
        self._large_until = max(self._large_until, self._clock.seconds() + seconds)
        if not self._overlay.is_large:
            self._overlay.grew()
            if self._overlay.is_placed:
                self._chores.fork(self.sounding.look_around())

    async def _count_absent(self) -> None:
        """Count as absent whom others know and this newcomer cannot reach, or it would take its side of a cut for all.

        Nobody is counted whom no more than half of those asked name: one that lies makes no members up.  What other
        newcomers know counts where nobody else is there.  Raises ``NoAnswer`` where nobody answers any more.
        """
        there = self._overlay.roster.live()[:AT_ONCE]
        asked = [Deferred.fromCoroutine(self._overlay.ask(contact, "known")) for contact in there]
        answers = await DeferredList(asked, consumeErrors=True)
        told: dict[bytes, dict[Contact, int]] = {}
        for contact, (ok, answer) in zip(there, answers, strict=True):
            if ok or not answer.check(NoAnswer):  # who refuses has said that it says nothing
                told[contact.node_id] = _known_of(answer)
        if there and not told:
            raise NoAnswer("nobody says who is known")
        settled = [opinion for own, opinion in told.items() if any(named.node_id == own for named in opinion)]
        opinions = settled or list(told.values())
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
            if await self._greeted([], list(self._former)) or await self.detour.taken():
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
        if overlay.is_large and self.sounding.step(now):
            return
        overlay.roster.strike(now)
        contacts = overlay.contacts()
        if not contacts and (self._former or self.detour.is_possible) and not self._returning:
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
        self._refresh(now)

    def _refresh(self, now: float) -> None:
        overlay = self._overlay
        for index in overlay.table.stale_buckets(now, REFRESH)[:1]:
            target = overlay.table.refresh_target(index, self._rng)
            overlay.table.searched(target, now)
            if not overlay.is_complete:
                self._chores.fork(overlay.lookup(target))

    # -- in a large network -----------------------------------------------------------------------------------------

    def _keep_up(self, now: float) -> None:
        self._look_whether_large(now)
        self._refresh(now)

    def _look_whether_large(self, now: float) -> None:
        """Be sure from time to time that the network is still large, by what is known here or by others' word."""
        overlay = self._overlay
        if overlay.sees_many:
            self._large_until = now + LARGE_FOR
        elif now > self._large_until + LARGE_FOR:
            overlay.shrank()
        elif now > self._large_until and (contacts := overlay.contacts()):
            self._chores.fork(self._list(contacts[self._rng.randrange(len(contacts))]))

    def _answer_ping(self, peer: Contact, digest: bytes = b"") -> bytes:
        self._overlay.heard(peer)
        self._compare(peer, digest)
        return b"" if self._overlay.is_large else self._overlay.roster.digest()

    def _answer_known(self, peer: Contact) -> list[object]:
        """KNOWN: the settled members, and for how long each has been absent; a newcomer is not one of them itself."""
        roster = self._overlay.roster
        known = [(self._overlay.me(), 0.0)] if roster.is_settled else []
        return [[contact.packed(), int(away)] for contact, away in known + roster.known(self._clock.seconds())]

    def _answer_members(self, peer: Contact, after: bytes) -> list[object] | int | None:
        """MEMBERS: the next page of them; None where there are too many, seconds where others said so."""
        if len(after) not in (0, len(peer.node_id)):
            raise Refused("members takes nothing or a node id of 20 bytes")
        overlay = self._overlay
        if overlay.roster.is_full or (overlay.is_large and overlay.sees_many):
            return None
        if overlay.is_large:
            return max(0, int(self._large_until - self._clock.seconds()))
        later = [c for c in self._overlay.roster.live() if c.node_id > after]
        return [c.packed() for c in later[:PAGE]]


def _known_of(answer: object) -> dict[Contact, int]:
    """The members in an answer to KNOWN, and the seconds of their absence; what is none is left out."""
    found: dict[Contact, int] = {}
    for fields in answer[:MAX_MEMBERS] if isinstance(answer, list) else ():
        named, away = fields if isinstance(fields, list) and len(fields) == 2 else (None, None)
        contact = unpacked(named)
        if contact is not None and type(away) is int and away >= 0:
            found[contact] = away
    return found
