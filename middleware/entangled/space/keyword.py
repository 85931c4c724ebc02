"""Publishing of data under a name, and search by the words of that name.

Each word has an index under its own key; an entry is a record in the publisher's slot, so concurrent publications under
one word do not conflict.  An entry contains the whole name, so a search for several words reads the index of only one
word.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from twisted.internet.defer import Deferred

from middleware.entangled.background import gather_first
from middleware.entangled.errors import LocalError, NoAnswer, TooLarge
from middleware.entangled.record import MAX_NAME_BYTES, MAX_VALUE_BYTES, Record, hash_key
from middleware.entangled.replication.owner import Stored
from middleware.entangled.replication.watch import Watch
from middleware.entangled.space.node_interface import RecordAccess

MAX_WORDS = 16


class BadName(LocalError):
    """A name or a search contains no word or too many words."""


@dataclass(frozen=True)
class Match:
    """One publication: its name, its publisher's public key, and the data."""

    name: str
    owner: bytes
    data: bytes


def words(text: str) -> list[str]:
    """Return the distinct words (runs of letters and digits) of ``text``, in order and case-folded."""
    folded = unicodedata.normalize("NFKC", text).casefold()
    parted = "".join(letter if letter.isalnum() else " " for letter in folded)
    return list(dict.fromkeys(parted.split()))


def keyword_key(word: str) -> bytes:
    """Return the key of the index of ``word``."""
    return hash_key(f"keyword/{word}")


def matches(records: Iterable[Record], wanted: Sequence[str]) -> list[Match]:
    """Return the publications in the index ``records`` whose names contain all words in ``wanted``."""
    return [
        Match(record.name, record.owner, record.value)
        for record in records
        if record.value is not None and set(wanted) <= set(words(record.name))
    ]


class Keywords:
    """Publishing and search by keyword through one node."""

    def __init__(self, node: RecordAccess) -> None:
        self._node = node

    def publish(self, name: str, data: bytes) -> Deferred[None]:
        """Publish ``data`` under every word of ``name``, replacing this node's earlier publication of that name.

        Raises ``BadName`` and ``TooLarge`` immediately.  Fails with ``NoAnswer`` if the index of a word is unreachable;
        the indexes of other words may then contain the entry.
        """
        if len(data) > MAX_VALUE_BYTES:
            raise TooLarge(
                f"{name}: the data has {len(data)} bytes; at most {MAX_VALUE_BYTES} can be published under a name"
            )
        if len(name.encode(errors="replace")) > MAX_NAME_BYTES:
            raise TooLarge(f"{name}: the name has more than {MAX_NAME_BYTES} bytes; shorten it")
        keys = [keyword_key(word) for word in _check_words(name)]
        return Deferred.fromCoroutine(_run_all(name, [self._node.put(key, name, data) for key in keys]))

    def remove(self, name: str) -> Deferred[None]:
        """Remove this node's publication under ``name``; fails as ``publish`` does."""
        keys = [keyword_key(word) for word in _check_words(name)]
        return Deferred.fromCoroutine(_run_all(name, [self._node.remove(key, name) for key in keys]))

    def search(self, keywords: str | Sequence[str]) -> Deferred[list[Match]]:
        """Fire with the publications that contain all ``keywords`` (a string or a sequence); raise ``BadName``."""
        wanted = _check_words(keywords if isinstance(keywords, str) else " ".join(keywords))
        # The longest word is probably the rarest word, and its index the shortest.
        found = self._node.get(keyword_key(max(wanted, key=len)))
        return found.addCallback(matches, wanted)

    def watch_keyword(self, word: str, changed: Callable[[list[Match]], None]) -> Watch:
        """Call ``changed`` with all matches of ``word`` on each change, until ``stop()`` of the returned watch."""
        wanted = _check_words(word)
        reported: list[Match] = []

        def report(records: list[Record]) -> None:
            found = matches(records, wanted)
            if found != reported:
                reported[:] = found
                changed(found)

        return self._node.watch(keyword_key(max(wanted, key=len)), report)


def _check_words(text: str) -> list[str]:
    found = words(text)
    if not 0 < len(found) <= MAX_WORDS:
        raise BadName(f"{text!r} has {len(found)} words; it must have 1 to {MAX_WORDS}")
    return found


async def _run_all(name: str, work: list[Deferred[Stored]]) -> None:
    done = await gather_first(len(work), [_run(each) for each in work])
    if len(done) < len(work):
        raise NoAnswer(
            f"{name}: the indexes of {len(work) - len(done)} of the {len(work)} words did not answer; try again"
        )


async def _run(work: Deferred[Stored]) -> int:
    return await work
