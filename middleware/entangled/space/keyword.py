"""Keyword: publish data under a name, and find it by the words of that name.

Each word has an index under a key of its own; an entry is a record in the publisher's own slot, so two who publish
under one word at the same moment both stay.  An entry carries the whole name, so a search for several words reads the
index of one of them.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from twisted.internet.defer import Deferred

from middleware.entangled.background import first
from middleware.entangled.errors import LocalError, NoAnswer, TooLarge
from middleware.entangled.record import MAX_NAME, MAX_VALUE, Record, hashed_key
from middleware.entangled.replication.owner import Stored
from middleware.entangled.replication.watch import Watch
from middleware.entangled.space.peer import Records

MAX_WORDS = 16


class BadName(LocalError):
    """A name or a search has no word, or too many of them."""


@dataclass(frozen=True)
class Match:
    """Something that was published: its name, its publisher's public key, and the data."""

    name: str
    owner: bytes
    data: bytes


def words(text: str) -> list[str]:
    """The different words of ``text`` in their order: runs of letters and digits, without regard to case."""
    folded = unicodedata.normalize("NFKC", text).casefold()
    parted = "".join(letter if letter.isalnum() else " " for letter in folded)
    return list(dict.fromkeys(parted.split()))


def keyword_key(word: str) -> bytes:
    """The key of the index of ``word``."""
    return hashed_key(f"keyword/{word}")


def matches(records: Iterable[Record], wanted: Sequence[str]) -> list[Match]:
    """What ``records`` of an index offer to whoever wants all of the words ``wanted``."""
    return [
        Match(record.name, record.owner, record.value)
        for record in records
        if record.value is not None and set(wanted) <= set(words(record.name))
    ]


class Keywords:
    """Keyword publishing over one node."""

    def __init__(self, node: Records) -> None:
        self._node = node

    def publish(self, name: str, data: bytes) -> Deferred[None]:
        """Publish ``data`` under every word of ``name``, or replace what this node published under that name.

        Raises ``BadName`` and ``TooLarge`` at once; fails with ``NoAnswer`` where the index of some word could not be
        reached (those that could have it).
        """
        if len(data) > MAX_VALUE:
            raise TooLarge(f"{name}: data of {len(data)} bytes; at most {MAX_VALUE} can be published under a name")
        if len(name.encode(errors="replace")) > MAX_NAME:
            raise TooLarge(f"{name}: the name is longer than {MAX_NAME} bytes")
        keys = [keyword_key(word) for word in _checked(name)]
        return Deferred.fromCoroutine(_all(name, [self._node.put(key, name, data) for key in keys]))

    def remove(self, name: str) -> Deferred[None]:
        """Take back what this node published under ``name``; fails as ``publish`` does."""
        keys = [keyword_key(word) for word in _checked(name)]
        return Deferred.fromCoroutine(_all(name, [self._node.remove(key, name) for key in keys]))

    def search(self, keywords: str | Sequence[str]) -> Deferred[list[Match]]:
        """What was published under all of ``keywords`` (several, or one text of them); raises ``BadName``."""
        wanted = _checked(keywords if isinstance(keywords, str) else " ".join(keywords))
        # The longest word is likely the rarest, and its index the shortest to read.
        found = self._node.get(keyword_key(max(wanted, key=len)))
        return found.addCallback(matches, wanted)

    def watch_keyword(self, word: str, changed: Callable[[list[Match]], None]) -> Watch:
        """Call ``changed`` with all matches of ``word`` whenever they differ, until ``stop()`` of what is returned."""
        wanted = _checked(word)
        told: list[Match] = []

        def tell(records: list[Record]) -> None:
            found = matches(records, wanted)
            if found != told:
                told[:] = found
                changed(found)

        return self._node.watch(keyword_key(max(wanted, key=len)), tell)


def _checked(text: str) -> list[str]:
    found = words(text)
    if not 0 < len(found) <= MAX_WORDS:
        raise BadName(f"{text!r} has {len(found)} words; it must have 1 to {MAX_WORDS}")
    return found


async def _all(name: str, work: list[Deferred[Stored]]) -> None:
    done = await first(len(work), [_awaited(one) for one in work])
    if len(done) < len(work):
        raise NoAnswer(f"{name}: the index of {len(work) - len(done)} of its {len(work)} words did not answer")


async def _awaited(work: Deferred[Stored]) -> int:
    return await work
