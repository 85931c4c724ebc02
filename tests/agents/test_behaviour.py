"""Tests of ``agents.behaviour``: what a task's kind may bring into a node."""

from __future__ import annotations

import random
import sys
from dataclasses import replace
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from agents.behaviour import KINDS, behaviour_for
from agents.means import Means
from middleware.errors import MissingExtra, UnknownTask
from middleware.tasks.task import Task
from tests.agents.loopback import Loopback

TASK = Task("t1", "turn-around", "Turn")


class BehaviourTests(SynchronousTestCase):
    def refusal(self, task: Task) -> str:
        """Why the task gets no behaviour."""
        return str(self.assertRaises(UnknownTask, behaviour_for, task, random.Random(1)))

    def test_known_kinds_are_made(self) -> None:
        """Each kind that is listed can be made, and knows no cost before it has looked."""
        for kind in KINDS:
            self.assertIsNone(behaviour_for(replace(TASK, kind=kind), random.Random(1)).cost)

    def test_behaviour_is_told_what_its_body_can_do(self) -> None:
        """Whoever asks for it gets the means of the body, whether it is installed or deployed; others go without."""
        told: list[Means] = []

        class Bodied:
            def __init__(self, parameters: object, rng: object) -> None: ...

            def embody(self, means: Means) -> None:
                told.append(means)

        class Other:
            def __init__(self, parameters: object, rng: object) -> None: ...

        means = Means()
        deployed = {("behaviour", "bodied"): Loopback.of(Bodied), ("behaviour", "other"): Loopback.of(Other)}
        for kind in ("deployed:bodied", "deployed:other"):
            behaviour_for(replace(TASK, kind=kind), random.Random(1), deployed, means)
        self.assertEqual([vars(each) for each in told], [vars(means)])
        turn: Any = behaviour_for(TASK, random.Random(1), None, means)
        self.assertIs(turn._means, means)

    def test_unknown_kind_names_those_there_are(self) -> None:
        """A kind that nobody knows is refused with the list of those there are."""
        self.assertEqual(
            self.refusal(replace(TASK, kind="fetch")),
            "no behaviour for tasks of kind 'fetch'; known kinds: find-target, turn-around, watch-target",
        )

    def test_kind_from_the_wire_is_never_imported(self) -> None:
        """A kind that is written as a module and a name is looked up like any other, and imports nothing."""
        sys.modules.pop("this", None)
        for kind in ("this:s", "os:system", "subprocess:Popen", "agents.turn:TurnAround"):
            self.assertIn("no behaviour", self.refusal(replace(TASK, kind=kind)))
        self.assertNotIn("this", sys.modules)

    def test_wrong_parameters_are_refused(self) -> None:
        """Parameters that a behaviour cannot have are an UnknownTask with the reason, and no other error."""
        every: list[Any] = [{"turns": "x"}, {"turns": -1.0}, {"turns": []}, [], None, 7]
        for parameters in every:
            task = replace(TASK, parameters=parameters)
            self.assertIn("invalid parameters", self.refusal(task))

    def test_missing_vision_names_the_extra(self) -> None:
        """Where OpenCV is not installed a task that needs eyes says what to install."""
        hidden = {n: sys.modules.pop(n) for n in list(sys.modules) if n in ("agents.search", "agents.vision", "cv2")}
        sys.modules["cv2"] = None  # type: ignore[assignment]

        def restore() -> None:
            for name in ("agents.search", "agents.vision", "cv2"):
                sys.modules.pop(name, None)
            sys.modules.update(hidden)

        self.addCleanup(restore)
        error = self.assertRaises(MissingExtra, behaviour_for, replace(TASK, kind="find-target"), random.Random(1))
        self.assertIn("pip install 'swarm-node[vision]'", str(error))
