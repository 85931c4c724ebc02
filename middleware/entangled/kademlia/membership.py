"""Join the network, learn all its members, and detect members that appear, fail and return.

Every ping contains a digest of the live members.  When the digests of two nodes differ, each node requests the list of
the other and pings the members that it does not know; a member is added only after authentication.  Therefore all nodes
of a small team know each other, and after a partition the two sides merge through any pair of nodes, even without the
original bootstrap node.

A network of more than ``MAX_MEMBERS`` nodes is too large for complete lists.  There a node only probes its contacts
(``liveness_probe``).
"""

from __future__ import annotations

import random
from collections.abc import Sequence

from twisted.internet.defer import Deferred, DeferredList
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from middleware.entangled.background import Background
from middleware.entangled.bounded import put_bounded
from middleware.entangled.contact import Contact, parse_contact
from middleware.entangled.errors import NoAnswer, NotRunning, Refused
from middleware.entangled.kademlia.alternate_path import AlternatePaths
from middleware.entangled.kademlia.liveness_probe import STEP_S, LivenessProber
from middleware.entangled.kademlia.member_table import MAX_MEMBERS
from middleware.entangled.kademlia.overlay import Overlay, parse_contacts
from middleware.entangled.network.network import Address
from middleware.entangled.wire.endpoint import Endpoint

MIN_PING_INTERVAL_S = 3.0
"""The seconds of silence after which a contact is pinged, in a team of up to ``SMALL_TEAM`` members."""
SMALL_TEAM = 10
MAX_PING_INTERVAL_S = 9.0
REFRESH_INTERVAL_S = 3600.0
"""The seconds after which a bucket without a lookup is refreshed (Kademlia, section 2.3)."""
BACKOFF_S = (0.2, 5.0)
HINT_AFTER = 4
"""After this number of failed tries, the log suggests a diagnosis, once: a node gets no answer if it belongs to another
team."""
MAX_FORMER_ADDRESSES = 32
"""The number of remembered addresses of known nodes and lost contacts, which are tried when no contact is left."""
RETRY_INTERVAL_S = 4.0
"""The seconds before an absent member, or a member that is only known from other nodes, is tried again."""
LARGE_REPORT_S = 60.0
"""The seconds for which a notification that the network is large is valid.  A node that gets no further notification
during this time starts to learn all members again."""
NEWCOMER_DELAY_S = 0.02
"""The seconds that a newcomer waits before it contacts the next few unknown members, so as not to delay the first
reads.  A random delay of up to the same length is added."""
MAX_PARALLEL = 8
"""The number of unknown members that are contacted at the same time.  It is limited because a handshake takes 0.3 ms of
a core on each side.
"""
_LARGE_DIGEST = b"-"
"""The digest of a node in a large network, which has no list of members; it differs from every other digest."""
PAGE_MEMBERS = 20
"""The number of members in one message."""


class Membership:
    """One node's view of the members."""

    _log = Logger()

    def __init__(
        self, overlay: Overlay, endpoint: Endpoint, clock: IReactorTime, rng: random.Random, background: Background
    ) -> None:
        self._overlay = overlay
        self._endpoint = endpoint
        self._clock = clock
        self._rng = rng
        self._background = background
        self._former_addresses: dict[Address, None] = {}
        self._tried_at: dict[bytes, float] = {}
        self._listed_at: dict[bytes, float] = {}
        self._is_rejoining = False
        self._large_until = float("-inf")
        self.prober = LivenessProber(overlay, endpoint, rng, background, self._maintain)
        self._is_joining = False
        self._has_entered = False
        self.alternate_paths = AlternatePaths(overlay, endpoint, clock, rng, background, self._enter)
        endpoint.expose("ping", self._answer_ping, changes=True, idempotent=True)
        endpoint.expose("members", self._answer_members, early=True)
        endpoint.expose("known", self._answer_known, early=True)

    def start(self) -> None:
        """Start to probe the contacts."""
        self._background.every(STEP_S, self._ping_silent)

    async def join(self, known: Sequence[Address], remembered: Sequence[Contact] = ()) -> None:
        """Contact the known nodes, with exponential backoff until one answers.

        ``remembered`` contacts are also tried, but the node waits for them only if there are known nodes, because
        otherwise it may be the first node of its network.  A known address that is this node's own is skipped.
        """
        others, pause, tries = list(known), BACKOFF_S[0], 0
        for contact in remembered:
            self._overlay.members.add_absent(contact, self._clock.seconds())
        addresses = [contact.address for contact in remembered if not contact.address.is_virtual]
        self._former_addresses |= dict.fromkeys([*known, *addresses])
        while others or addresses:
            if await self._contact_any(others, addresses) or self._has_entered:
                return
            if self._background.is_stopped:
                raise NotRunning("the node stopped while it was joining")
            if not others:
                break
            names = ", ".join(map(str, others))
            self._log.info("no answer from {known}; trying again in {s:.1f} s", known=names, s=pause)
            tries += 1
            if tries == HINT_AFTER:
                self._log.warn("no known node admits this node; run: swarm doctor SETTINGS")
            await self._background.sleep(pause * (0.75 + self._rng.random() / 2))
            pause = min(pause * 2, BACKOFF_S[1])
        # While this node waited, another node may have joined through it and reported that the network is large.
        if not self._has_entered and not self._overlay.is_large:
            self._overlay.has_all_members = True

    @property
    def has_entered(self) -> bool:
        """Whether this node has entered the network by a path other than a known node."""
        return self._has_entered

    async def contact_address(self, address: Address) -> bool:
        """Contact the node of the team at ``address``, to merge its network with the network of this node.

        Returns False if the address is this node's own; raises ``NoAnswer``.
        """
        found = await self._endpoint.discover(address)
        if found.node_id == self._overlay.own_id:
            return False
        await self._enter(found)
        return True

    async def lookup_neighbours(self) -> None:
        """Look up this node's id (Kademlia, section 2.3), so that this node and its neighbours learn each other."""
        if not self._overlay.has_all_members:
            await self._background.sleep(self._draw_pause())
        if not self._overlay.has_all_members:
            await self._overlay.lookup(self._overlay.own_id)
        self._overlay.has_found_neighbours = True
        if self._overlay.is_large:
            self._background.fork(self.prober.lookup_neighbours())

    def remember_lost(self, contact: Contact) -> None:
        """Remember the address of a lost contact."""
        self.prober.record_loss()
        if contact.address.is_virtual:
            return
        put_bounded(self._former_addresses, contact.address, None, MAX_FORMER_ADDRESSES)

    def forget(self, contact: Contact) -> None:
        """Do not try the address of ``contact`` again."""
        self._former_addresses.pop(contact.address, None)

    # -- private ----------------------------------------------------------------------------------------------------

    async def _contact_any(self, known: list[Address], remembered: Sequence[Address]) -> bool:
        """Return whether any of the addresses answers; delete this node's own addresses from ``known``."""
        addresses = list(dict.fromkeys([*known, *remembered]))
        greetings = await DeferredList([self._endpoint.discover(address) for address in addresses], consumeErrors=True)
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
        self._has_entered = True

    async def _ping(self, contact: Contact) -> None:
        # A node that does not know all members has no list to compare.
        digest = self._overlay.members.digest() if self._overlay.has_all_members else b""
        answer = await self._overlay.ask(contact, "ping", digest, changes=True)
        if answer == b"" and not self._overlay.has_found_neighbours and not self._overlay.has_all_members:
            # the network is large; how long this is valid is requested after this node has found its neighbours
            self._set_large(0.0)
        self._compare(contact, _LARGE_DIGEST if answer == b"" else answer)

    def _compare(self, contact: Contact, digest: object) -> None:
        """Request the members of ``contact`` if its list differs from this node's."""
        now = self._clock.seconds()
        if self._overlay.is_large or not digest or (self._is_joining and not self._overlay.has_all_members):
            return
        if self._overlay.has_all_members and digest == self._overlay.members.digest():
            return
        if now - self._listed_at.get(contact.node_id, -RETRY_INTERVAL_S) < RETRY_INTERVAL_S:
            return
        if len(self._listed_at) > 4 * MAX_MEMBERS:
            self._listed_at.clear()
        self._listed_at[contact.node_id] = now
        self._background.fork(
            self._fetch_members(contact) if self._overlay.has_all_members else self._fetch_first_members(contact)
        )

    async def _fetch_first_members(self, contact: Contact) -> None:
        """Contact the members of the network that was just joined, after a delay for the first reads of other nodes.

        Until then a newcomer has no vote, so an unanswered request is repeated, if possible to a different member.
        """
        self._is_joining = True
        try:
            while not self._background.is_stopped:
                await self._background.sleep(self._draw_pause())
                try:
                    return await self._fetch_members(contact)
                except NoAnswer:
                    live = self._overlay.members.list_live()
                    if not live:
                        return  # the next contact is asked instead
                    contact = live[self._rng.randrange(len(live))]
        finally:
            self._is_joining = False

    def _draw_pause(self) -> float:
        return NEWCOMER_DELAY_S * (1 + self._rng.random())

    async def _fetch_members(self, contact: Contact) -> None:
        """Ping every member that ``contact`` knows and this node does not."""
        after, strangers = b"", []
        for _ in range(1 + MAX_MEMBERS // PAGE_MEMBERS):
            answer = await self._overlay.ask(contact, "members", after, is_light=self._overlay.is_large)
            if answer is None or (type(answer) is int and answer > 0):
                return self._set_large(LARGE_REPORT_S if answer is None else min(float(answer), LARGE_REPORT_S))
            if self._overlay.is_large or type(answer) is int:
                return None  # ``contact`` does not know for how long the network is considered large
            found = parse_contacts(answer)
            for named in found:
                self._overlay.on_named(named, contact)
            strangers += [c for c in found if self._may_try(c)]
            if len(found) < PAGE_MEMBERS:
                break
            after = found[-1].node_id
        for first in range(0, len(strangers), MAX_PARALLEL):
            pings = [
                Deferred.fromCoroutine(self._ping(stranger)) for stranger in strangers[first : first + MAX_PARALLEL]
            ]
            await DeferredList(pings, consumeErrors=True)
            if first + MAX_PARALLEL < len(strangers):
                await self._background.sleep(self._draw_pause())
        if not self._overlay.has_all_members and not self._overlay.members.is_voter:
            await self._count_absent()
        self._overlay.has_all_members = not self._overlay.is_large

    def _set_large(self, seconds: float) -> None:
        """Treat the network as large during the next ``seconds``."""
        self._large_until = max(self._large_until, self._clock.seconds() + seconds)
        if not self._overlay.is_large:
            self._overlay.enter_large_mode()
            if self._overlay.has_found_neighbours:
                self._background.fork(self.prober.lookup_neighbours())

    async def _count_absent(self) -> None:
        """Add the members that other nodes know and this newcomer cannot reach, as absent members.

        Otherwise a newcomer would mistake its side of a partition for the whole team.  A member is added only if more
        than half of the answers contain it, so a malicious node cannot invent members.  The answers of newcomers are
        used only if there are no other answers.  Raises ``NoAnswer`` if no node answers.
        """
        live = self._overlay.members.list_live()[:MAX_PARALLEL]
        requests = [Deferred.fromCoroutine(self._overlay.ask(contact, "known")) for contact in live]
        answers = await DeferredList(requests, consumeErrors=True)
        answers_by_id: dict[bytes, dict[Contact, int]] = {}
        for contact, (ok, answer) in zip(live, answers, strict=True):
            if ok or not answer.check(NoAnswer):  # a node that rejects the request does not vote
                answers_by_id[contact.node_id] = _decode_known(answer)
        if live and not answers_by_id:
            raise NoAnswer("no member sent its list of members; try again later")
        settled = [opinion for own, opinion in answers_by_id.items() if any(named.node_id == own for named in opinion)]
        opinions = settled or list(answers_by_id.values())
        for contact in dict.fromkeys(contact for opinion in opinions for contact in opinion):
            named = [opinion[contact] for opinion in opinions if contact in opinion]
            if 2 * len(named) > len(opinions) and contact.node_id != self._overlay.own_id:
                self._overlay.members.add_absent(contact, self._clock.seconds() - max(named))

    def _may_try(self, contact: Contact) -> bool:
        if contact.node_id == self._overlay.own_id or self._overlay.members.get(contact.node_id) is not None:
            return False
        now = self._clock.seconds()
        if now - self._tried_at.get(contact.node_id, -RETRY_INTERVAL_S) < RETRY_INTERVAL_S:
            return False
        if len(self._tried_at) > 4 * MAX_MEMBERS:
            self._tried_at.clear()
        self._tried_at[contact.node_id] = now
        return True

    async def _rejoin(self) -> None:
        """Try the remembered addresses, because a node loses all its contacts in a radio failure."""
        self._is_rejoining = True
        try:
            if await self._contact_any([], list(self._former_addresses)) or await self.alternate_paths.try_once():
                await self._overlay.lookup(self._overlay.own_id)
        finally:
            self._is_rejoining = False

    async def _check_absent(self, contact: Contact) -> None:
        """Check by a discovery request, cheaper than a handshake, whether an absent member answers at its address."""
        found = await self._endpoint.discover(contact.address)
        if found.node_id != self._overlay.own_id:
            await self._ping(found)

    def _ping_silent(self) -> None:
        overlay, now = self._overlay, self._clock.seconds()
        if overlay.is_large and self.prober.step(now):
            return
        overlay.members.remove_expired(now)
        contacts = overlay.contacts()
        if not contacts and (self._former_addresses or self.alternate_paths.is_configured) and not self._is_rejoining:
            self._background.fork(self._rejoin())
        # Each pair of n members needs one ping per interval, so the interval grows with n and the total stays constant.
        timeout_s = min(MAX_PING_INTERVAL_S, MIN_PING_INTERVAL_S * max(1.0, len(contacts) / SMALL_TEAM))
        for contact in contacts:
            if overlay.silence(contact) > timeout_s:
                self._background.fork(self._ping(contact))
        absent = [
            c
            for c in overlay.members.list_absent()
            if now - self._tried_at.get(c.node_id, -RETRY_INTERVAL_S) >= RETRY_INTERVAL_S
        ]
        if absent:
            contact = absent[self._rng.randrange(len(absent))]
            self._tried_at[contact.node_id] = now
            self._background.fork(self._check_absent(contact))
        self._refresh(now)

    def _refresh(self, now: float) -> None:
        overlay = self._overlay
        for index in overlay.table.find_stale(now, REFRESH_INTERVAL_S)[:1]:
            target = overlay.table.refresh_target(index, self._rng)
            overlay.table.record_lookup(target, now)
            if not overlay.is_complete:
                self._background.fork(overlay.lookup(target))

    # -- in a large network -----------------------------------------------------------------------------------------

    def _maintain(self, now: float) -> None:
        self._check_large(now)
        self._refresh(now)

    def _check_large(self, now: float) -> None:
        """Check from time to time whether the network is still large, by this node's contacts or by notifications."""
        overlay = self._overlay
        if overlay.is_surely_large:
            self._large_until = now + LARGE_REPORT_S
        elif now > self._large_until + LARGE_REPORT_S:
            overlay.leave_large_mode()
        elif now > self._large_until and (contacts := overlay.contacts()):
            self._background.fork(self._fetch_members(contacts[self._rng.randrange(len(contacts))]))

    def _answer_ping(self, peer: Contact, digest: bytes = b"") -> bytes:
        self._overlay.process_message(peer)
        self._compare(peer, digest)
        return b"" if self._overlay.is_large else self._overlay.members.digest()

    def _answer_known(self, peer: Contact) -> list[object]:
        """Answer KNOWN: return the voters and the seconds of their absence; a newcomer does not include itself."""
        members = self._overlay.members
        known = [(self._overlay.own_contact(), 0.0)] if members.is_voter else []
        return [[contact.pack(), int(away)] for contact, away in known + members.list_voters(self._clock.seconds())]

    def _answer_members(self, peer: Contact, after: bytes) -> list[object] | int | None:
        """Answer MEMBERS: return the page of members after the id ``after``.

        In a large network, return None, or the seconds for which this node still considers the network large.
        """
        if len(after) not in (0, len(peer.node_id)):
            raise Refused("members: the argument must be empty or a node id of 20 bytes")
        overlay = self._overlay
        if overlay.members.is_full or (overlay.is_large and overlay.is_surely_large):
            return None
        if overlay.is_large:
            return max(0, int(self._large_until - self._clock.seconds()))
        later = [c for c in self._overlay.members.list_live() if c.node_id > after]
        return [c.pack() for c in later[:PAGE_MEMBERS]]


def _decode_known(answer: object) -> dict[Contact, int]:
    """Decode an answer to KNOWN: the members and the seconds of their absence; skip invalid items."""
    found: dict[Contact, int] = {}
    for fields in answer[:MAX_MEMBERS] if isinstance(answer, list) else ():
        named, away = fields if isinstance(fields, list) and len(fields) == 2 else (None, None)
        contact = parse_contact(named)
        if contact is not None and type(away) is int and away >= 0:
            found[contact] = away
    return found
