"""Sounding: who of a network that is too large to be known whole is still there.

A node asks its neighbours often, for they hold what it holds, and of the others whoever was silent for longest, at a
``pace`` that follows how many come and go.
"""

from __future__ import annotations

import random
from collections.abc import Callable

from middleware.entangled.background import Background
from middleware.entangled.contact import Contact
from middleware.entangled.errors import NoAnswer
from middleware.entangled.kademlia.overlay import K, Overlay
from middleware.entangled.wire.endpoint import Endpoint

PROBE = 1.0
"""Seconds between two steps."""
OUT_OF_TOUCH = 3.0
"""Who has heard nobody at all for so many seconds asks no far contact: it is this node that is out of touch."""
AROUND = (3.0, 60.0)
"""Seconds until a newcomer of a large network looks up its own id again; twice as many each time, up to these."""
NEAR_SILENCE = 12.0
"""Seconds of silence after which a neighbour, or one whose way has to be used, is asked in a large network."""
PROBES = 2
"""Far contacts that are asked in one ``PROBE``."""
UPKEEP = 15.0
"""Seconds between two looks at what changes slowly in a large network."""
SESSION_S = 120.0
"""Seconds of silence after which a session is let go of in a large network: there are too many peers to keep all."""

LEAST, FIRST, MOST = 15.0, 60.0, 300.0
"""Seconds of silence after which a far contact is asked: where all come and go, at first, and where nobody does."""
GONE = 0.05
LONGER = 2.0 ** (GONE / (1 - GONE))
"""By what that grows with each answer."""


class Pace:
    """How often the far contacts are asked; ``wait`` is the silence in seconds after which one is.

    In a network that changes slowly nearly every question is in vain, in one that changes quickly a contact that nobody
    asked for a minute is mostly gone.  So the wait is halved for each contact that was lost and grows a little with
    each that answers: it settles where ``GONE`` of those asked are gone.  After Kademlia's and Bamboo's measurements
    lookups bear that many dead contacts without taking longer.
    """

    __slots__ = ("wait",)

    def __init__(self) -> None:
        self.wait = FIRST

    def answered(self) -> None:
        """Take note that a contact which was silent for so long is still there."""
        self.wait = min(MOST, self.wait * LONGER)

    def lost(self) -> None:
        """Take note that a contact is gone."""
        self.wait = max(LEAST, self.wait / 2)


class Sounding:
    """One node's contacts in a large network, and who of them is asked when.

    ``upkeep`` is called with the moment, each time that what changes slowly is looked at.  ``needs_use`` says of a
    contact whether the way to it is open for only so long as it is used.
    """

    def __init__(
        self,
        overlay: Overlay,
        endpoint: Endpoint,
        rng: random.Random,
        chores: Background,
        upkeep: Callable[[float], None],
    ) -> None:
        self.needs_use: Callable[[Contact], bool] = lambda contact: False
        self.pace = Pace()
        self._overlay = overlay
        self._endpoint = endpoint
        self._rng = rng
        self._chores = chores
        self._upkeep = upkeep
        self._sounding: set[bytes] = set()
        self._next_far = self._next_upkeep = float("-inf")
        self._fragile: list[Contact] = []

    async def look_around(self) -> None:
        """Look up the own id again until that brings no nearer ones: where many come at once nobody knows many yet."""
        overlay, pause = self._overlay, AROUND[0]
        while not self._chores.is_stopped and overlay.is_large:
            await self._chores.sleep(pause * (0.75 + self._rng.random() / 2))
            pause = min(2 * pause, AROUND[1])
            before = set(overlay.neighbours())
            await overlay.lookup(overlay.own_id)
            if len(before) == K and before.issuperset(overlay.neighbours()):
                return

    def step(self, now: float) -> bool:
        """Ask neighbours that were silent for a while, and a few of the others; False where this node is lost."""
        overlay = self._overlay
        if not overlay.is_placed:
            return False
        near = overlay.neighbours()
        if not near:
            return False
        if now >= self._next_upkeep:
            self._next_upkeep = now + UPKEEP
            self._keep_up(now)
        for contact in near:
            if overlay.silence(contact) > NEAR_SILENCE:
                self._sound(contact, True)
        for contact in self._fragile:
            if overlay.silence(contact) > NEAR_SILENCE and overlay.is_contact(contact):
                self._sound(contact, True)
        if now >= self._next_far or overlay.is_anybody_doubted:
            self._next_far = self._sound_far(now)
        return True

    def lost(self) -> None:
        """Learn that a contact is gone: the next one may be as well."""
        self.pace.lost()
        self._next_far = float("-inf")

    # -- inside -----------------------------------------------------------------------------------------------------

    def _keep_up(self, now: float) -> None:
        """Do what need not be done every second."""
        overlay = self._overlay
        overlay.patience = self.pace.wait
        overlay.tidy()
        self._endpoint.let_go(SESSION_S)
        self._upkeep(now)
        self._fragile = [contact for contact in overlay.contacts() if self.needs_use(contact)]

    def _sound_far(self, now: float) -> float:
        """Ask those of the contacts that were silent for longest; the moment when the next one may be due."""
        overlay, wait, left = self._overlay, self.pace.wait, PROBES
        silences = overlay.silences()
        if not silences or silences[-1][1] > OUT_OF_TOUCH:
            return now + PROBE
        near = {contact.node_id for contact in overlay.neighbours()}
        for doubted in overlay.doubted():
            if doubted.node_id not in near and left > 0:
                self._sound(doubted, False)
                left -= 1
        for node_id, silence in silences:
            if silence <= wait:
                return now + min(wait - silence, UPKEEP)
            contact = overlay.contact(node_id)
            if contact is None or node_id in self._sounding or node_id in near:
                continue
            if left <= 0:
                return now + PROBE
            self._sound(contact, False)
            left -= 1
        return now + UPKEEP

    def _sound(self, contact: Contact, is_near: bool) -> None:
        if contact.node_id not in self._sounding:
            self._sounding.add(contact.node_id)
            self._chores.fork(self._sounded(contact, is_near))

    async def _sounded(self, contact: Contact, is_near: bool) -> None:
        """Ask a contact whether it is there, without the cost of a handshake where it is not."""
        overlay = self._overlay
        silence = overlay.silence(contact)
        try:
            if self._endpoint.is_met(contact) and not overlay.is_doubted(contact):
                await overlay.ask(contact, "ping", b"", changes=True, is_light=True)
            else:
                await self._greet_again(contact, is_near)
            if not is_near and silence >= self.pace.wait:
                self.pace.answered()
        except NoAnswer:
            if not is_near:
                overlay.missed(contact, is_over=True)
            raise
        finally:
            self._sounding.discard(contact.node_id)

    async def _greet_again(self, contact: Contact, is_near: bool) -> None:
        """See whether ``contact`` still listens at its address; a neighbour shows its key as well."""
        try:
            found = await self._endpoint.greet(contact.address)
            if found.public != contact.public:
                raise NoAnswer(f"another node listens at {contact.address}")
        except NoAnswer:
            self._overlay.missed(contact)
            raise
        if is_near:
            await self._overlay.ask(contact, "ping", b"", changes=True)
        else:
            self._overlay.heard(contact)
