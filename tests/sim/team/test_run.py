"""Tests of simulated runs: faults, sessions and outcomes."""

from __future__ import annotations

from dataclasses import dataclass, replace

from twisted.logger import Logger
from twisted.python.failure import Failure
from twisted.trial.unittest import SynchronousTestCase

from sim.team.disk import SimulatedDisk
from sim.team.faults.settings import Fault
from sim.team.link import LinkSettings
from sim.team.metric import Bound, Metric
from sim.team.run import DONE, JOINING, RUNNING, Run
from sim.team.scenario import Clocks, Join, Scenario, Sessions
from sim.team.team import Team
from sim.team.workload import Workload, WorkloadKind


@dataclass(frozen=True)
class _Nothing:
    pass


class _Steps(Workload):
    """A workload that counts its steps and reports the given violations."""

    found: tuple[str, ...] = ()

    def __init__(self, team: Team, settings: object) -> None:
        self.team = team
        self.steps: list[float] = []
        self.settled_at = 0.0

    def step(self) -> None:
        self.steps.append(self.team.clock.seconds())

    def make_final_requests(self) -> None:
        self.settled_at = self.team.clock.seconds()

    def find_violations(self) -> list[str]:
        return list(self.found)

    def collect_metrics(self) -> list[Metric]:
        return [Metric("steps", len(self.steps))]


class _Finds(_Steps):
    found = ("E1: something is wrong",)


KINDS = {"steps": WorkloadKind(_Nothing, _Steps), "finds": WorkloadKind(_Nothing, _Finds)}
JOIN = Join(pause=0.2, settle=1.0)
BASE = Scenario(nodes=6, seconds=10.0, join=JOIN, loads=(("steps", _Nothing()),))


class RunTests(SynchronousTestCase):
    """Tests of ``Run``, its faults and its sessions."""

    def record_events(self, scenario: Scenario, seed: int = 1) -> tuple[Run, list[tuple[float, str, int]]]:
        """Run a scenario to its end; return the run and the events after the team was complete."""
        run = Run(scenario, seed, KINDS)
        events: list[tuple[float, str, int]] = []
        run.team.event_listeners.append(lambda now, event, place, more: events.append((now, event, place)))
        run.run()
        began = run.began_at or 0.0
        return run, [(round(now - began, 6), event, place) for now, event, place in events if now >= began]

    def test_workloads_act_while_it_lasts(self) -> None:
        """Workloads step at the scenario's interval, and are notified when the repair ends.

        The values that they measure are compared with the targets.
        """
        run = Run(replace(BASE, repair=5.0, targets=(("steps", Bound(19)),)), 1, KINDS)
        outcome = run.run()
        workload = run.workloads[0][1]
        assert isinstance(workload, _Steps) and run.began_at is not None
        self.assertEqual([round(at - run.began_at, 3) for at in workload.steps], [n / 2 for n in range(20)])
        self.assertAlmostEqual(workload.settled_at, run.began_at + 15.0)
        self.assertEqual([(f.name, f.value, f.holds) for f in outcome.missed], [("steps", 20, False)])
        self.assertEqual((outcome.phase, outcome.is_partial, outcome.violations), (DONE, False, []))
        self.assertAlmostEqual(outcome.seconds, run.expected_end)

    def test_workloads_wait_for_their_lead(self) -> None:
        """If the scenario has a ``lead`` time, the workloads start only after that time."""
        run = Run(replace(BASE, lead=7.5), 1, KINDS)
        run.run()
        workload = run.workloads[0][1]
        assert isinstance(workload, _Steps) and run.began_at is not None
        self.assertEqual(round(workload.steps[0] - run.began_at, 3), 7.5)
        self.assertEqual(len(workload.steps), 5)

    def test_violations_and_unknown_targets_are_told(self) -> None:
        """The outcome lists the violations of the workloads; a target without a measured value is also a violation."""
        scenario = replace(BASE, loads=(("finds", _Nothing()),), targets=(("stops", Bound(1)),))
        found = Run(scenario, 1, KINDS).run().violations
        self.assertEqual(found, ["targets: nothing measured 'stops'; there are steps", "E1: something is wrong"])

    def test_it_can_be_ended_at_any_moment(self) -> None:
        """A run that is ended while nodes join, or later, has a partial outcome."""
        for end, phase in ((0.5, JOINING), (6.0, RUNNING)):
            run = Run(BASE, 1, KINDS, lambda run, end=end: run.team.clock.seconds() >= end)  # type: ignore[misc]
            outcome = run.run()
            self.assertEqual((outcome.phase, outcome.is_partial), (phase, True))
            self.assertLess(outcome.seconds, end + 0.5)
            self.assertEqual(len(outcome.digest), 32)

    def test_slow_machine_is_watched_as_often(self) -> None:
        """On a slow machine the steps become shorter, so ``watched`` is still called often; the digest is the same."""
        watched: dict[bool, list[float]] = {False: [], True: []}
        digests = []
        for is_slow, seen in watched.items():
            real = [0.0]

            def look(run: Run, seen: list[float] = seen) -> bool:
                seen.append(run.team.clock.seconds())
                return False

            def seconds(real: list[float] = real, is_slow: bool = is_slow) -> float:
                real[0] += 0.6 if is_slow and real[0] < 6.0 else 0.0
                return real[0]

            digests.append(Run(replace(BASE, seconds=1.0), 1, KINDS, watched=look, seconds=seconds).run().digest)
        self.assertEqual(digests[0], digests[1])
        gaps = [min(b - a for a, b in zip(seen, seen[1:], strict=False) if b > a) for seen in watched.values()]
        self.assertEqual(gaps[1] < 0.01 < gaps[0], True, gaps)
        end = Run(BASE, 1, KINDS, watched=lambda run: run.team.clock.seconds() > 0.1, seconds=lambda: 0.0).run()
        self.assertTrue(end.is_partial)

    def test_who_is_not_in_is_a_violation(self) -> None:
        """A node that does not join within the time limit causes a violation."""
        link = LinkSettings("none", loss=0.9)
        scenario = replace(BASE, link=link, join=replace(JOIN, within=1.0), seconds=0.0)
        self.assertIn("nodes have not joined", Run(scenario, 1, KINDS).run().violations[0])

    def test_exception_is_a_violation(self) -> None:
        """An exception in a call and a logged failure are violations; neither ends the run."""
        run = Run(BASE, 1, KINDS)
        run.team.schedule(3.0, lambda: 1 // 0)
        run.team.schedule(4.0, lambda: Logger().failure("a node's own", Failure(KeyError("x"))))
        outcome = run.run()
        self.assertFalse(outcome.is_partial)
        self.assertEqual(
            [line.rpartition(":")[0] for line in outcome.violations],
            ["exception: ZeroDivisionError at 3.000 s", "exception: KeyError at 4.000 s"],
        )
        self.assertEqual(len(self.flushLoggedErrors(ZeroDivisionError, KeyError)), 2)

    def test_power_fails_and_comes_back(self) -> None:
        """Half of the nodes crash one after another at the planned times, and each restarts after the outage."""
        crash = Fault("crash", 2.0, lasts=3.0, share=0.5, over=1.5)
        _, events = self.record_events(replace(BASE, faults=(crash,)))
        killed = [(at, place) for at, event, place in events if event == "killed"]
        born = [(at, place) for at, event, place in events if event == "born"]
        self.assertEqual([at for at, _ in killed], [2.0, 2.5, 3.0])
        self.assertEqual(born, [(at + 3.0, place) for at, place in killed])

    def test_healing_brings_all_back(self) -> None:
        """All faults end before the repair starts: no node is then cut off, frozen or down, and no disk is full."""
        faults = tuple(
            Fault(kind, 1.0, lasts=99.0, count=2, amount=1.1 if kind == "rate" else 0.0)
            for kind in ("crash", "leave", "freeze", "cut", "deaf", "mute", "clog", "rate", "full")
        )
        faults += Fault("pairs", 1.0, lasts=99.0, share=0.2), Fault("weather", 1.0, lasts=99.0, amount=0.2)
        faults += Fault("step", 1.0, lasts=99.0, count=3, amount=-3600.0), Fault("crowd", 1.0, count=2)
        run, events = self.record_events(replace(BASE, nodes=8, faults=faults, repair=60.0))
        team = run.team
        self.assertEqual(len([1 for _, event, _ in events if event == "fault"]), len(faults))
        self.assertEqual((team.alive(), sorted(team.get_joined())), (list(range(10)), list(range(10))))
        self.assertEqual(team.switchboard.barriers, [])
        self.assertAlmostEqual(team.link.extra_loss, 0.0)
        for place in team.places:
            here = team.get_state(place)
            assert here.machine is not None
            self.assertFalse(here.machine.is_frozen)
            self.assertAlmostEqual(here.rate, 1.0)
            self.assertAlmostEqual(here.wall_error, 0.0)
            self.assertEqual(here.store.write_error, "")
        known = [len(team.get_entangled(place).overlay.contacts()) for place in team.alive()]
        self.assertEqual(known, [9] * 10)

    def test_what_lasts_ends_at_its_time(self) -> None:
        """A partition, extra loss, a fast or wrong clock, a full disk and a frozen node end when the fault ends."""
        faults = tuple(
            Fault(kind, 2.0, lasts=3.0, places=(1,), amount=1.5 if kind == "rate" else -60.0 if kind == "step" else 0.0)
            for kind in ("cut", "freeze", "rate", "full", "step")
        ) + (Fault("weather", 2.0, lasts=3.0, amount=0.25),)
        seen: dict[float, tuple[object, ...]] = {}

        def looked(run: Run) -> bool:
            here, at = run.team.get_state(1), run.team.clock.seconds() - (run.began_at or 99.0)
            if here.machine is not None and isinstance(here.store, SimulatedDisk):
                still, full = here.machine.is_frozen, here.store.is_full
                seen[at] = (
                    len(run.team.switchboard.barriers),
                    run.team.link.extra_loss,
                    still,
                    here.rate,
                    full,
                    here.wall_error,
                )
            return False

        Run(replace(BASE, faults=faults), 1, KINDS, looked).run()
        calm, bad = (0, 0.0, False, 1.0, False, 0.0), (1, 0.25, True, 1.5, True, -60.0)
        self.assertEqual({seen[at] for at in seen if 0 <= at < 1.9 or at > 5.1}, {calm})
        self.assertEqual({seen[at] for at in seen if 2.1 < at < 4.9}, {bad})

    def test_crowd_comes_and_goes(self) -> None:
        """New nodes, with new indices, join during the time ``over`` of the fault, and leave after its ``lasts``."""
        run, events = self.record_events(replace(BASE, faults=(Fault("crowd", 1.0, lasts=4.0, count=4, over=2.0),)))
        self.assertEqual(
            [(at, p) for at, event, p in events if event == "born"], [(1 + n / 2, 6 + n) for n in range(4)]
        )
        self.assertEqual(
            [(at, p) for at, event, p in events if event == "left"], [(5 + n / 2, 6 + n) for n in range(4)]
        )
        self.assertEqual(run.team.alive(), list(range(6)))

    def test_sessions_end_and_others_begin(self) -> None:
        """Nodes leave at the rate that follows from the mean durations, and return after a break; at least two stay."""
        sessions = Sessions("exponential", 10.0, 2.0)
        run, events = self.record_events(replace(BASE, nodes=12, seconds=60.0, sessions=sessions))
        ended = [event for _, event, _ in events if event == "killed"]
        stays = sessions.session_durations
        assert stays is not None
        expected = 12 * 60.0 / (stays.mean + sessions.absence_durations.mean)
        self.assertApproximates(len(ended) / expected, 1.0, 0.35)
        self.assertGreaterEqual(len(run.team.living), 2)
        self.assertGreater(len([1 for _, event, _ in events if event == "born"]), 0.7 * len(ended))

    def test_sessions_may_bring_others(self) -> None:
        """If ``same`` is false, a node that left is replaced by a node with a different identity."""
        run = Run(replace(BASE, seconds=40.0, sessions=Sessions("fixed", 15.0, 2.0, 0.5, same=False)), 1, KINDS)
        before = [run.team.identity(place) for place in range(6)]
        run.run()
        self.assertTrue(all(run.team.identity(place) != before[place] for place in range(6)))

    def test_same_seed_gives_the_same_hash(self) -> None:
        """Two runs of a seed with faults and sessions have equal digests; a different seed gives a different digest."""
        scenario = replace(
            BASE,
            link=LinkSettings("wifi", loss=0.05, burst=0.05, duplicate=0.05, reorder=0.05),
            clocks=Clocks(0.01, 60.0),
            sessions=Sessions("weibull", 20.0, 3.0, 0.3),
            faults=(Fault("freeze", 1.0, lasts=3.0, count=2), Fault("cut", 5.0, lasts=3.0, share=0.4)),
            repair=5.0,
        )
        hashes = [Run(scenario, seed, KINDS).run().digest for seed in (5, 5, 6)]
        self.assertEqual(hashes[0], hashes[1])
        self.assertNotEqual(hashes[0], hashes[2])
