"""Newcomer: the other side of admission: knocks at bootstrap nodes, one after the other, until one answers.

It needs nothing but a code, and an address or two; what it is given becomes the membership that it keeps.
"""

from __future__ import annotations

import random
from collections.abc import Iterable

from nacl import bindings
from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IDelayedCall, IReactorTime

from middleware.admission import knock
from middleware.admission.certificate import member_of
from middleware.admission.code import Code, TermsContent
from middleware.admission.errors import NotWelcome
from middleware.admission.knock import Hint, Welcome
from middleware.admission.membership import Membership
from middleware.entangled.errors import NoAnswer, RemoteError
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import Address, Network

PATIENCE = 20.0
"""Seconds until a newcomer gives up."""
FIRST, GROWTH, TRIES = 0.25, 1.6, 4
"""Seconds until a knock is repeated, how much longer the next one waits, and how often one door is tried in a row."""
FINAL = ("used", "expired", "early", "revoked", "name", "foreign")
"""Refusals that no other bootstrap node would take back."""
MAX_DOORS = 64


class Newcomer:
    """Who has a code and wants in; ``seed`` is its lasting identity, ``wish`` what it would like to be called.

    ``network`` is its own for as long as it knocks, and closed afterwards.
    """

    def __init__(
        self,
        code: Code,
        seed: bytes,
        network: Network,
        clock: IReactorTime,
        rng: random.Random,
        wish: str = "",
    ) -> None:
        self._code = code
        self._key = code.key
        self._seed = seed
        self._public = Identity(seed).public
        self._network = network
        self._clock = clock
        self._ephemeral = rng.randbytes(32)
        shared = bindings.crypto_scalarmult_base(self._ephemeral)
        self._knock = knock.knock(self._key, self._public, shared, wish, rng)
        self._doors: list[Address] = []
        self._place = self._tries = 0
        self._wait = FIRST
        self._hint = ""
        self._call: IDelayedCall | None = None
        self._end: IDelayedCall | None = None
        self._done: Deferred[Membership] | None = None

    def join(self, doors: Iterable[Address], timeout: float = PATIENCE) -> Deferred[Membership]:
        """Knock at ``doors`` until one opens.

        Fails with ``NotWelcome``, or with ``NoAnswer`` where nobody answered in time; raises ``PortInUse``.
        """
        self._done = Deferred(self._cancelled)
        self._network.listen(self._received)
        self._end = self._clock.callLater(timeout, self._late)
        for door in doors:
            self.add(door)
        return self._done

    def add(self, door: Address) -> None:
        """One more address to knock at, found meanwhile."""
        if door not in self._doors and len(self._doors) < MAX_DOORS:
            self._doors.append(door)
            if self._call is None and self._done is not None:
                self._knock_again()

    def _knock_again(self) -> None:
        self._network.send(self._knock, self._doors[self._place % len(self._doors)])
        self._tries += 1
        wait, self._wait = self._wait, self._wait * GROWTH
        if self._tries >= TRIES:
            self._next_door()
        self._call = self._clock.callLater(wait, self._knock_again)

    def _next_door(self) -> None:
        self._place, self._tries, self._wait = self._place + 1, 0, FIRST

    def _received(self, datagram: bytes, source: Address) -> None:
        if self._done is None or datagram[:1] != bytes([knock.WELCOME]) or source not in self._doors:
            return
        try:
            reply = knock.opened_welcome(datagram, self._code, self._public, self._ephemeral)
        except RemoteError:
            return  # a member that is no bootstrap node may have made it: the right answer may still come
        if isinstance(reply, Hint):
            self._put_off(reply.code, source)
        elif isinstance(reply.said, Welcome):
            self._welcomed(reply.terms, reply.said, source)
        elif reply.said in FINAL:
            self._failed(NotWelcome(reply.said))
        else:
            self._put_off(reply.said, source)

    def _put_off(self, code: str, source: Address) -> None:
        """Ask another node: that one may open, or the same one a moment later."""
        self._hint = code
        if source == self._doors[self._place % len(self._doors)]:
            self._next_door()

    def _welcomed(self, terms: TermsContent, said: Welcome, source: Address) -> None:
        try:
            member = member_of(terms.operator, self._public, said.shown)
        except RemoteError:
            return
        if member.invitation != self._key.public:
            return
        known = dict.fromkeys([source, *(contact.address for contact in said.contacts)])
        secrets = tuple(sorted(said.secrets, key=lambda each: -each[0]))
        membership = Membership(
            terms.team, self._seed, terms.operator, said.shown, secrets, tuple(known), dict(terms.settings)
        )
        done = self._over()
        if done is not None:
            done.callback(membership)

    def _late(self) -> None:
        if self._hint:
            self._failed(NotWelcome(self._hint))
            return
        where = ", ".join(map(str, self._doors)) or "nobody was found to ask"
        remedy = "name the address of a bootstrap node that runs (swarm join CODE --at HOST:PORT)"
        self._failed(NoAnswer(f"nobody opens ({where}); {remedy}, and look whether UDP gets through"))

    def _failed(self, error: Exception) -> None:
        done = self._over()
        if done is not None:
            done.errback(error)

    def _cancelled(self, _: object) -> None:
        self._over()

    def _over(self) -> Deferred[Membership] | None:
        done, self._done = self._done, None
        for call in (self._call, self._end):
            if call is not None and call.active():
                call.cancel()
        self._network.close()
        return done
