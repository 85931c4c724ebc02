"""Join the network, learn all its members, and detect members that appear, fail and return.

Every ping contains a digest of the live members; when two nodes differ, one requests the other's list and pings the
members that it does not know (no member is added without authentication).  So in a small team all nodes know each
other, and after a partition the two sides merge through any pair of nodes, even without the original bootstrap node.

A network of more than ``MAX_MEMBERS`` nodes is too large for that.  There a node probes its contacts (``sounding``).
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
"""The seconds of silence after which a contact is pinged, in a team of up to ``SMALL`` members."""
SMALL = 10
MAX_SILENCE = 9.0
REFRESH = 3600.0
"""The seconds after which a bucket without a lookup is refreshed (Kademlia, section 2.3)."""
BACKOFF = (0.2, 5.0)
HINT_AFTER = 4
"""The failed tries after which the log suggests a diagnosis, once: a node of another team gets no answer at all."""
MAX_FORMER = 32
"""The addresses of known nodes and lost contacts that are tried when no contact is left."""
AGAIN = 4.0
"""The seconds before an absent member, or one that was only named, is tried again."""
LARGE_FOR = 60.0
"""The seconds for which one notification that the network is large is valid.  A node that gets no further one for as
long again starts to learn all members again."""
BREATH = 0.02
"""The seconds that a newcomer waits before it contacts the next few unknown members, so that first reads are not
delayed; up to as much again is added at random."""
AT_ONCE = 8
"""The number of unknown members that are contacted at the same time: a handshake takes 0.3 ms of a core on each side.
"""
_BY_TABLE = b"-"
"""The digest of a node without a list, because its network is large; it differs from every other digest."""
PAGE = 20
"""The number of members in one message."""


class Membership:
    """One node's view of the members."""

    _log = Logger()

    def __init__(
        self, overlay: Overlay, endpoint: Endpoint, clock: IReactorTime, rng: random.Random, chores: Background
    ) -> None:
        self._overlay = overlay
        self._endpoint = endpoint
        self._clock = clock
        self._rng = rng
        self._chores = chores
        self._former_addresses: dict[Address, None] = {}
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
        """Start to probe the contacts."""
        self._chores.every(PROBE, self._probe)

    async def join(self, known: Sequence[Address], remembered: Sequence[Contact] = ()) -> None:
        """Contact the known nodes, with exponential backoff until one answers.

        ``remembered`` contacts are tried too, but waited for only if there are known nodes: otherwise this may be the
        first node of its network.  A known node that turns out to be this node is skipped.
        """
        others, pause, tries = list(known), BACKOFF[0], 0
        for contact in remembered:
            self._overlay.roster.remembered(contact, self._clock.seconds())
        addresses = [contact.address for contact in remembered if not contact.address.is_virtual]
        self._former_addresses |= dict.fromkeys([*known, *addresses])
        while others or addresses:
            if await self._contact_any(others, addresses) or self._is_entered:
                return
            if self._chores.is_stopped:
                raise NotRunning("the node stopped while it was joining")
            if not others:
                break
            names = ", ".join(map(str, others))
            self._log.info("no answer from {known}; trying again in {s:.1f} s", known=names, s=pause)
            tries += 1
            if tries == HINT_AFTER:
                self._log.warn("no known node admits this node; run: swarm doctor SETTINGS")
            await self._chores.sleep(pause * (0.75 + self._rng.random() / 2))
            pause = min(pause * 2, BACKOFF[1])
        # Other nodes may have joined meanwhile and reported that the network is large.
        if not self._is_entered and not self._overlay.is_large:
            self._overlay.is_whole = True

    @property
    def is_entered(self) -> bool:
        """Whether a path other than a known node led into the network."""
        return self._is_entered

    async def meet(self, address: Address) -> bool:
        """Contact the node of the team at ``address``, which merges its network with this node's.

        Returns whether it is another node; raises ``NoAnswer``.
        """
        found = await self._endpoint.greet(address)
        if found.node_id == self._overlay.own_id:
            return False
        await self._enter(found)
        return True

    async def settle(self) -> None:
        """Look up this node's id (Kademlia, section 2.3), so that it learns its neighbours and they learn it."""
        if not self._overlay.is_whole:
            await self._chores.sleep(self._draw_pause())
        if not self._overlay.is_whole:
            await self._overlay.lookup(self._overlay.own_id)
        self._overlay.is_placed = True
        if self._overlay.is_large:
            self._chores.fork(self.sounding.look_around())

    def lost(self, contact: Contact) -> None:
        """Remember the address of a lost contact."""
        self.sounding.lost()
        if contact.address.is_virtual:
            return
        keep(self._former_addresses, contact.address, None, MAX_FORMER)

    def forget(self, contact: Contact) -> None:
        """Do not try the address of ``contact`` again."""
        self._former_addresses.pop(contact.address, None)

    # -- private ----------------------------------------------------------------------------------------------------

    async def _contact_any(self, known: list[Address], remembered: Sequence[Address]) -> bool:
        """Return whether any of the addresses answers; delete from ``known`` the addresses of this node itself."""
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
        """Enter the network through a discovered contact."""
        await self._ping(contact)
        self._is_entered = True

    async def _ping(self, contact: Contact) -> None:
        # Without all members there is no list to compare.
        digest = self._overlay.roster.digest() if self._overlay.is_whole else b""
        answer = await self._overlay.ask(contact, "ping", digest, changes=True)
        if answer == b"" and not self._overlay.is_placed and not self._overlay.is_whole:
            # its network is large; the duration is requested as soon as this node has its neighbours
            self._set_large(0.0)
        self._compare(contact, _BY_TABLE if answer == b"" else answer)

    def _compare(self, contact: Contact, digest: object) -> None:
        """Request the members of ``contact`` if its list differs from this node's."""
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
        self._chores.fork(
            self._fetch_members(contact) if self._overlay.is_whole else self._fetch_first_members(contact)
        )

    async def _fetch_first_members(self, contact: Contact) -> None:
        """Contact the members of the network that was just joined, after a delay for the first reads of other nodes.

        A newcomer has no vote before that, so a request that gets no answer is repeated, to another member if there is
        one.
        """
        self._joining = True
        try:
            while not self._chores.is_stopped:
                await self._chores.sleep(self._draw_pause())
                try:
                    return await self._fetch_members(contact)
                except NoAnswer:
                    live = self._overlay.roster.live()
                    if not live:
                        return  # the next contact will be asked
                    contact = live[self._rng.randrange(len(live))]
        finally:
            self._joining = False

    def _draw_pause(self) -> float:
        return BREATH * (1 + self._rng.random())

    async def _fetch_members(self, contact: Contact) -> None:
        """Ping every member that ``contact`` knows and this node does not."""
        after, strangers = b"", []
        for _ in range(1 + MAX_MEMBERS // PAGE):
            answer = await self._overlay.ask(contact, "members", after, is_light=self._overlay.is_large)
            if answer is None or (type(answer) is int and answer > 0):
                return self._set_large(LARGE_FOR if answer is None else min(float(answer), LARGE_FOR))
            if self._overlay.is_large or type(answer) is int:
                return None  # it has not learned yet that the network is large, or its notification has expired
            found = contacts_of(answer)
            for named in found:
                self._overlay.on_named(named, contact)
            strangers += [c for c in found if self._may_try(c)]
            if len(found) < PAGE:
                break
            after = found[-1].node_id
        for first in range(0, len(strangers), AT_ONCE):
            pings = [Deferred.fromCoroutine(self._ping(stranger)) for stranger in strangers[first : first + AT_ONCE]]
            await DeferredList(pings, consumeErrors=True)
            if first + AT_ONCE < len(strangers):
                await self._chores.sleep(self._draw_pause())
        if not self._overlay.is_whole and not self._overlay.roster.is_settled:
            await self._count_absent()
        self._overlay.is_whole = not self._overlay.is_large

    def _set_large(self, seconds: float) -> None:
        """Treat the network as large during the next ``seconds``."""
        self._large_until = max(self._large_until, self._clock.seconds() + seconds)
        if not self._overlay.is_large:
            self._overlay.grew()
            if self._overlay.is_placed:
                self._chores.fork(self.sounding.look_around())

    async def _count_absent(self) -> None:
        """Count members as absent that others know and this newcomer cannot reach.

        Otherwise a newcomer would take its side of a partition for the whole team.  A member counts only if more than
        half of the answers name it, so a lying node cannot invent members.  The answers of newcomers count only if
        there are no others.  Raises ``NoAnswer`` if no node answers.
        """
        there = self._overlay.roster.live()[:AT_ONCE]
        asked = [Deferred.fromCoroutine(self._overlay.ask(contact, "known")) for contact in there]
        answers = await DeferredList(asked, consumeErrors=True)
        answers_by_id: dict[bytes, dict[Contact, int]] = {}
        for contact, (ok, answer) in zip(there, answers, strict=True):
            if ok or not answer.check(NoAnswer):  # a node that refuses has no opinion
                answers_by_id[contact.node_id] = _decode_known(answer)
        if there and not answers_by_id:
            raise NoAnswer("no member answered with the members that it knows")
        settled = [opinion for own, opinion in answers_by_id.items() if any(named.node_id == own for named in opinion)]
        opinions = settled or list(answers_by_id.values())
        for contact in dict.fromkeys(contact for opinion in opinions for contact in opinion):
            named = [opinion[contact] for opinion in opinions if contact in opinion]
            if 2 * len(named) > len(opinions) and contact.node_id != self._overlay.own_id:
                self._overlay.roster.remembered(contact, self._clock.seconds() - max(named))

    def _may_try(self, contact: Contact) -> bool:
        if contact.node_id == self._overlay.own_id or self._overlay.roster.get(contact.node_id) is not None:
            return False
        now = self._clock.seconds()
        if now - self._tried_at.get(contact.node_id, -AGAIN) < AGAIN:
            return False
        if len(self._tried_at) > 4 * MAX_MEMBERS:
            self._tried_at.clear()
        self._tried_at[contact.node_id] = now
        return True

    async def _rejoin(self) -> None:
        """Try the remembered addresses: a radio failure costs a node all its contacts."""
        self._returning = True
        try:
            if await self._contact_any([], list(self._former_addresses)) or await self.detour.taken():
                await self._overlay.lookup(self._overlay.own_id)
        finally:
            self._returning = False

    async def _check_absent(self, contact: Contact) -> None:
        """Check whether an absent member answers at its address; a discovery request costs a sixth of a handshake."""
        found = await self._endpoint.greet(contact.address)
        if found.node_id != self._overlay.own_id:
            await self._ping(found)

    def _probe(self) -> None:
        overlay, now = self._overlay, self._clock.seconds()
        if overlay.is_large and self.sounding.step(now):
            return
        overlay.roster.strike(now)
        contacts = overlay.contacts()
        if not contacts and (self._former_addresses or self.detour.is_possible) and not self._returning:
            self._chores.fork(self._rejoin())
        # Each pair of n members needs one ping per interval, so the interval grows with n and the total stays constant.
        patience = min(MAX_SILENCE, SILENCE * max(1.0, len(contacts) / SMALL))
        for contact in contacts:
            if overlay.silence(contact) > patience:
                self._chores.fork(self._ping(contact))
        absent = [c for c in overlay.roster.absent() if now - self._tried_at.get(c.node_id, -AGAIN) >= AGAIN]
        if absent:
            contact = absent[self._rng.randrange(len(absent))]
            self._tried_at[contact.node_id] = now
            self._chores.fork(self._check_absent(contact))
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
        self._check_large(now)
        self._refresh(now)

    def _check_large(self, now: float) -> None:
        """Check from time to time whether the network is still large, by this node's contacts or by notifications."""
        overlay = self._overlay
        if overlay.sees_many:
            self._large_until = now + LARGE_FOR
        elif now > self._large_until + LARGE_FOR:
            overlay.shrank()
        elif now > self._large_until and (contacts := overlay.contacts()):
            self._chores.fork(self._fetch_members(contacts[self._rng.randrange(len(contacts))]))

    def _answer_ping(self, peer: Contact, digest: bytes = b"") -> bytes:
        self._overlay.heard(peer)
        self._compare(peer, digest)
        return b"" if self._overlay.is_large else self._overlay.roster.digest()

    def _answer_known(self, peer: Contact) -> list[object]:
        """KNOWN: the settled members, and the seconds of their absence; a newcomer does not include itself."""
        roster = self._overlay.roster
        known = [(self._overlay.me(), 0.0)] if roster.is_settled else []
        return [[contact.packed(), int(away)] for contact, away in known + roster.known(self._clock.seconds())]

    def _answer_members(self, peer: Contact, after: bytes) -> list[object] | int | None:
        """MEMBERS: the next page; None if the network is large, or the seconds for which reports of that are valid."""
        if len(after) not in (0, len(peer.node_id)):
            raise Refused("members: the argument must be empty or a node id of 20 bytes")
        overlay = self._overlay
        if overlay.roster.is_full or (overlay.is_large and overlay.sees_many):
            return None
        if overlay.is_large:
            return max(0, int(self._large_until - self._clock.seconds()))
        later = [c for c in self._overlay.roster.live() if c.node_id > after]
        return [c.packed() for c in later[:PAGE]]


def _decode_known(answer: object) -> dict[Contact, int]:
    """Decode an answer to KNOWN: the members, and the seconds of their absence; invalid items are skipped."""
    found: dict[Contact, int] = {}
    for fields in answer[:MAX_MEMBERS] if isinstance(answer, list) else ():
        named, away = fields if isinstance(fields, list) and len(fields) == 2 else (None, None)
        contact = unpacked(named)
        if contact is not None and type(away) is int and away >= 0:
            found[contact] = away
    return found
