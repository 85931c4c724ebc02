"""Tests of automatic renewal over a year and a half of virtual time."""

from __future__ import annotations

from twisted.internet.defer import Deferred, succeed

from middleware.admission.certificate import verify_certificate
from middleware.admission.renewal import MAX_RENEWALS_PER_SCAN
from middleware.admission.statement import DEFAULT_LIFE_S
from tests.middleware.admission.village import DAY, House, Village, VillageCase

STEP_DAYS, STEP_S = 5, 12.0
"""The wall clock advances by ``STEP_DAYS`` each time that the nodes have run for ``STEP_S`` seconds."""


class Years(Village):
    """A simulated team with a wall clock that advances faster than the nodes' monotonic clock."""

    def live(self, days: int) -> None:
        """Let ``days`` pass on the wall clock while the nodes run."""
        for _ in range(days // STEP_DAYS):
            self.days += STEP_DAYS
            self.run(STEP_S)

    def end_of(self, house: House, at: int = 0) -> int:
        """Return when the certificate of ``house`` expires.

        The date is read from the membership list of the node with index ``at``.
        """
        member = self.houses[at].team.admission.find_member(house.public)
        assert member is not None
        return member.not_after


class YearsCase(VillageCase):
    """A test with a ``Years`` team."""

    def years(self, bootstraps: int = 2) -> Years:
        """Return a team of five, of which the first ``bootstraps`` are bootstrap nodes; it stops when the test ends."""
        years = self.kept(Years(bootstraps=bootstraps))
        for name in ("dog", "cat", "pig", "cow")[: 5 - bootstraps]:
            years.welcome(name)
        years.run(5.0)
        return years


class YearAndAHalfTests(YearsCase):
    def test_nobody_attends(self) -> None:
        """All five members are renewed.

        A member that was off for 60 days returns, and a revoked member stays rejected.
        """
        years = self.years()
        vaio, boot, dog, cat, pig = years.houses
        publics = [house.public for house in years.houses]
        years.live(300)
        years.close(dog)
        years.live(60)
        years.open(dog)
        years.run(10.0)
        self.assertEqual(self.refusal(years, dog.node.call, cat, 3.0), "")
        years.tell(years.signer.revoke(pig.public, "pig", years.wall()))
        years.live(190)
        self.assertEqual([years.members(place) for place in range(4)], [["boot1", "cat", "dog", "vaio"]] * 4)
        self.assertEqual([house.public for house in years.houses], publics)
        for house in (vaio, boot, dog, cat):
            self.assertGreater(years.end_of(house), years.wall() + DEFAULT_LIFE_S / 3 - 20 * DAY)
            self.assertEqual(self.refusal(years, house.node.call, years.houses[(house.place + 1) % 4], 3.0), "")
        self.assertEqual(self.refusal(years, pig.node.call, vaio, 3.0), "revoked")

    def test_one_bootstrap_node(self) -> None:
        """A single bootstrap node renews itself and all other members, also across restarts."""
        years = self.years(bootstraps=1)
        years.live(300)
        for house in years.houses:
            years.close(house)
        years.run(2.0)
        for house in years.houses:
            years.open(house)
        years.live(250)
        self.assertEqual(years.members(1), ["cat", "cow", "dog", "pig", "vaio"])
        self.assertEqual(years.houses[0].team.admission.me.renewer, years.houses[0].public)

    def test_a_bootstrap_node_is_gone_for_good(self) -> None:
        """If one of two bootstrap nodes is lost, the other bootstrap node renews itself and all members."""
        years = self.years()
        years.live(200)
        years.close(years.houses[1], is_sudden=True)
        years.live(500)
        self.assertEqual(years.members(2), ["cat", "dog", "pig", "vaio"])
        years.open(years.houses[1])


class LargeTeamTests(YearsCase):
    def test_not_in_sight(self) -> None:
        """In a large team a bootstrap node renews members that are not its contacts only if a lookup finds them."""
        years = self.years(bootstraps=1)
        vaio, dog, cat = years.houses[:3]
        years.close(cat, is_sudden=True)
        overlay = vaio.node.overlay
        self.patch(overlay, "find_contact", lambda node_id: None)
        answers: list[bool] = []
        for house in (dog, cat):
            member = vaio.team.admission.find_member(house.public)
            assert member is not None
            Deferred.fromCoroutine(vaio.team._is_reachable(member)).addCallback(answers.append)
            years.run(20.0)
        self.assertEqual(answers, [True, False])
        years.open(cat)


class BatchTests(YearsCase):
    def test_a_few_at_once(self) -> None:
        """A bootstrap node signs at most ``MAX_RENEWALS_PER_SCAN`` renewals per scan, until all members are renewed."""
        years = self.years(bootstraps=1)
        for number in range(MAX_RENEWALS_PER_SCAN + 3):
            years.tell(years.signer.grant(bytes([number]) * 32, f"p{number}", ("device",), years.wall()))
        team = years.houses[0].team
        self.patch(team, "_may_be_reachable", lambda member: True)
        self.patch(team, "_is_reachable", lambda member: succeed(True))
        years.days += 300
        years.run(6.0)
        before = len([each for each in team.list_members() if each.renewer])
        self.assertEqual(before, MAX_RENEWALS_PER_SCAN)
        years.days += 1
        years.run(6.0)
        self.assertEqual({bool(each.renewer) for each in team.list_members()}, {True})


class SleeperTests(YearsCase):
    def slept(self, years: Years, house: House) -> None:
        """Switch ``house`` off before its certificate is due for renewal, until it has expired."""
        years.live(230)
        years.close(house)
        years.live(160)

    def test_renewed_by_the_operator(self) -> None:
        """If a member's certificate expired while the member was off, it is rejected until the operator renews it."""
        years = self.years()
        vaio, _, dog, cat, _ = years.houses
        before = dog.kept.membership
        self.slept(years, dog)
        self.assertNotIn("dog", years.members())
        known = [(each.name, why) for each, why in vaio.team.membership_list.list_known_members(years.wall()) if why]
        self.assertEqual(known, [("dog", "expired")])
        years.open(dog)
        years.run(10.0)
        for house in (vaio, cat):
            self.assertEqual(self.refusal(years, dog.node.call, house, 3.0), "expired")
        years.live(20)
        self.assertNotIn("dog", years.members())
        years.tell(years.signer.grant(dog.public, "dog", ("device",), years.wall()))
        years.run(30.0)
        self.assertEqual(self.refusal(years, dog.node.call, cat, 3.0), "")
        self.assertEqual((dog.name, dog.team.admission.me.check_dates(years.wall())), ("dog", ""))
        self.assertGreater(
            verify_certificate(before.operator, dog.public, dog.kept.membership.certificate).not_after, years.wall()
        )
        self.assertEqual(years.members(dog.place), years.members())

    def test_renewed_while_it_sleeps(self) -> None:
        """A member that the operator renewed while it was off rejoins immediately with its old certificate."""
        years = self.years()
        vaio, _, dog, cat, _ = years.houses
        self.slept(years, dog)
        years.tell(years.signer.grant(dog.public, "dog", ("device",), years.wall()))
        years.live(STEP_DAYS)
        years.open(dog)
        years.run(10.0)
        self.assertEqual(self.refusal(years, dog.node.call, cat, 3.0), "")
        years.live(300)
        self.assertIn("dog", years.members())
