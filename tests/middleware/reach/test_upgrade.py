"""Tests of when a carried peer is tried directly again."""

from __future__ import annotations

import random
from collections import Counter

from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.clock import HeapClock
from middleware.entangled.contact import Contact
from middleware.entangled.identity import Identity
from middleware.entangled.network.network import relayed
from middleware.entangled.network.switchboard import Switchboard
from middleware.entangled.reach.upgrade import GIVEN_UP_S, PAUSES, TURN, Upgrades
from middleware.entangled.wire.noise import TransportKeys
from middleware.entangled.wire.peer import Peers
from middleware.entangled.wire.session import Session


class UpgradeTests(SynchronousTestCase):
    """Behaviour of ``Upgrades``, with one carried peer."""

    def setUp(self) -> None:
        """A session that others carry."""
        clock, rng = HeapClock(), random.Random(1)
        peers = Peers([], clock, rng, Switchboard(clock, rng).network("10.0.0.1", 7), Counter())
        identity = Identity(b"p" * 32)
        self.public = identity.public
        contact = Contact(identity.public, relayed(identity.node_id))
        self.session = Session(contact, 1, 2, TransportKeys(bytes(32), bytes(32), bytes(32)), 0.0, is_confirmed=True)
        peers.established(self.session)
        self.upgrades = Upgrades(peers)

    def tried(self, until: float) -> list[float]:
        """The moments at which the peer is tried, looked at every half second; it is heard all the time."""
        moments = []
        for step in range(int(2 * until) + 1):
            self.session.heard_at = now = step / 2
            moments += [now for _ in self.upgrades.due(now)]
        return moments

    def test_more_and_more_rarely(self) -> None:
        """The pauses grow, and the last one is repeated; at another address of this node they begin anew."""
        self.upgrades.add(self.public, False, 0.0)
        self.upgrades.add(self.public, False, 0.9)  # is known already
        moments = self.tried(150.0)
        pauses = [after - before for before, after in zip([0.0, *moments], moments, strict=False)]
        self.assertEqual(pauses, [*PAUSES, PAUSES[-1]])
        self.upgrades.hurry(151.0)
        self.assertEqual([step for _, step in self.upgrades.due(151.0)], [0])

    def test_only_one_of_the_two(self) -> None:
        """Who is behind begins later than the other, and who hears that the other is at it waits for longer yet."""
        self.upgrades.add(self.public, True, 0.0)
        self.assertEqual(self.tried(PAUSES[0] + TURN), [PAUSES[0] + TURN])
        now = PAUSES[0] + 2 * TURN
        self.upgrades.put_off(self.public, now)
        self.assertEqual(self.tried(10.0)[0], now + PAUSES[1] + TURN)

    def test_no_longer_than_needed(self) -> None:
        """A peer that is reached directly, or is silent for long, is tried no more."""
        self.upgrades.add(self.public, False, 0.0)
        self.upgrades.drop(self.public)
        self.assertEqual(len(self.upgrades), 0)
        self.upgrades.add(self.public, False, 0.0)
        self.assertEqual(list(self.upgrades.due(self.session.heard_at + GIVEN_UP_S + 0.1)), [])
        self.assertEqual(len(self.upgrades), 0)
