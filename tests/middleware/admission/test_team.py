"""Tests of whole closed teams: join by code, revocation, rotation, promotion."""

from __future__ import annotations

from twisted.logger import capturedLogs, formatEvent

from middleware.admission.errors import NotWelcome
from middleware.entangled.errors import NoAnswer, NotAcknowledged
from middleware.entangled.network.network import Address
from tests.middleware.admission.paper import operator
from tests.middleware.admission.village import VillageCase


class JoiningTests(VillageCase):
    def test_join_by_code(self) -> None:
        """A newcomer with a code gets a certificate, the secret and contacts, and then exchanges messages."""
        village = self.village()
        dog = village.welcome("dog")
        self.assertEqual((dog.name, dog.team.admission.me.roles), ("dog", ("device",)))
        village.run(3.0)
        self.assertEqual(village.members(), ["dog", "vaio"])
        self.assertEqual(self.refusal(village, village.houses[0].node.call, dog), "")

    def test_same_newcomer_again(self) -> None:
        """A newcomer that repeats its request at a different bootstrap node gets the same certificate again."""
        village = self.village(bootstraps=2)
        code, seed = village.invite(), b"d" * 32
        passes = []
        for door in (0, 1):
            knocked = village.knock(code, (door,), seed=seed)
            village.run(3.0)
            passes.append(self.successResultOf(knocked).certificate)
        self.assertEqual(passes[0], passes[1])

    def test_expired_and_unknown_code(self) -> None:
        """An expired code is rejected as "expired", a code of another team as "unknown"."""
        village = self.village()
        code = village.invite(expires=10.0)
        village.run(10.0)
        late, foreign = village.knock(code), village.knock(self.village(seed=2).invite(), timeout=3.0)
        village.run(4.0)
        self.assertEqual(self.failureResultOf(late, NotWelcome).value.code, "expired")
        self.assertEqual(self.failureResultOf(foreign, NotWelcome).value.code, "unknown")

    def test_nobody_there(self) -> None:
        """If no node replies, the newcomer's error contains the address that it tried."""
        village = self.village()
        knocked = village.knock(village.invite(), (77,), timeout=2.0)
        village.run(2.5)
        self.assertIn(str(village.address(77)), str(self.failureResultOf(knocked, NoAnswer).value))

    def test_second_bootstrap(self) -> None:
        """If the first bootstrap node is down, the newcomer joins through the second bootstrap node."""
        village = self.village(bootstraps=3)
        code = village.invite()
        village.close(village.houses[1], is_sudden=True)
        knocked = village.knock(code, (1, 2))
        village.run(15.0)
        self.assertEqual(self.successResultOf(knocked).member.name, "dog")

    def test_member_that_is_no_bootstrap(self) -> None:
        """A member that is not a bootstrap node rejects a newcomer with the code "role".

        After the promotion to bootstrap node, this member admits the newcomer without a restart.
        """
        village = self.village()
        dog = village.welcome("dog")
        code = village.invite("cat")
        village.run(2.0)
        refused = village.knock(code, (1,), timeout=2.0)
        village.run(3.0)
        self.assertEqual(self.failureResultOf(refused, NotWelcome).value.code, "role")
        village.tell(village.signer.grant(dog.public, "dog", ("device", "bootstrap"), village.wall()))
        village.run(2.0)
        knocked = village.knock(code, (1,))
        village.run(3.0)
        cat = village.move_in(self.successResultOf(knocked))
        village.run(2.0)
        self.assertEqual((cat.team.admission.me.admitter, village.members()), (dog.public, ["cat", "dog", "vaio"]))

    def test_many_by_one_code(self) -> None:
        """A code for three uses admits three newcomers with distinct names: the requested names, or numbered names."""
        village = self.village()
        code = village.invite("pupil", uses=3)
        names: list[str] = []
        for wish in ("", "kim", "", "kim"):
            knocked = village.knock(code, wish=wish)
            village.run(2.0)
            knocked.addCallbacks(lambda came: names.append(came.member.name), lambda no: names.append(no.value.code))
        self.assertEqual(names, ["pupil-1", "kim", "pupil-2", "used"])

    def test_code_made_while_the_others_are_gone(self) -> None:
        """A node that suddenly lost all peers cannot publish a code; the one-line error states the time to wait."""
        village = self.village(bootstraps=3)
        village.run(5.0)
        for house in village.houses[1:]:
            village.close(house, is_sudden=True)
        _, packed, _ = village.signer.invite("dog", ("device",), 2, village.wall(), 3600.0, village.dice)
        told = village.tell(packed)
        village.run(20.0)
        text = str(self.failureResultOf(told, NotAcknowledged).value)
        self.assertIn("in two minutes", text)
        self.assertEqual(len(text.splitlines()), 1)

    def test_uses_across_a_cut(self) -> None:
        """During a partition between bootstrap nodes a code admits no more newcomers than it has uses."""
        village = self.village(bootstraps=5)
        village.run(5.0)
        code = village.invite(uses=2)
        village.run(2.0)
        sides = [[village.address(place) for place in side] for side in ((0, 1, 2), (3, 4))]
        village.switchboard.partition([*sides[0], *self._newcomers(1, 4)], [*sides[1], *self._newcomers(4, 7)])
        village.life_count = 0
        knocks = [village.knock(code, (0,), timeout=8.0) for _ in range(3)]
        knocks += [village.knock(code, (4,), timeout=8.0) for _ in range(3)]
        came: list[str] = []
        for each in knocks:
            each.addCallbacks(lambda found: came.append("in"), lambda no: came.append(no.value.code))
        village.run(10.0)
        village.switchboard.heal()
        village.run(10.0)
        more = [village.knock(code, (place,), timeout=8.0) for place in range(5)]
        for each in more:
            each.addCallbacks(lambda found: came.append("in"), lambda no: came.append(no.value.code))
        village.run(20.0)
        self.assertEqual(came.count("in"), 2, came)
        self.assertIn("used", came)

    @staticmethod
    def _newcomers(first: int, last: int) -> list[Address]:
        return [Address("10.0.0.2", 9000 + number) for number in range(first, last)]


class RevocationTests(VillageCase):
    def test_revoked_invitation(self) -> None:
        """Revoking an invitation revokes the code and all members that joined with it."""
        village = self.village()
        code = village.invite("pupil", uses=3)
        knocked = village.knock(code)
        village.run(2.0)
        pupil = village.move_in(self.successResultOf(knocked))
        village.run(2.0)
        invitation = village.houses[0].team.membership_list.list_invitations()[0].public
        village.tell(village.signer.revoke(invitation, "pupil", village.wall()))
        village.run(2.0)
        again = village.knock(code)
        self.assertEqual(self.refusal(village, village.houses[0].node.call, pupil, 3.0), "revoked")
        self.assertEqual(self.failureResultOf(again, NotWelcome).value.code, "revoked")


class RotationTests(VillageCase):
    def test_rotation(self) -> None:
        """After a rotation all members and newcomers have the new secret, and open sessions still work."""
        village = self.village()
        houses = [village.houses[0], village.welcome("dog"), village.welcome("cat")]
        village.run(3.0)
        members = [member.public for member in houses[0].team.list_members()]
        village.tell(village.signer.rotate_secret(2, members, village.wall(), 60.0, village.dice))
        village.run(3.0)
        self.assertEqual({house.kept.membership.secrets[0][0] for house in houses}, {2})
        pig = village.welcome("pig", doors=(0,))
        self.assertEqual(pig.kept.membership.secrets[0], houses[0].kept.membership.secrets[0])
        self.assertEqual(self.refusal(village, pig.node.call, houses[2]), "")

    def slept(self, grace: float, seconds: float) -> int:
        """Return the number of the team secret of a member that was off during a rotation and ``seconds`` after it."""
        village = self.village()
        dog = village.welcome("dog")
        village.run(2.0)
        village.close(dog)
        members = [member.public for member in village.houses[0].team.list_members()]
        village.tell(village.signer.rotate_secret(2, members, village.wall(), grace, village.dice))
        village.run(seconds)
        village.open(dog)
        village.run(8.0)
        return int(dog.kept.membership.secrets[0][0])

    def test_who_slept_through_it(self) -> None:
        """A member that was off during a rotation reconnects with the old secret and receives the new one."""
        self.assertEqual(self.slept(grace=600.0, seconds=5.0), 2)

    def test_who_came_meanwhile(self) -> None:
        """A member for which the new secret was not sealed requests the secret from another member."""
        village = self.village()
        dog = village.welcome("dog")
        village.run(2.0)
        village.tell(village.signer.rotate_secret(2, [village.houses[0].public], village.wall(), 600.0, village.dice))
        village.run(12.0)
        self.assertEqual(dog.kept.membership.secrets, village.houses[0].kept.membership.secrets)

    def test_old_secret_ends(self) -> None:
        """After the grace period the old secret is rejected."""
        self.assertEqual(self.slept(grace=30.0, seconds=40.0), 1)


class StrangersTests(VillageCase):
    def test_certificate_of_another_team(self) -> None:
        """A node that has the team's secret but a certificate of another operator is rejected.

        Both nodes log this once.
        """
        village = self.village()
        first = village.houses[0].kept.membership
        stranger = operator(9).create_membership("spy", ("device",), village.wall(), village.dice, first.secrets[0][1])
        with capturedLogs() as said:
            spy = village.move_in(stranger)
            for _ in range(5):
                self.assertEqual(self.refusal(village, spy.node.call, village.houses[0]), "foreign")
        lines = [formatEvent(event) for event in said]
        for words in ("is rejected: ", "rejects this node: "):
            self.assertEqual(sum(f"{words}the certificate belongs to another team" in line for line in lines), 1)
        self.assertEqual(village.members(), ["vaio"])

    def test_stranger_is_told_where_to_look(self) -> None:
        """A node without the team's secret gets no reply, and logs once that ``swarm doctor`` finds the reason."""
        village = self.village()
        with capturedLogs() as said:
            village.move_in(operator(9).create_membership("spy", ("device",), village.wall(), village.dice))
            village.run(40.0)
        self.assertEqual(sum("swarm doctor SETTINGS" in formatEvent(event) for event in said), 1)

    def test_expired_member(self) -> None:
        """A member is removed when its certificate expires, even if it has an open session."""
        village = self.village()
        code, packed, terms = village.signer.invite(
            "dog", ("device",), 1, village.wall(), 3600.0, village.dice, life=30.0
        )
        village.tell(terms)
        village.tell(packed)
        village.run(1.0)
        knocked = village.knock(code.text)
        village.run(2.0)
        dog = village.move_in(self.successResultOf(knocked))
        village.run(20.0)
        self.assertEqual(village.members(), ["dog", "vaio"])
        village.run(20.0)
        self.assertEqual(village.members(), ["vaio"])
        self.assertEqual(self.refusal(village, village.houses[0].node.call, dog, 3.0), "expired")

    def test_expired_by_its_own_clock(self) -> None:
        """A node with an expired certificate logs this at its start, with both remedies."""
        village = self.village()
        old = village.signer.create_membership("dog", ("device",), village.wall() - 366 * 86_400.0, village.dice)
        with capturedLogs() as events:
            village.move_in(old)
        lines = [formatEvent(event) for event in events]
        [line] = [line for line in lines if "of this node" in line]
        for words in ("expired", "clock", "swarm renew"):
            self.assertIn(words, line)
