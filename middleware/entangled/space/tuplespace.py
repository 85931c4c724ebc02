"""The tuple space: put, get, read and claim tuples by template; at most one taker gets each tuple.

A tuple is a record of its publisher.  The record lists the members of the council that decides about the taker of the
tuple; ``take_acceptor`` contains the acceptors, ``taker`` the proposers.  ``docs/reference/tuple-space.md`` describes
for what each call waits.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Coroutine, Sequence
from typing import Any, TypeVar

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.logger import Logger

from middleware.entangled.background import Background
from middleware.entangled.errors import EntangledError, NoAnswer, NotRunning, TransientError
from middleware.entangled.space.node_interface import NodeInterface
from middleware.entangled.space.slot_maintenance import SlotMaintenance
from middleware.entangled.space.taker import Claim, Taker, WaitingCall
from middleware.entangled.space.template import Field, Template, Tuple, Value, make_template, make_tuple
from middleware.entangled.space.tuple_cache import TupleCache
from middleware.entangled.space.tuple_record import TupleId, parse_records, space_key

COUNCIL_MEMBERS = 3
GET_LEASE_S = 2.0
MAX_PASSES = 4
PASS_PAUSE_S = (0.01, 0.05)

T = TypeVar("T")


class NoTuple(TransientError):
    """No matching tuple was found before the timeout."""


class TupleSpace:
    """The tuples of one space, used through one node.

    ``council`` is the number of members of the council of each tuple that this node puts.  A council of 3 survives the
    loss of 1 node, and a council of 5 the loss of 2 nodes, but with more requests.  Spaces with different names are
    separate.
    """

    _log = Logger()

    def __init__(
        self,
        node: NodeInterface,
        clock: IReactorTime,
        rng: random.Random,
        name: str = "default",
        council: int = COUNCIL_MEMBERS,
    ) -> None:
        self.name = name
        self._node = node
        self._clock = clock
        self._rng = rng
        self._background = Background(clock)
        self._slots = SlotMaintenance(node, rng, self._background)
        self._taker = Taker(
            node,
            clock,
            rng,
            self._background,
            self._slots,
            council,
            self._on_freed,
            lambda fields: self._background.fork(self._put(fields, None)),
        )
        self._caches: dict[bytes, TupleCache] = {}
        self._waiting_calls: dict[WaitingCall, None] = {}

    def stop(self) -> None:
        """Fail all calls with ``NotRunning`` and stop all timers; claimed tuples are free when their lease ends."""
        if self._background.is_stopped:
            return
        self._background.stop()
        for cache in self._caches.values():
            cache.close()
        for wait in list(self._waiting_calls):
            if not wait.is_over:
                wait.end()
                wait.deferred.errback(NotRunning(f"the tuple space {self.name} has stopped"))

    # -- put --------------------------------------------------------------------------------------------------------

    def put(self, fields: Sequence[Value], ttl: float | None = None) -> Deferred[None]:
        """Put a tuple; fires when a majority of its replicas has stored it, so the tuple survives this node.

        With ``ttl`` the tuple is removed after that many seconds, if this node is still running.  Raises ``BadTuple``
        and ``TooLarge`` immediately.  If the call fails with ``NoAnswer``, the tuple may appear nevertheless.
        """
        return self._start(self._put(make_tuple(fields), ttl))

    async def _put(self, fields: Tuple, ttl: float | None) -> None:
        key = space_key(self.name, len(fields))
        await self._slots.put_tuple(key, fields, await self._taker.enrol_council(key), ttl)

    # -- take -------------------------------------------------------------------------------------------------------

    def get(self, template: Sequence[Field] | Template, timeout: float | None = None) -> Deferred[Tuple]:
        """Take a matching tuple, waiting for one; fails with ``NoTuple`` after ``timeout`` seconds; can be cancelled.

        If the call is cancelled, but the council decides in its favour, the tuple is put back.
        """
        return self._start_waiting(self._get, make_template(template), timeout)

    def get_if_exists(self, template: Sequence[Field] | Template) -> Deferred[Tuple | None]:
        """Take a matching tuple; fire with None if there is none, or if other takers have claimed all of them.

        Fails with ``NoAnswer`` if a tuple matches, but too few members of its council are reachable.
        """
        many = self.get_many(template, 1)
        return many.addCallback(lambda found: found[0] if found else None)

    def get_many(self, template: Sequence[Field] | Template, most: int) -> Deferred[list[Tuple]]:
        """Take up to ``most`` existing matching tuples, many per request; fails as ``get_if_exists`` does."""
        return self._start(self._get_many(make_template(template), most))

    def claim(
        self, template: Sequence[Field] | Template, lease: float = 10.0, timeout: float | None = None
    ) -> Deferred[Claim]:
        """Claim a matching tuple for ``lease`` seconds, waiting for one as ``get`` does.

        Confirm the claim when the work on the tuple is done.
        """

        async def work(wanted: Template, wait: WaitingCall) -> Claim | None:
            claim = await self._claim(wanted, wait, lease)
            if claim is not None and wait.is_over:
                claim.release()
            return claim

        return self._start_waiting(work, make_template(template), timeout)

    async def _get(self, template: Template, wait: WaitingCall) -> Tuple | None:
        while True:
            claim = await self._claim(template, wait, GET_LEASE_S)
            if claim is None:
                return None
            if wait.is_over:
                claim.release()
                return None
            [won] = await self._taker.decide([claim], wait)
            if won or wait.is_over:
                return claim.fields

    async def _claim(self, template: Template, wait: WaitingCall, lease: float) -> Claim | None:
        """Wait for and claim a matching tuple; return None when the call has ended."""
        cache = self._find_cache(space_key(self.name, template.arity))
        cache.start_waiting()
        wait.on_end.add(cache.wake)
        try:
            while not wait.is_over:
                ready, pause = self._taker.find_candidates(cache.tuples, template)
                if ready:
                    claims, _ = await self._taker.claim(ready[:1], lease)
                    if claims:
                        return claims[0]
                else:
                    await cache.sleep(pause)
        finally:
            cache.stop_waiting()
        return None

    async def _get_many(self, template: Template, most: int) -> list[Tuple]:
        key = space_key(self.name, template.arity)
        cache = self._find_cache(key)
        cache.record_call()
        taken: list[Tuple] = []
        is_silent = False
        for number in range(MAX_PASSES):
            # Tuples in an open cache need no read, because the council rejects claims of a taken tuple.
            ready = self._taker.find_candidates(cache.tuples, template)[0] if cache.is_open and not number else []
            if not ready:
                tuples, _ = parse_records(await self._node.get(key))
                ready, _ = self._taker.find_candidates(tuples, template, is_patient=False)
            left = [one for one in ready if one.tuple_id not in self._taker.claimed]
            if not left:
                return taken
            while left and len(taken) < most:
                batch = self._taker.select_batch(left, most - len(taken))
                left = [one for one in left if one not in batch]
                claims, silent = await self._taker.claim(batch, GET_LEASE_S)
                is_silent = is_silent or silent
                won = await self._taker.decide(claims)
                taken += [claim.fields for claim, is_ours in zip(claims, won, strict=True) if is_ours]
            if taken:
                return taken
            # Other nodes held all matching tuples, perhaps only briefly, as when three nodes claim at the same time.
            await self._background.sleep(self._rng.uniform(*PASS_PAUSE_S))
        if is_silent:
            raise NoAnswer("a tuple matches, but too few members of its council answered to take it; try again")
        return taken

    # -- read -------------------------------------------------------------------------------------------------------

    def read(self, template: Sequence[Field] | Template, timeout: float | None = None) -> Deferred[Tuple]:
        """Read a matching tuple, waiting for one; fails with ``NoTuple`` after ``timeout`` seconds; cancellable."""
        return self._start_waiting(self._read, make_template(template), timeout)

    def read_if_exists(self, template: Sequence[Field] | Template) -> Deferred[Tuple | None]:
        """Read a matching tuple; fire with None if there is none."""
        found = self.read_all(template)
        return found.addCallback(lambda tuples: tuples[0] if tuples else None)

    def read_all(self, template: Sequence[Field] | Template) -> Deferred[list[Tuple]]:
        """Read all matching tuples that were not taken, including claimed tuples."""
        return self._start(self._read_all(make_template(template)))

    async def _read(self, template: Template, wait: WaitingCall) -> Tuple | None:
        cache = self._find_cache(space_key(self.name, template.arity))
        cache.start_waiting()
        wait.on_end.add(cache.wake)
        try:
            while not wait.is_over:
                for one in cache.tuples:
                    if one.tuple_id not in self._taker.taken and template.matches(one.fields):
                        return one.fields
                await cache.sleep(None)
        finally:
            cache.stop_waiting()
        return None

    async def _read_all(self, template: Template) -> list[Tuple]:
        tuples, _ = parse_records(await self._node.get(space_key(self.name, template.arity)))
        gone = self._taker.taken
        return [one.fields for one in tuples if one.tuple_id not in gone and template.matches(one.fields)]

    # -- inside -----------------------------------------------------------------------------------------------------

    def _find_cache(self, key: bytes) -> TupleCache:
        self._slots.add_key(key)
        return self._caches.setdefault(key, TupleCache(self._node, key, self._background))

    def _on_freed(self, tuple_id: TupleId) -> None:
        if tuple_id.key in self._caches:
            self._caches[tuple_id.key].wake()

    def _start(self, work: Coroutine[Any, Any, T]) -> Deferred[T]:
        async def checked() -> T:
            if self._background.is_stopped:
                work.close()
                raise NotRunning(f"the tuple space {self.name} has stopped")
            return await work

        return Deferred.fromCoroutine(checked())

    def _start_waiting(
        self,
        work: Callable[[Template, WaitingCall], Coroutine[Any, Any, Any]],
        template: Template,
        timeout: float | None,
    ) -> Deferred[Any]:
        wait = WaitingCall()
        self._waiting_calls[wait] = None
        wait.on_end.add(lambda: self._waiting_calls.pop(wait, None))

        def answered(value: object) -> None:
            if not wait.is_over:
                wait.end()
                wait.deferred.callback(value)

        def failed(failure: Any) -> None:
            if not wait.is_over:
                wait.end()
                wait.deferred.errback(failure)
            elif failure.check(EntangledError) is None:
                self._log.failure("a call failed after it had ended", failure)

        def expired() -> None:
            if not wait.is_over:
                wait.end()
                wait.deferred.errback(NoTuple(f"no matching tuple was found within {timeout} s"))

        if timeout is not None:
            wait.on_end.add(self._background.later(timeout, expired))
        self._start(work(template, wait)).addCallbacks(answered, failed)
        return wait.deferred
