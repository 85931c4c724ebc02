"""Brains, which control a robot in steps of 0.1 s, and the engine that runs one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from twisted.internet.defer import Deferred
from twisted.internet.interfaces import IReactorTime
from twisted.internet.task import LoopingCall

from drivers.pyro.robot import PyroRobot

DELEGATED_METHODS = (
    *("move", "translate", "rotate", "motors", "stop", "update"),
    *("getDevice", "startDevice", "removeDevice", "hasA", "requires"),
)


class Brain:
    """A brain: override ``setup``, ``step``, and, to release resources, ``destroy``."""

    robot: PyroRobot
    pauseTime = 0.1
    """Seconds between two steps."""

    def __init__(self, name: str = "brain", engine: Engine | None = None, **arguments: Any) -> None:
        self.name = name
        self.engine = engine
        self.stepCount = 0
        self.needToStop = self.needToQuit = 0
        if engine is not None:
            self.robot = engine.robot
        self.setup(**arguments)

    def __getattr__(self, name: str) -> Any:
        """Delegate to the robot: ``self.move(0.5, 0.0)`` is ``self.robot.move(0.5, 0.0)``."""
        if name == "robot":
            raise AttributeError("this brain has no engine and therefore no robot; run it with an Engine")
        if name not in DELEGATED_METHODS:
            raise AttributeError(f"a brain has no attribute {name!r}")
        return getattr(self.robot, name)

    def setup(self, **arguments: Any) -> None:
        """Initialize the brain."""

    def step(self) -> None:
        """Make one decision; called after the robot was updated."""
        raise NotImplementedError(f"{type(self).__name__} must define the method step()")

    def destroy(self) -> None:
        """Release the resources of ``setup``."""

    def pleaseStop(self) -> None:
        """Pause; the robot stands still."""
        self.needToStop = 1

    def pleaseRun(self) -> None:
        """Continue."""
        self.needToStop = 0

    def quit(self) -> None:
        """End after this step."""
        self.needToQuit = 1

    def getEngine(self) -> Engine | None:
        """Return the engine."""
        return self.engine

    def getRobot(self) -> PyroRobot:
        """Return ``robot``."""
        return self.robot


class Engine:
    """Runs one brain on ``robot``; ``init(engine)`` creates the brain, like ``INIT`` in a brain's file."""

    def __init__(self, robot: PyroRobot, clock: IReactorTime) -> None:
        self.robot = robot
        self.brain: Brain | None = None
        self._clock = clock
        self._loop: LoopingCall | None = None

    def run(self, init: Callable[[Engine], Brain]) -> Deferred[None]:
        """Create the brain, run its steps, then stop the robot.

        Fires when the brain quits; fails with the exception of the brain.
        """
        self.robot.update()
        self.robot.localize()
        brain = self.brain = init(self)
        loop = self._loop = LoopingCall(self._step)
        loop.clock = self._clock
        done: Deferred[Any] = loop.start(brain.pauseTime)
        return done.addBoth(self._on_end)

    def stop(self) -> None:
        """End the brain."""
        if self._loop is not None and self._loop.running:
            self._loop.stop()

    def _step(self) -> None:
        brain = self.brain
        assert brain is not None
        if brain.needToQuit:
            return self.stop()
        self.robot.update()
        if brain.needToStop:
            return self.robot.stop()
        brain.step()
        brain.stepCount += 1

    def _on_end(self, result: Any) -> Any:
        self.robot.stop()
        brain, self.brain = self.brain, None
        if brain is not None:
            brain.destroy()
        return None if isinstance(result, LoopingCall) else result
