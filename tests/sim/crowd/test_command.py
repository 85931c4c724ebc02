"""Tests of ``sim.robots.crowd.command``, ``search`` and ``picture``, with a stub team."""

from __future__ import annotations

import json
import signal
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any

import numpy as np
from twisted.trial.unittest import SynchronousTestCase

from middleware.entangled.clock import HeapClock
from sim.robots.crowd.command import MakeTeam, main
from sim.robots.crowd.controller import Controller, stand
from sim.robots.crowd.crowd import Crowd
from sim.robots.crowd.picture import INK, OTHER, draw_svg
from sim.robots.crowd.scene import CrowdScene, make_square_scene
from sim.robots.crowd.search import AgentStatus, format_table, run_search
from sim.robots.crowd.simulator import CrowdSimulator


class PlayedTeam:
    """A stub team whose agents know their distance to the target.

    They choose the nearest agent, which then reaches the target.
    """

    def __init__(
        self,
        seed: int,
        agents: int,
        scene: CrowdScene,
        controller: Controller = stand,
        stopwatch: Callable[[], float] = lambda: 0.0,
        choose: Any = min,
    ) -> None:
        self.clock = HeapClock()
        self.switchboard: Any = SimpleNamespace(counters=Counter(sent=0), digest=lambda: "0" * 64)
        self.simulator = CrowdSimulator(self.clock, Random(seed), scene, agents, controller, stopwatch)
        self.simulator.start()
        self._choose = choose

    def assign(self) -> None:
        """Count ten datagrams."""
        self.switchboard.counters["sent"] += 10

    def get_statuses(self) -> Mapping[str, AgentStatus]:
        """Return the status of each agent; before the target is placed, a status contains no cost."""
        crowd, target = self.simulator.crowd, self.simulator.crowd.target
        if target is None:
            return {name: AgentStatus(None, "") for name in self.simulator.names}
        gaps = np.hypot(crowd.x - target.x, crowd.y - target.y)
        costs = {name: float(gaps[body]) for body, name in enumerate(self.simulator.names)}
        chosen = self._choose(costs, key=costs.__getitem__) if self.clock.seconds() > 6.0 else ""
        return {name: AgentStatus(cost, chosen) for name, cost in costs.items()}

    def find_finisher(self) -> str | None:
        """Return the chosen agent once it has reached the target."""
        return next(iter(self.get_statuses().values())).assigned if self.clock.seconds() > 7.0 else None

    def stop(self) -> None:
        """Do nothing: the stub has no nodes."""


class ImpatientTeam(PlayedTeam):
    """A stub team that receives Ctrl-C after the task is assigned."""

    def assign(self) -> None:
        """Schedule SIGINT."""
        self.clock.callLater(0.02, signal.raise_signal, signal.SIGINT)


class SearchTests(SynchronousTestCase):
    def test_moments_are_noted(self) -> None:
        """``search`` records when agents take part, see the target, agree and arrive.

        It also records whether the agent that arrived was the nearest one.
        """
        outcome = run_search(PlayedTeam(1, 4, make_square_scene(9)), 1, 60.0, lambda: 0.0)
        self.assertEqual((outcome.engaged, outcome.first, outcome.found), (0.5, 5.0, 4))
        self.assertEqual((outcome.agree, outcome.reach, outcome.right), (6.5, 7.5, True))
        self.assertEqual((outcome.datagrams, len(outcome.trail)), (10, 3))
        self.assertIn(f"7.5 s by {outcome.by}", format_table(outcome))
        wrong = run_search(PlayedTeam(1, 4, make_square_scene(9), choose=max), 1, 60.0, lambda: 0.0)
        self.assertEqual((wrong.right, "NO" in format_table(wrong)), (False, True))

    def test_limit_and_end_leave_a_report(self) -> None:
        """A search that its time limit or ``is_over`` ends early reports the results so far."""
        team = PlayedTeam(1, 4, make_square_scene(9))
        short = run_search(team, 1, 2.0, lambda: 0.0)
        ended = run_search(team, 1, 60.0, lambda: 0.0, is_over=lambda: team.clock.seconds() > 3.22)
        for outcome, seconds in ((short, 2.0), (ended, 1.25)):
            self.assertEqual((outcome.seconds, outcome.reach, outcome.right), (seconds, None, None))
            self.assertIn("- by nobody", format_table(outcome))


class CommandTests(SynchronousTestCase):
    def run_with(self, *words: str, team: MakeTeam | None = None) -> tuple[int, str]:
        """Run the command and return its exit code and output."""
        told = StringIO()
        with redirect_stdout(told), redirect_stderr(told):
            try:
                code = main(words, team)
            except SystemExit as error:
                code = int(str(error.code))
        return code, told.getvalue()

    def test_crowd_alone(self) -> None:
        """A crowd without agents prints its results, writes both files, and gives the same digest in two runs."""
        folder = Path(self.mktemp())
        folder.mkdir()
        picture, figures = folder / "a.svg", folder / "a.json"
        words = ("--bodies", "40", "--seconds", "6", "--controller", "disperse", "--seed", "5")
        code, told = self.run_with(*words, "--picture", str(picture), "--json", str(figures))
        self.assertEqual(code, 0, told)
        rows = json.loads(figures.read_text(encoding="utf-8"))
        self.assertEqual((rows["robots"], rows["controller"]), (40, "disperse"))
        self.assertIn("real time factor", told)
        self.assertIn(rows["digest"], self.run_with(*words)[1])
        self.assertNotIn(rows["digest"], self.run_with(*words[:-1], "6")[1])
        self.assertTrue(ET.fromstring(picture.read_text(encoding="utf-8")).tag.endswith("svg"))

    def test_search_with_agents(self) -> None:
        """With agents the table of the search is printed; the exit code is 0 if an agent arrived, and 1 otherwise."""
        code, told = self.run_with("--bodies", "9", "--agents", "4", team=PlayedTeam)
        self.assertEqual(code, 0, told)
        self.assertIn("4 agents joined", told)
        self.assertIn("it was the nearest of those           yes", told)
        code, told = self.run_with("--bodies", "9", "--agents", "4", "--seconds", "2", team=PlayedTeam)
        self.assertEqual(code, 1, told)

    def test_interrupt_leaves_the_table(self) -> None:
        """Ctrl-C ends a search; its table and file are written, and the previous signal handler is restored."""
        folder, usual = Path(self.mktemp()), signal.getsignal(signal.SIGINT)
        folder.mkdir()
        words = ("--bodies", "9", "--agents", "4", "--json", str(folder / "a.json"))
        code, told = self.run_with(*words, team=ImpatientTeam)
        self.assertEqual((code, "- by nobody" in told), (1, True), told)
        self.assertLess(json.loads((folder / "a.json").read_text(encoding="utf-8"))["seconds"], 0.5)
        self.assertEqual(signal.getsignal(signal.SIGINT), usual)

    def test_wrong_words_are_refused(self) -> None:
        """Invalid arguments are rejected before the simulation starts; the error is one line with a remedy."""
        for words, problem in (
            (("--bodies", "0"), "bodies must be"),
            (("--room", "0.01"), "room must be"),
            (("--seconds", "0"), "--seconds must be"),
            (("--seconds", "nan"), "--seconds must be"),
            (("--seed", "-1"), "--seed must be"),
            (("--controller", "dance"), "invalid choice"),
            (("--agents", "3"), "run swarm crowd instead"),
            (("--picture", "/nowhere/at/all.svg"), "does not exist"),
            (("--bodies", "121", "--room", "0.0677", "--seconds", "1"), "no position near the centre is free"),
        ):
            code, told = self.run_with(*words)
            self.assertEqual(code, 2, told)
            self.assertIn(problem, told)
        for agents in ("10", "-1"):
            code, told = self.run_with("--bodies", "9", "--agents", agents, team=PlayedTeam)
            self.assertEqual(code, 2, told)
            self.assertIn("--agents must be from 0 to the number of robots, 9", told)


class PictureTests(SynchronousTestCase):
    def test_draws_everybody(self) -> None:
        """Each robot is drawn once in the colour of its state; the target, a caption and a legend are drawn as well."""
        crowd = Crowd(1, make_square_scene(30))
        crowd.place_target_at_random()
        going = "the one that goes"
        svg = draw_svg(crowd, "a < b", {3: going}, [(1.0, 1.0), (2.0, 2.0)])
        ET.fromstring(svg)
        self.assertEqual(svg.count("h0"), 30)
        for words in ("a &lt; b", INK[going], INK[OTHER], going, OTHER):
            self.assertIn(words, svg)
        self.assertNotIn("agents that search", svg)
