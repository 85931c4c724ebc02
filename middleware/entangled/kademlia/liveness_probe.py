"""Probe the contacts of a node in a network that is too large to know all its members.

A node often probes its neighbours, because they store the same records.  Of the other contacts it probes those with the
longest silence, at an ``interval`` that adapts to the rate of failures.
"""

from __future__ import annotations

import random
from collections.abc import Callable

from middleware.entangled.background import Background
from middleware.entangled.contact import Contact
from middleware.entangled.errors import NoAnswer
from middleware.entangled.kademlia.overlay import K, Overlay
from middleware.entangled.wire.endpoint import Endpoint

STEP_S = 1.0
"""The seconds between two steps."""
DISCONNECTED_S = 3.0
"""If all nodes were silent for this number of seconds, distant contacts are not probed, because this node itself is
probably disconnected."""
LOOKUP_INTERVALS_S = (3.0, 60.0)
"""The first and the longest interval in seconds between a newcomer's lookups of its neighbours; the interval doubles
each time."""
NEIGHBOUR_SILENCE_S = 12.0
"""The silence in seconds after which a neighbour, or a contact that ``needs_keep_alive``, is probed in a large network.
"""
PROBES_PER_STEP = 2
"""The number of distant contacts that are probed per ``STEP_S``."""
MAINTENANCE_S = 15.0
"""The seconds between two runs of infrequent maintenance in a large network."""
SESSION_S = 120.0
"""The silence in seconds after which a session is deleted in a large network, where there are too many peers for
permanent sessions."""

MIN_SILENCE_S, INITIAL_SILENCE_S, MAX_SILENCE_S = 15.0, 60.0, 300.0
"""A distant contact is probed after this number of seconds of silence: the minimum, initial and maximum value."""
TARGET_FAILURES = 0.05
GROWTH_FACTOR = 2.0 ** (TARGET_FAILURES / (1 - TARGET_FAILURES))
"""The factor by which the silence before a probe grows with each answer."""


class ProbeInterval:
    """The adaptive interval between probes of distant contacts; ``wait`` is their silence in seconds before a probe.

    In a stable network nearly every probe is unnecessary; in a network with high churn most contacts fail within a
    minute.  Therefore the interval is halved for each lost contact and grows slightly with each answer.  In
    equilibrium, a share ``TARGET_FAILURES`` of the probed contacts has failed; measurements of Kademlia and Bamboo show
    that this share does not slow down lookups.
    """

    __slots__ = ("silence_s",)

    def __init__(self) -> None:
        self.silence_s = INITIAL_SILENCE_S

    def record_answer(self) -> None:
        """Record that a contact answered after a silence of ``wait`` seconds."""
        self.silence_s = min(MAX_SILENCE_S, self.silence_s * GROWTH_FACTOR)

    def record_loss(self) -> None:
        """Record that a contact was lost."""
        self.silence_s = max(MIN_SILENCE_S, self.silence_s / 2)


class LivenessProber:
    """The probes of one node's contacts in a large network.

    ``on_maintenance`` is called with the time at each run of infrequent maintenance.  ``needs_keep_alive`` returns
    whether the path to a contact closes when it is unused.
    """

    def __init__(
        self,
        overlay: Overlay,
        endpoint: Endpoint,
        rng: random.Random,
        background: Background,
        on_maintenance: Callable[[float], None],
    ) -> None:
        self.needs_keep_alive: Callable[[Contact], bool] = lambda contact: False
        self.interval = ProbeInterval()
        self._overlay = overlay
        self._endpoint = endpoint
        self._rng = rng
        self._background = background
        self._on_maintenance = on_maintenance
        self._probing: set[bytes] = set()
        self._next_distant_at = self._next_maintenance_at = float("-inf")
        self._keep_alive_contacts: list[Contact] = []

    async def lookup_neighbours(self) -> None:
        """Look up this node's id until no nearer contacts are found, because simultaneous newcomers know few nodes."""
        overlay, pause = self._overlay, LOOKUP_INTERVALS_S[0]
        while not self._background.is_stopped and overlay.is_large:
            await self._background.sleep(pause * (0.75 + self._rng.random() / 2))
            pause = min(2 * pause, LOOKUP_INTERVALS_S[1])
            before = set(overlay.find_neighbours())
            await overlay.lookup(overlay.own_id)
            if len(before) == K and before.issuperset(overlay.find_neighbours()):
                return

    def step(self, now: float) -> bool:
        """Probe silent neighbours and a few other contacts; return False if this node has no neighbours."""
        overlay = self._overlay
        if not overlay.has_found_neighbours:
            return False
        near = overlay.find_neighbours()
        if not near:
            return False
        if now >= self._next_maintenance_at:
            self._next_maintenance_at = now + MAINTENANCE_S
            self._maintain(now)
        for contact in near:
            if overlay.silence(contact) > NEIGHBOUR_SILENCE_S:
                self._probe(contact, True)
        for contact in self._keep_alive_contacts:
            if overlay.silence(contact) > NEIGHBOUR_SILENCE_S and overlay.is_contact(contact):
                self._probe(contact, True)
        if now >= self._next_distant_at or overlay.has_suspects:
            self._next_distant_at = self._probe_distant(now)
        return True

    def record_loss(self) -> None:
        """Record that a contact was lost, and probe the next contacts immediately."""
        self.interval.record_loss()
        self._next_distant_at = float("-inf")

    # -- private ----------------------------------------------------------------------------------------------------

    def _maintain(self, now: float) -> None:
        """Run the infrequent maintenance."""
        overlay = self._overlay
        overlay.max_silence = self.interval.silence_s
        overlay.delete_unneeded()
        self._endpoint.forget_silent(SESSION_S)
        self._on_maintenance(now)
        self._keep_alive_contacts = [contact for contact in overlay.contacts() if self.needs_keep_alive(contact)]

    def _probe_distant(self, now: float) -> float:
        """Probe the contacts with the longest silence; return the time of the next probe."""
        overlay, wait, left = self._overlay, self.interval.silence_s, PROBES_PER_STEP
        silences = overlay.silences()
        if not silences or silences[-1][1] > DISCONNECTED_S:
            return now + STEP_S
        near = {contact.node_id for contact in overlay.find_neighbours()}
        for doubted in overlay.list_suspects():
            if doubted.node_id not in near and left > 0:
                self._probe(doubted, False)
                left -= 1
        for node_id, silence in silences:
            if silence <= wait:
                return now + min(wait - silence, MAINTENANCE_S)
            contact = overlay.find_contact(node_id)
            if contact is None or node_id in self._probing or node_id in near:
                continue
            if left <= 0:
                return now + STEP_S
            self._probe(contact, False)
            left -= 1
        return now + MAINTENANCE_S

    def _probe(self, contact: Contact, is_near: bool) -> None:
        if contact.node_id not in self._probing:
            self._probing.add(contact.node_id)
            self._background.fork(self._probe_contact(contact, is_near))

    async def _probe_contact(self, contact: Contact, is_near: bool) -> None:
        """Check whether a contact is alive; if there is no session with it, do so without a handshake."""
        overlay = self._overlay
        silence = overlay.silence(contact)
        try:
            if self._endpoint.has_session(contact) and not overlay.is_suspect(contact):
                await overlay.ask(contact, "ping", b"", changes=True, is_light=True)
            else:
                await self._rediscover(contact, is_near)
            if not is_near and silence >= self.interval.silence_s:
                self.interval.record_answer()
        except NoAnswer:
            if not is_near:
                overlay.record_miss(contact, is_over=True)
            raise
        finally:
            self._probing.discard(contact.node_id)

    async def _rediscover(self, contact: Contact, is_near: bool) -> None:
        """Check whether ``contact`` listens at its address; a neighbour also proves its key."""
        try:
            found = await self._endpoint.discover(contact.address)
            if found.public != contact.public:
                raise NoAnswer(f"the address {contact.address} now belongs to a different node")
        except NoAnswer:
            self._overlay.record_miss(contact)
            raise
        if is_near:
            await self._overlay.ask(contact, "ping", b"", changes=True)
        else:
            self._overlay.process_message(contact)
