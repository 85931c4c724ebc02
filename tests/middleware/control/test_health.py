"""Tests of the health report of a running node and of the measurements of its links."""

from __future__ import annotations

from typing import Any

from twisted.internet.defer import Deferred
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.contact import Contact
from middleware.entangled.control.health import FEW_PEERS, IDLE_S, PINGS, LinkMetrics, measure_links, read_health
from middleware.entangled.control.link_quality import compute_quality
from middleware.entangled.network.switchboard import LinkConditions
from tests.fleet import FleetCase, SwarmTeam


class LinkMetricsTests(FleetCase):
    def setUp(self) -> None:
        super().setUp()
        self.team: SwarmTeam = self.swarm(3, weather=LinkConditions(delay_s=0.01))
        self.team.run(3.0)
        self.metrics: LinkMetrics = self.team.nodes[0].link_metrics

    def measured(self) -> dict[str, dict[str, Any]]:
        return {each["id"]: each for each in self.metrics.read()}

    def test_answer_at_once(self) -> None:
        """The first report lists the paths without measurements; a second later it has the results of ten probes."""
        first = self.measured()
        self.assertEqual(set(first), {node.uuid for node in self.team.nodes[1:]})
        for each in first.values():
            self.assertEqual((each["way"], each["by"], each["round_trip"], each["loss"]), ("machine", "", None, None))
        self.team.run(1.5)
        for each in self.measured().values():
            self.assertEqual((round(each["round_trip"], 3), each["loss"], round(each["jitter"], 4)), (0.02, 0.0, 0.0))
            self.assertGreater(each["for"], 2.0)

    def test_see_what_gets_worse(self) -> None:
        """Loss that starts during the measurement is reported within ten seconds."""
        self.measured()
        self.team.run(3.0)
        self.team.switchboard.conditions = LinkConditions(delay_s=0.01, loss=0.3)
        losses = []
        for _ in range(5):
            self.team.run(2.0)
            losses.append(max(each["loss"] or 0.0 for each in self.measured().values()))
        self.assertEqual(losses[0] <= 0.5 and max(losses) > 0.1, True, losses)

    def test_end_when_nobody_looks(self) -> None:
        """If no report is requested for ``IDLE_S`` seconds, the measurement stops; the next report starts it again."""
        asked: list[float] = []

        def answer(peer: object, said: bytes) -> bytes:
            asked.append(self.team.clock.seconds())
            return said

        self.team.nodes[1].entangled.endpoint.expose("ping", answer, changes=True)
        self.team.run(10.0)
        usual = len(asked)
        self.measured()
        self.team.run(10.0)
        self.assertGreater(len(asked), 2 * usual + 15)
        self.team.run(IDLE_S)
        asked.clear()
        self.team.run(10.0)
        self.assertEqual(len(asked), usual)
        self.assertEqual([each["loss"] for each in self.measured().values()], [None, None])

    def test_many_peers_cost_no_more(self) -> None:
        """A node sends at most 10 probes per second (100 initially), for any number of peers."""
        large = self.swarm(24, weather=LinkConditions(delay_s=0.003))
        large.run(3.0)
        asked: list[float] = []

        def answer(peer: Contact, said: bytes) -> bytes:
            asked.extend([large.clock.seconds()] * (peer.node_id.hex() == large.nodes[0].uuid))
            return said

        metrics = large.nodes[0].link_metrics
        peers = {each["id"] for each in metrics.read()}
        self.assertGreater(len(peers), 2 * FEW_PEERS)
        for node in large.nodes[1:]:
            node.entangled.endpoint.expose("ping", answer, changes=True)
        for seconds, most in ((1.0, 100.0), (2.0, 100.0), (5.0, 10.0)):
            before = len(asked)
            metrics.read()
            large.run(seconds)
            self.assertLess(len(asked) - before, most * seconds + 2 * len(peers), seconds)


class HealthTests(FleetCase):
    def test_health(self) -> None:
        """The health report contains the contacts, the number of stored records and its limit, and no rejections."""
        fleet = self.fleet(3)
        said = read_health(fleet.nodes[1])
        self.assertEqual((said["contacts"], said["trouble"], said["refusals"]), (2, "", []))
        self.assertGreater(said["max_rows"], said["rows"])
        self.assertEqual(said["address"], str(fleet.address(1)))

    def test_links(self) -> None:
        """Small requests measure each peer's round-trip time; for a failed peer the measurement reports no answer."""
        fleet = self.fleet(3, weather=LinkConditions(delay_s=0.02))
        fleet.run(3.0)
        fleet.kill(2)
        asked = Deferred.fromCoroutine(measure_links(fleet.nodes[0], fleet.clock))
        found = {each["id"]: each for each in self.done(fleet, asked, 30.0)}
        live, dead = (found[fleet.nodes[place].identity.node_id.hex()] for place in (1, 2))
        self.assertEqual(len(live["times"]), PINGS)
        self.assertEqual({round(seconds, 3) for seconds in live["times"]}, {0.04})
        self.assertEqual((set(dead["times"]), dead["relayed"]), ({None}, False))


class LinkQualityTests(SynchronousTestCase):
    def test_scores(self) -> None:
        """A stable peer on the same LAN has score 100, a barely reachable peer 1, and an unreachable peer 0."""
        rows: list[tuple[list[float | None], bool, int]] = [
            ([0.002, 0.0021, 0.0019, 0.002], False, 100),
            ([0.4, 0.9, None, None, None, None], True, 1),
            ([None] * 10, False, 0),
        ]
        for times, is_relayed, score in rows:
            self.assertEqual(compute_quality(times, is_relayed).score, score)
        self.assertEqual((compute_quality([None], False).loss, compute_quality([None], False).round_trip), (1.0, None))

    def test_a_second_try_counts_as_a_loss(self) -> None:
        """A reply after a retransmission counts as a loss, and does not affect the round-trip time."""
        found = compute_quality([0.002] * 8 + [0.055, 0.11], False)
        self.assertEqual((found.loss, found.round_trip), (0.2, 0.002))
        found = compute_quality([0.1] * 8 + [0.26, None], False)
        self.assertEqual((round(found.loss, 3), found.round_trip), (0.2, 0.1))

    def test_each_trouble_costs(self) -> None:
        """Loss, delay, jitter and a relay each lower the score, and more of each lowers the score further."""
        best = compute_quality([0.002] * 10, False).score
        lossy = [compute_quality([0.002] * (10 - n) + [None] * n, False).score for n in (1, 2, 3)]
        late = [compute_quality([seconds] * 10, False).score for seconds in (0.05, 0.1, 0.2)]
        shaky = [compute_quality([0.02 - by, 0.02 + by] * 5, False).score for by in (0.005, 0.01)]
        for scores in (lossy, late, shaky, [compute_quality([0.002] * 10, True).score]):
            self.assertEqual([best, *scores], sorted([best, *scores], reverse=True))
            self.assertLess(scores[0], best)
