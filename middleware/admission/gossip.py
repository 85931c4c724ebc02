"""Gossip: how what one member knows of its team comes to all others: told on at once, and compared now and then.

Who learns something new tells it to a few others at random, who do the same (an epidemic); and every few seconds each
member compares its roll with that of one other, so that whoever was cut off, asleep or missed by chance catches up.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Iterator

from twisted.logger import Logger
from twisted.python.failure import Failure

from middleware.admission.roll import DIGEST, Roll, digest_of
from middleware.admission.statement import Entry
from middleware.entangled.background import Background
from middleware.entangled.contact import Contact
from middleware.entangled.errors import EntangledError, Full, RemoteError
from middleware.entangled.wire.endpoint import Endpoint

SPREAD = 8
"""Members that one tells of what is new to it.  More reaches all in fewer steps; fewer costs less."""
COMPARED = 5.0
"""Seconds between two comparisons.  Less catches up sooner after a cut."""
NEWS = 8
"""Entries that are told on at once."""
PAGE = 32
PAGE_BYTES = 65_536 + 16_384


class Gossip:
    """The roll of one node, kept the same as those of the others.

    ``on_new`` is called with each entry that is new here, from wherever it came; ``wall`` is the wall clock.
    """

    _log = Logger()

    def __init__(
        self,
        roll: Roll,
        endpoint: Endpoint,
        contacts: Callable[[], list[Contact]],
        rng: random.Random,
        chores: Background,
        wall: Callable[[], float],
        on_new: Callable[[Entry], None],
    ) -> None:
        self._roll = roll
        self._endpoint = endpoint
        self._contacts = contacts
        self._rng = rng
        self._chores = chores
        self._wall = wall
        self._on_new = on_new
        self._is_full = False
        endpoint.expose("roll.tell", self._answer_tell, changes=True, idempotent=True)
        endpoint.expose("roll.compare", self._answer_compare)
        endpoint.expose("roll.fetch", self._answer_fetch)

    def start(self) -> None:
        """Begin to compare."""
        self._chores.every(COMPARED, self._compare_with_one)

    def add(self, packed: bytes) -> Entry | None:
        """Take in what is known here first, and tell it on; raises as ``Roll.add`` does."""
        entry = self._roll.add(packed, self._wall())
        if entry is not None:
            self._on_new(entry)
            self._spread([packed], ())
        return entry

    def met(self, contact: Contact) -> None:
        """Compare with who is new or back."""
        self._chores.fork(self._compare(contact))

    # -- inside -----------------------------------------------------------------------------------------------------

    def _taken(self, entries: Iterable[object], but: tuple[bytes, ...]) -> None:
        """Take in what another member knows; what is new goes on to others, ``but`` not to those."""
        fresh: list[bytes] = []
        try:
            for packed in entries:
                entry = self._roll.add(packed, self._wall())
                if entry is not None and isinstance(packed, bytes):
                    fresh.append(packed)
                    self._on_new(entry)
        except RemoteError as error:
            self._log.warn("a member tells what is none of this team's: {error}", error=error)
        except Full as error:
            if not self._is_full:
                self._log.warn("{error}", error=error)
            self._is_full = True
        finally:
            # Many at once are new to a newcomer alone; where they are not, the others find out when they compare.
            if len(fresh) <= NEWS:
                self._spread(fresh, but)

    def _spread(self, packed: list[bytes], but: tuple[bytes, ...]) -> None:
        others = [contact for contact in self._contacts() if contact.public not in but]
        for page in _pages(packed):
            for contact in self._rng.sample(others, min(SPREAD, len(others))):
                self._endpoint.ask(contact, "roll.tell", page, changes=True).addErrback(self._untold)

    def _compare_with_one(self) -> None:
        self._roll.expire(self._wall())
        others = self._contacts()
        if others:
            self._chores.fork(self._compare(self._rng.choice(others)))

    async def _compare(self, contact: Contact) -> None:
        answer = await self._endpoint.ask(contact, "roll.compare", self._roll.digest)
        if not isinstance(answer, list):
            return
        theirs = {each for each in answer if isinstance(each, bytes) and len(each) == DIGEST}
        mine = set(self._roll.digests)
        wanted = sorted(theirs - mine)
        while wanted:
            found = await self._endpoint.ask(contact, "roll.fetch", wanted[:PAGE])
            come = {digest_of(each) for each in found if isinstance(each, bytes)} if isinstance(found, list) else set()
            if not come.intersection(wanted):
                break
            self._taken(found, (contact.public,))
            wanted = [each for each in wanted if each not in come]
        for page in _pages(self._roll.packed(sorted(mine - theirs))):
            await self._endpoint.ask(contact, "roll.tell", page, changes=True)

    def _answer_tell(self, peer: Contact, entries: list[object]) -> None:
        self._taken(entries[: PAGE * 2], (peer.public,))

    def _answer_compare(self, peer: Contact, digest: bytes) -> list[bytes] | None:
        self._roll.expire(self._wall())
        return None if digest == self._roll.digest else self._roll.digests

    def _answer_fetch(self, peer: Contact, wanted: list[object]) -> list[bytes]:
        return next(_pages(self._roll.packed(each for each in wanted[:PAGE] if isinstance(each, bytes))), [])

    def _untold(self, failure: Failure) -> None:
        if failure.check(EntangledError) is None:
            self._log.failure("while telling the team who belongs to it", failure)


def _pages(packed: Iterable[bytes]) -> Iterator[list[bytes]]:
    page: list[bytes] = []
    size = 0
    for each in packed:
        if page and (len(page) == PAGE or size + len(each) > PAGE_BYTES):
            yield page
            page, size = [], 0
        page.append(each)
        size += len(each)
    if page:
        yield page
