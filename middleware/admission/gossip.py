"""Gossip of the membership list: epidemic push of new entries, and periodic anti-entropy.

A node that learns a new entry sends it to a few random members, which do the same.  Every few seconds each member
compares its list with the list of another member.  So members that were partitioned or asleep, or that the push did not
reach, catch up.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Iterator

from twisted.logger import Logger
from twisted.python.failure import Failure

from middleware.admission.membership_list import DIGEST_BYTES, MembershipList, compute_digest
from middleware.admission.statement import Entry
from middleware.entangled.background import Background
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError, Full, RemoteError
from middleware.entangled.wire.endpoint import Endpoint

FANOUT = 8
"""Number of members to which a node sends a new entry; a higher number means fewer hops and more traffic."""
COMPARE_INTERVAL_S = 5.0
"""Seconds between two comparisons; with a shorter time, members catch up sooner after a partition."""
MAX_PUSHED_ENTRIES = 8
"""Maximum number of new entries that are pushed together."""
MAX_PAGE_ENTRIES = 32
MAX_PAGE_BYTES = 65_536 + 16_384


class Gossip:
    """Keep the membership list of one node in sync with the other members.

    ``on_new_entry`` is called with each entry that is new to this node; ``wall`` is the wall clock in seconds.
    """

    _log = Logger()

    def __init__(
        self,
        membership_list: MembershipList,
        endpoint: Endpoint,
        contacts: Callable[[], list[Contact]],
        rng: random.Random,
        background: Background,
        wall: Callable[[], float],
        on_new_entry: Callable[[Entry], None],
    ) -> None:
        self._membership_list = membership_list
        self._endpoint = endpoint
        self._contacts = contacts
        self._rng = rng
        self._background = background
        self._wall = wall
        self._on_new_entry = on_new_entry
        self._is_full = False
        endpoint.expose("roll.tell", self._answer_tell, changes=True, idempotent=True)
        endpoint.expose("roll.compare", self._answer_compare)
        endpoint.expose("roll.fetch", self._answer_fetch)

    def start(self) -> None:
        """Start the periodic comparison."""
        self._background.every(COMPARE_INTERVAL_S, self._compare_with_one)

    def add(self, packed: bytes) -> Entry | None:
        """Add an entry that originates at this node, and push it; raises as ``MembershipList.add`` does."""
        entry = self._membership_list.add(packed, self._wall())
        if entry is not None:
            self._on_new_entry(entry)
            self._push([packed], ())
        return entry

    def compare_with(self, contact: Contact) -> None:
        """Compare lists with a contact that is new or has returned."""
        self._background.fork(self._compare(contact))

    # -- implementation ---------------------------------------------------------------------------------------------

    def _add_received(self, entries: Iterable[object], but: tuple[bytes, ...]) -> None:
        """Add entries from another member, and push new ones to members except ``but``."""
        fresh: list[bytes] = []
        try:
            for packed in entries:
                entry = self._membership_list.add(packed, self._wall())
                if entry is not None and isinstance(packed, bytes):
                    fresh.append(packed)
                    self._on_new_entry(entry)
        except RemoteError as error:
            self._log.warn("a member sent an entry that is not valid in this team: {error}", error=error)
        except Full as error:
            if not self._is_full:
                self._log.warn("{error}", error=error)
            self._is_full = True
        finally:
            # Only a newcomer gets many new entries at the same time; in any other case, the remaining members catch up
            # by comparison.
            if len(fresh) <= MAX_PUSHED_ENTRIES:
                self._push(fresh, but)

    def _push(self, packed: list[bytes], but: tuple[bytes, ...]) -> None:
        others = [contact for contact in self._contacts() if contact.public not in but]
        for page in _split_pages(packed):
            for contact in self._rng.sample(others, min(FANOUT, len(others))):
                self._endpoint.ask(contact, "roll.tell", page, changes=True).addErrback(self._log_unexpected)

    def _compare_with_one(self) -> None:
        self._membership_list.expire(self._wall())
        others = self._contacts()
        if others:
            self._background.fork(self._compare(self._rng.choice(others)))

    async def _compare(self, contact: Contact) -> None:
        answer = await self._endpoint.ask(contact, "roll.compare", self._membership_list.digest)
        if not isinstance(answer, list):
            return
        theirs = {each for each in answer if isinstance(each, bytes) and len(each) == DIGEST_BYTES}
        mine = set(self._membership_list.digests)
        wanted = sorted(theirs - mine)
        while wanted:
            found = await self._endpoint.ask(contact, "roll.fetch", wanted[:MAX_PAGE_ENTRIES])
            received = {compute_digest(e) for e in found if isinstance(e, bytes)} if isinstance(found, list) else set()
            if not received.intersection(wanted):
                break
            self._add_received(found, (contact.public,))
            wanted = [each for each in wanted if each not in received]
        for page in _split_pages(self._membership_list.list_packed(sorted(mine - theirs))):
            await self._endpoint.ask(contact, "roll.tell", page, changes=True)

    def _answer_tell(self, peer: Contact, entries: list[object]) -> None:
        self._add_received(entries[: MAX_PAGE_ENTRIES * 2], (peer.public,))

    def _answer_compare(self, peer: Contact, digest: bytes) -> list[bytes] | None:
        self._membership_list.expire(self._wall())
        return None if digest == self._membership_list.digest else self._membership_list.digests

    def _answer_fetch(self, peer: Contact, wanted: list[object]) -> list[bytes]:
        return next(
            _split_pages(
                self._membership_list.list_packed(each for each in wanted[:MAX_PAGE_ENTRIES] if isinstance(each, bytes))
            ),
            [],
        )

    def _log_unexpected(self, failure: Failure) -> None:
        if failure.check(EntangledError) is None:
            self._log.failure("while sending entries of the membership list", failure)


def _split_pages(packed: Iterable[bytes]) -> Iterator[list[bytes]]:
    page: list[bytes] = []
    size = 0
    for each in packed:
        if page and (len(page) == MAX_PAGE_ENTRIES or size + len(each) > MAX_PAGE_BYTES):
            yield page
            page, size = [], 0
        page.append(each)
        size += len(each)
    if page:
        yield page
