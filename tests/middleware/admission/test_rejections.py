"""Tests of the log of rejections in a closed team: peer, side, reason and remedy."""

from __future__ import annotations

from twisted.logger import capturedLogs, formatEvent

from middleware.admission.errors import NotWelcome
from middleware.entangled.wire.rejection import Rejection
from tests.middleware.admission.village import House, VillageCase


class RejectionTests(VillageCase):
    def met(self, house: House, side: str) -> list[Rejection]:
        """Return the rejections that the node of ``house`` logged for ``side``."""
        now = house.node.endpoint.rejections.list_recent(1e9, 1e10)
        return [each for each in now if each.side == side]

    def test_revoked_member(self) -> None:
        """A revoked member, and the member that rejects it, both log the rejection with its remedy."""
        village = self.village()
        dog = village.welcome("dog")
        village.run(3.0)
        village.tell(village.signer.revoke(dog.public, "dog", village.wall()))
        village.run(10.0)
        (ours, *_), (theirs, *_) = self.met(village.houses[0], "we"), self.met(dog, "they")
        self.assertEqual((ours.who, ours.code), (dog.public, "revoked"))
        self.assertEqual((theirs.who, theirs.code), (village.houses[0].public, "revoked"))
        for each in (ours, theirs):
            self.assertIn("; admit the node again with a new code", each.reason)

    def test_newcomers(self) -> None:
        """A used code is logged with the newcomer's key; all unknown codes share one log entry."""
        village = self.village()
        code = village.invite()
        others = [village.knock(self.village(seed=seed).invite(), timeout=3.0) for seed in (2, 3, 4)]
        with capturedLogs() as said:
            first, second = village.knock(code), village.knock(code)
            village.run(4.0)
        self.successResultOf(first)
        self.failureResultOf(second, NotWelcome)
        for each in others:
            self.failureResultOf(each, NotWelcome)
        found = {each.code: each for each in self.met(village.houses[0], "code")}
        self.assertEqual(sorted(found), ["unknown", "used"])
        self.assertEqual((len(found["used"].who), found["unknown"].who), (32, b""))
        self.assertGreaterEqual(found["unknown"].count, 3)
        self.assertEqual(sum("rejected by the invitation" in formatEvent(event) for event in said), 1)

    def test_copy_of_a_store(self) -> None:
        """A copy of a node that starts later supersedes the first node; the first node and its peers log this."""
        village = self.village()
        dog = village.welcome("dog")
        village.run(3.0)
        copy = village.move_in(dog.kept.membership)
        village.run(5.0)
        self.assertEqual({each.code for each in self.met(dog, "they")}, {"superseded"})
        ours = [(each.who, each.code) for each in self.met(village.houses[0], "we")]
        self.assertEqual(ours, [(dog.public, "superseded")])
        self.assertEqual(self.met(copy, "they"), [])
