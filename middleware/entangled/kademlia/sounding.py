"""Probe the contacts of a node in a network that is too large to know all its members.

A node probes its neighbours often, because they hold the same records, and of the others the one with the longest
silence, at a ``pace`` that adapts to the rate of failures.
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
"""The seconds between two steps."""
OUT_OF_TOUCH = 3.0
"""The silence of all nodes in seconds after which distant contacts are not probed: this node itself is disconnected."""
AROUND = (3.0, 60.0)
"""The first and longest interval in seconds between a newcomer's lookups of its neighbours; it doubles each time."""
NEAR_SILENCE = 12.0
"""The silence in seconds after which a neighbour, or a contact that ``needs_use``, is probed in a large network."""
PROBES = 2
"""The number of distant contacts that are probed per ``PROBE``."""
UPKEEP = 15.0
"""The seconds between two runs of infrequent maintenance in a large network."""
SESSION_S = 120.0
"""The silence in seconds after which a session is deleted in a large network: there are too many peers to keep all."""

LEAST, FIRST, MOST = 15.0, 60.0, 300.0
"""The silence in seconds after which a distant contact is probed: minimum, initial and maximum."""
GONE = 0.05
LONGER = 2.0 ** (GONE / (1 - GONE))
"""The factor by which the silence grows with each answer."""


class Pace:
    """The adaptive interval between probes of distant contacts; ``wait`` is their silence in seconds before a probe.

    In a stable network nearly every probe is unnecessary, in a changing one most contacts fail within a minute.
    Therefore the interval is halved for each lost contact and grows slightly with each answer: in equilibrium a share
    of ``GONE`` of the probed contacts has failed.  By the measurements of Kademlia and Bamboo this share does not slow
    lookups.
    """

    __slots__ = ("wait",)

    def __init__(self) -> None:
        self.wait = FIRST

    def answered(self) -> None:
        """Record that a contact answered after this silence."""
        self.wait = min(MOST, self.wait * LONGER)

    def lost(self) -> None:
        """Record that a contact was lost."""
        self.wait = max(LEAST, self.wait / 2)


class Sounding:
    """The probes of one node's contacts in a large network.

    ``upkeep`` is called with the time at each run of infrequent maintenance.  ``needs_use`` returns whether the path to
    a contact stays open only while it is used.
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
        self._probing: set[bytes] = set()
        self._next_far = self._next_upkeep = float("-inf")
        self._fragile: list[Contact] = []

    async def look_around(self) -> None:
        """Look up this node's id until no nearer contacts are found: simultaneous newcomers know few nodes."""
        overlay, pause = self._overlay, AROUND[0]
        while not self._chores.is_stopped and overlay.is_large:
            await self._chores.sleep(pause * (0.75 + self._rng.random() / 2))
            pause = min(2 * pause, AROUND[1])
            before = set(overlay.neighbours())
            await overlay.lookup(overlay.own_id)
            if len(before) == K and before.issuperset(overlay.neighbours()):
                return

    def step(self, now: float) -> bool:
        """Probe silent neighbours and a few other contacts; return False if this node has no neighbours."""
        overlay = self._overlay
        if not overlay.is_placed:
            return False
        near = overlay.neighbours()
        if not near:
            return False
        if now >= self._next_upkeep:
            self._next_upkeep = now + UPKEEP
            self._maintain(now)
        for contact in near:
            if overlay.silence(contact) > NEAR_SILENCE:
                self._probe(contact, True)
        for contact in self._fragile:
            if overlay.silence(contact) > NEAR_SILENCE and overlay.is_contact(contact):
                self._probe(contact, True)
        if now >= self._next_far or overlay.is_anybody_doubted:
            self._next_far = self._probe_far(now)
        return True

    def lost(self) -> None:
        """Record that a contact was lost, and probe the next ones immediately."""
        self.pace.lost()
        self._next_far = float("-inf")

    # -- private ----------------------------------------------------------------------------------------------------

    def _maintain(self, now: float) -> None:
        """Run the infrequent maintenance."""
        overlay = self._overlay
        overlay.patience = self.pace.wait
        overlay.tidy()
        self._endpoint.let_go(SESSION_S)
        self._upkeep(now)
        self._fragile = [contact for contact in overlay.contacts() if self.needs_use(contact)]

    def _probe_far(self, now: float) -> float:
        """Probe the contacts with the longest silence; return the time of the next probe."""
        overlay, wait, left = self._overlay, self.pace.wait, PROBES
        silences = overlay.silences()
        if not silences or silences[-1][1] > OUT_OF_TOUCH:
            return now + PROBE
        near = {contact.node_id for contact in overlay.neighbours()}
        for doubted in overlay.doubted():
            if doubted.node_id not in near and left > 0:
                self._probe(doubted, False)
                left -= 1
        for node_id, silence in silences:
            if silence <= wait:
                return now + min(wait - silence, UPKEEP)
            contact = overlay.contact(node_id)
            if contact is None or node_id in self._probing or node_id in near:
                continue
            if left <= 0:
                return now + PROBE
            self._probe(contact, False)
            left -= 1
        return now + UPKEEP

    def _probe(self, contact: Contact, is_near: bool) -> None:
        if contact.node_id not in self._probing:
            self._probing.add(contact.node_id)
            self._chores.fork(self._probe_contact(contact, is_near))

    async def _probe_contact(self, contact: Contact, is_near: bool) -> None:
        """Check whether a contact is alive, without a handshake if it has no session."""
        overlay = self._overlay
        silence = overlay.silence(contact)
        try:
            if self._endpoint.is_met(contact) and not overlay.is_doubted(contact):
                await overlay.ask(contact, "ping", b"", changes=True, is_light=True)
            else:
                await self._rediscover(contact, is_near)
            if not is_near and silence >= self.pace.wait:
                self.pace.answered()
        except NoAnswer:
            if not is_near:
                overlay.missed(contact, is_over=True)
            raise
        finally:
            self._probing.discard(contact.node_id)

    async def _rediscover(self, contact: Contact, is_near: bool) -> None:
        """Check whether ``contact`` listens at its address; a neighbour also proves its key."""
        try:
            found = await self._endpoint.greet(contact.address)
            if found.public != contact.public:
                raise NoAnswer(f"{contact.address} belongs to another node now")
        except NoAnswer:
            self._overlay.missed(contact)
            raise
        if is_near:
            await self._overlay.ask(contact, "ping", b"", changes=True)
        else:
            self._overlay.heard(contact)
