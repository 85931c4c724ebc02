"""Tests of ``webnode.revocation``: a sign-out at one web node takes effect at all web nodes."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import Any

import msgpack
from twisted.internet.defer import succeed
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.identity import Identity
from middleware.entangled.record import Record
from swarmnode.simulated_team import SimulatedTeam
from webnode.auth import User
from webnode.revocation import (
    MAX_KNOWN,
    MAX_PUBLISHED,
    REVOKED_KEY,
    SLOT,
    Revocations,
    TeamRevocations,
    read_revocations,
)
from webnode.session import SignedSessions
from webnode.token import TokenKey


class TeamRevocationsTests(SynchronousTestCase):
    def setUp(self) -> None:
        self.team = SimulatedTeam(5, dogs=("dog1",), others=("pi", "nuc"))
        self.addCleanup(self.team.stop)
        self.vaio, self.pi = self.known("vaio"), self.known("pi")

    def known(self, name: str) -> TeamRevocations:
        return TeamRevocations(self.team.services[name].assembly.node)

    def test_hold_at_every_web_node(self) -> None:
        """A token that one web node revokes is invalid at all others.

        It is also invalid at a node that starts after both have failed.
        """

        def at(revoked: TeamRevocations, key: TokenKey) -> SignedSessions:
            return SignedSessions(key, lambda _: True, "quiet-otter", "", random.Random(1), check, revoked)

        check = lambda text, word: succeed(False)  # noqa: E731
        keys = [TokenKey(Identity(name.ljust(32))) for name in (b"vaio", b"pi", b"nuc")]
        vaio, pi, now = at(self.vaio, keys[0]), at(self.pi, keys[1]), self.team.clock.seconds()
        token = self.successResultOf(vaio.sign_in("quiet-otter", "10.0.0.9", now))
        uuids = [key.node_id.hex() for key in keys]
        given = vaio.issue_peer_tokens(vaio.authenticate(token.text, now), uuids, now)
        there = given[uuids[1]]
        self.assertEqual(pi.authenticate(there.ticket, now).role, "viewer")
        vaio.revoke(vaio.authenticate(token.text, now).token_id, token.until)
        self.assertEqual(vaio.authenticate(token.text, now), User())
        self.team.clock.advance(0.5)
        for text in (there.text, there.ticket):
            self.assertEqual(pi.authenticate(text, now), User())
        self.team.kill("vaio")
        self.team.kill("pi")
        self.team.clock.advance(2.0)
        late = at(self.known("nuc"), keys[2])
        self.team.clock.advance(1.0)
        self.assertEqual(late.authenticate(given[uuids[2]].text, now), User())

    def test_stay_small(self) -> None:
        """The record always fits into a datagram: it contains the newest revocations, but no expired ones."""
        now = self.team.clock.seconds()
        self.vaio.revoke("ee" * 8, now + 1.0)
        self.team.clock.advance(2.0)
        for number in range(3 * MAX_PUBLISHED):
            self.vaio.revoke(f"{number:016x}", now + 1e9)
        self.team.clock.advance(1.0)
        self.assertTrue(self.pi.is_revoked(f"{3 * MAX_PUBLISHED - 1:016x}"))
        late = self.known("nuc")
        self.team.clock.advance(1.0)
        self.assertEqual(
            [late.is_revoked(f"{number:016x}") for number in (2 * MAX_PUBLISHED - 1, 2 * MAX_PUBLISHED)], [False, True]
        )
        self.assertFalse(self.vaio.is_revoked("ee" * 8))

    def test_believe_lawful_records_only(self) -> None:
        """A record with invalid content revokes no session."""
        good = Record(REVOKED_KEY, SLOT, bytes(32), 1, "team", 60.0, msgpack.packb({bytes(8): 5}))
        self.assertEqual(read_revocations(good), {"00" * 8: 5.0})
        bad: list[Any] = [[], {"ab": 5}, {bytes(7): 5}, {bytes(8): "x"}, {bytes(8): float("nan")}, {bytes(8): True}, 7]
        for content in bad:
            self.assertEqual(read_revocations(replace(good, value=msgpack.packb(content))), {}, content)
        for record in (replace(good, value=None), replace(good, value=b"\xc1"), replace(good, name="other")):
            self.assertEqual(read_revocations(record), {})

    def test_remember_so_many(self) -> None:
        """The number of revocations in memory is limited as well: the oldest revocation is dropped."""
        twin = Revocations()
        for number in range(MAX_KNOWN + 1):
            twin.revoke(str(number), 1.0)
        self.assertEqual(
            [twin.is_revoked(each) for each in ("0", "1", str(MAX_KNOWN), "x")], [False, True, True, False]
        )
