"""Tests of ``agents.behaviour``: the choice and creation of a behaviour from a task's kind and parameters."""

from __future__ import annotations

import random
import sys
from dataclasses import replace
from typing import Any

from twisted.trial.unittest import SynchronousTestCase

from agents.behaviour import KINDS, create_behaviour
from agents.motion import MotionCapabilities
from middleware.errors import MissingExtra, UnknownTask
from middleware.tasks.task import Task
from tests.agents.loopback import Loopback

TASK = Task("t1", "turn-around", "Turn")


class BehaviourTests(SynchronousTestCase):
    def refusal(self, task: Task) -> str:
        """Return the error message of a task that gets no behaviour."""
        return str(self.assertRaises(UnknownTask, create_behaviour, task, random.Random(1)))

    def test_known_kinds_are_made(self) -> None:
        """Each listed kind can be created, and has no cost before the first observation."""
        for kind in KINDS:
            self.assertIsNone(create_behaviour(replace(TASK, kind=kind), random.Random(1)).cost)

    def test_behaviour_is_told_what_its_body_can_do(self) -> None:
        """An installed or deployed behaviour receives the motion capabilities if it has the method ``embody``."""
        received: list[MotionCapabilities] = []

        class Bodied:
            def __init__(self, parameters: object, rng: object) -> None: ...

            def embody(self, motion: MotionCapabilities) -> None:
                received.append(motion)

        class Other:
            def __init__(self, parameters: object, rng: object) -> None: ...

        motion = MotionCapabilities()
        deployed = {("behaviour", "bodied"): Loopback.of(Bodied), ("behaviour", "other"): Loopback.of(Other)}
        for kind in ("deployed:bodied", "deployed:other"):
            create_behaviour(replace(TASK, kind=kind), random.Random(1), deployed, motion)
        self.assertEqual([vars(each) for each in received], [vars(motion)])
        turn: Any = create_behaviour(TASK, random.Random(1), None, motion)
        self.assertIs(turn._motion, motion)

    def test_unknown_kind_names_those_there_are(self) -> None:
        """An unknown kind is refused; the error lists the known kinds."""
        self.assertEqual(
            self.refusal(replace(TASK, kind="fetch")),
            "no behaviour for tasks of kind 'fetch'; known kinds: find-target, turn-around, watch-target",
        )

    def test_kind_from_the_wire_is_never_imported(self) -> None:
        """A kind of the form ``module:name`` is unknown, and the node imports nothing."""
        sys.modules.pop("this", None)
        for kind in ("this:s", "os:system", "subprocess:Popen", "agents.turn_around:TurnAround"):
            self.assertIn("no behaviour", self.refusal(replace(TASK, kind=kind)))
        self.assertNotIn("this", sys.modules)

    def test_wrong_parameters_are_refused(self) -> None:
        """Invalid parameters raise UnknownTask with the reason; no other exception is raised."""
        every: list[Any] = [{"turns": "x"}, {"turns": -1.0}, {"turns": []}, [], None, 7]
        for parameters in every:
            task = replace(TASK, parameters=parameters)
            self.assertIn("invalid parameters", self.refusal(task))

    def test_missing_vision_names_the_extra(self) -> None:
        """Without OpenCV, a task that needs vision is refused; the error names the optional dependency to install."""
        hidden = {n: sys.modules.pop(n) for n in list(sys.modules) if n in ("agents.search", "agents.vision", "cv2")}
        sys.modules["cv2"] = None  # type: ignore[assignment]

        def restore() -> None:
            for name in ("agents.search", "agents.vision", "cv2"):
                sys.modules.pop(name, None)
            sys.modules.update(hidden)

        self.addCleanup(restore)
        error = self.assertRaises(MissingExtra, create_behaviour, replace(TASK, kind="find-target"), random.Random(1))
        self.assertIn("pip install 'swarm-node[vision]'", str(error))
