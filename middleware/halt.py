"""Halt: whether the whole team is to stand, as one word that every node knows and each that acts obeys.

A word is numbered.  The highest number holds, and of two with the same number the one that halts: no clock has a say,
so a node whose clock is behind can stop the team all the same.  It goes to every device at once, and stays as a record
for those that come later or did not hear it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import astuple, dataclass
from typing import Any

import msgpack
from twisted.internet.defer import Deferred, DeferredList

from middleware.entangled.errors import EntangledError, NoAnswer, Refused
from middleware.entangled.kademlia.contact import Contact
from middleware.entangled.node import EntangledNode
from middleware.entangled.record import Record, hashed_key
from middleware.entangled.replication.watch import Watch
from middleware.value import bounded, is_whole

HALT = hashed_key("halt")
SLOT = "halt"
METHOD = "device.halt"
STANDS = "stands"
GOES_ON = "goes on"
NO_ROBOT = "has no robot"
UNHEARD = "did not answer; it stops when it hears of it, or when its lease is over"
TRIES = 3
"""So often a word is said with a higher number, where others turn out to know a higher one."""
MAX_NAME = 64


@dataclass(frozen=True)
class Word:
    """Stop or go on, said by the operator ``by``."""

    count: int = 0
    is_on: bool = False
    by: str = ""

    def packed(self) -> bytes:
        """The value of the word's record."""
        return bounded(bytes(msgpack.packb(astuple(self))))


def word_of(records: list[Record]) -> Word:
    """The word that holds; every node that has the same records finds the same."""
    words = [word for record in records if (word := _word_in(record)) is not None]
    return max(words, key=_rank, default=Word())


class Halt:
    """The word as this node knows it; what acts asks ``is_on`` before it does, and says how it obeys.

    Without a node, nobody halts it.
    """

    def __init__(self, entangled: EntangledNode | None = None) -> None:
        self.word = Word()
        self._entangled = entangled
        self._obeying: list[Callable[[], str]] = []
        self._watch: Watch | None = None
        self.is_known = True
        self._is_asking = False

    @property
    def is_on(self) -> bool:
        """Whether what acts is to stand: the team is halted, or this node came just now and was not told yet."""
        return self.word.is_on or not self.is_known

    @property
    def records(self) -> list[Record]:
        """The words of the team, where they are followed."""
        return [] if self._watch is None else self._watch.records

    def watch(self, obey: Callable[[], str]) -> None:
        """Call ``obey`` when the team is halted and when it is released; it says in a few words what it does then."""
        self._obeying.append(obey)

    def follow(self) -> None:
        """Follow the words of the team; they are in the node's store as well."""
        if self._entangled is not None and self._watch is None:
            self._watch = self._entangled.watch(HALT, self._heard, keep=True)

    def learn(self) -> None:
        """Follow the words, and stand until the network has said which one holds; call it again until it has."""
        if self._entangled is None or self._is_asking or (self._watch is not None and self.is_known):
            return
        self.follow()
        self.is_known, self._is_asking = False, True
        self._entangled.get(HALT).addCallbacks(self._learnt, self._unlearnt)

    def take(self, word: Word) -> str:
        """Obey ``word`` where it outranks what is known; what this node does now, in a few words."""
        if _rank(word) > _rank(self.word):
            self.word = word
        return ", ".join(obey() for obey in self._obeying) or NO_ROBOT

    def order(self, is_on: bool, by: str, contacts: Collection[Contact]) -> Deferred[dict[str, str]]:
        """Halt the team or let it go on; fires with what each of ``contacts`` does, by uuid, in a few words."""
        return Deferred.fromCoroutine(self._order(is_on, by, contacts))

    async def _order(self, is_on: bool, by: str, contacts: Collection[Contact]) -> dict[str, str]:
        assert self._entangled is not None
        for _ in range(TRIES):
            word = Word(self.word.count + 1, is_on, by[:MAX_NAME])
            told = {self._entangled.contact.node_id.hex(): self.take(word)}
            settled: Deferred[None] = Deferred()
            asked = DeferredList([self._tell(contact, word, told, settled) for contact in contacts])
            asked.addCallback(_all_said, settled)
            # Who cannot be told now, or comes later, reads it.
            self._entangled.put(HALT, SLOT, word.packed(), "team").addErrback(_unwritten)
            await settled
            if self.word.is_on == is_on:
                break
        return told

    def _tell(self, contact: Contact, word: Word, told: dict[str, str], settled: Deferred[None]) -> Deferred[None]:
        """Say ``word`` to one; ``settled`` fires at once where it turns out that it has to be said again."""
        assert self._entangled is not None

        def answered(answer: Any) -> None:
            said, *fields = answer if isinstance(answer, list) and answer else [""]
            told[uuid] = said if isinstance(said, str) else ""
            known = _word(fields)
            if known is not None and _rank(known) > _rank(self.word):
                self.take(known)
                if known.is_on != word.is_on:
                    _settle(settled)

        def unanswered(failure: Any) -> None:
            failure.trap(EntangledError)
            told[uuid] = UNHEARD if failure.check(NoAnswer) else failure.getErrorMessage()

        uuid = contact.node_id.hex()
        if contact.node_id == self._entangled.identity.node_id:
            done: Deferred[None] = Deferred()
            done.callback(None)
            return done
        asked = self._entangled.call(contact, METHOD, *astuple(word), changes=True)
        return asked.addCallbacks(answered, unanswered)

    def answer(self, peer: Contact, count: int, is_on: bool, by: str) -> list[object]:
        """Obey what a peer says; what this node does now, and the word that it knows."""
        word = _word([count, is_on, by])
        if word is None:
            raise Refused(f"a word has a number from 0 on and a name of at most {MAX_NAME} characters")
        return [self.take(word), *astuple(self.word)]

    def _heard(self, records: list[Record]) -> None:
        word = word_of(records)
        if _rank(word) > _rank(self.word):
            self.take(word)

    def _learnt(self, records: list[Record]) -> None:
        self.is_known, self._is_asking = True, False
        self.take(word_of(records))

    def _unlearnt(self, failure: Any) -> None:
        """Nobody could tell; who needs to know asks again."""
        failure.trap(EntangledError)
        self._is_asking = False


def answer_halt(entangled: EntangledNode) -> Halt:
    """The halt as the node ``entangled`` knows it, which peers may tell it."""
    halt = Halt(entangled)
    entangled.endpoint.expose(METHOD, halt.answer, changes=True, idempotent=True)
    return halt


def _rank(word: Word) -> tuple[int, bool, str]:
    return word.count, word.is_on, word.by


def _word_in(record: Record) -> Word | None:
    if record.name != SLOT or record.value is None:
        return None
    try:
        return _word(msgpack.unpackb(record.value))
    except Exception:  # the decoder raises many kinds on crafted bytes
        return None


def _word(fields: object) -> Word | None:
    if not isinstance(fields, list) or len(fields) != 3:
        return None
    count, is_on, by = fields
    is_lawful = is_whole(count) and isinstance(is_on, bool) and isinstance(by, str) and len(by) <= MAX_NAME
    return Word(count, is_on, by) if is_lawful else None


def _settle(settled: Deferred[None]) -> None:
    if not settled.called:
        settled.callback(None)


def _all_said(answers: object, settled: Deferred[None]) -> None:
    _settle(settled)


def _unwritten(failure: Any) -> None:
    """Too few hold it just now; its owner brings it to them when they are there."""
    failure.trap(EntangledError)
