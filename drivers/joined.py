"""Joined: one device out of a robot and the parts on its back that only sense, as a camera board or a compass.

The robot is asked for everything that moves, and its link is the device's; parts come and go by themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from twisted.internet.defer import Deferred, DeferredList, fail, maybeDeferred
from twisted.logger import Logger
from twisted.python.failure import Failure

from drivers.driver import Driver, Filming, Permit
from drivers.errors import Unsupported, UsageError
from drivers.reading import Action, Description, Frame, Observation, Value
from drivers.subscribers import Subscribers

CAMERA = "camera"


def described(main: Description, parts: Sequence[Description]) -> Description:
    """What ``main`` and ``parts`` are together; what two of them have is the robot's, or else the earlier part's.

    Raises ``UsageError`` for a part that could move.
    """
    capabilities, rates, skills = dict(main.capabilities), dict(main.rates), list(main.skills)
    for number, part in enumerate(parts, 1):
        if part.limits:
            raise UsageError(
                f"part {number}: a robot of kind {part.kind!r} moves, but parts only sense; "
                "make it the robot, or a device of its own"
            )
        for name, properties in part.capabilities.items():
            capabilities.setdefault(name, properties)
        for name, rate in part.rates.items():
            rates.setdefault(name, rate)
        skills += (name for name in part.skills if name not in skills)
    return replace(main, capabilities=capabilities, rates=rates, skills=tuple(skills))


def joined(main: Driver, parts: Sequence[Driver], name: str) -> Joined:
    """The driver of the device ``name``; it is ``Filming`` where whoever has its camera is."""
    is_filming = isinstance(_seeing((main, *parts)), Filming)
    return (FilmingJoined if is_filming else Joined)(main, parts, name)


class Joined:
    """``main`` with the senses of ``parts``.

    Each observation of the robot carries the newest values of those parts that are ``ready``, and the picture of the
    part that has the camera where the robot has none; a part alone makes no observation.  A key that the robot has
    told once stays the robot's.  ``samples`` are the robot's alone.
    """

    log = Logger()

    def __init__(self, main: Driver, parts: Sequence[Driver], name: str) -> None:
        self._description = described(main.description, [part.description for part in parts])
        self._main = main
        self._parts = dict(zip(_named(parts), parts, strict=True))
        self._name = name
        self._camera = _seeing((main, *parts))
        self._is_left = False
        self._leaving: list[Deferred[None]] = []
        self._told: set[str] = set()
        self._source: Observation | None = None
        self._newest: Observation | None = None
        self._seen = Subscribers[Observation](name, self.log)
        main.subscribe(self._on_main)

    # -- the contract -----------------------------------------------------------------------------------------------

    @property
    def description(self) -> Description:
        """What the robot and its parts are; valid before ``connect``."""
        return self._description

    @property
    def state(self) -> str:
        """Where the robot's link stands, however its parts are."""
        return self._main.state

    @property
    def token(self) -> int:
        """The highest token that the robot has obeyed, as far as it told."""
        return self._main.token

    @property
    def problem(self) -> str:
        """What keeps the robot from being heard, and the remedy, where its driver says so."""
        return str(getattr(self._main, "problem", ""))

    def connect(self) -> Deferred[Description]:
        """Open all links; fires when the first observation of the robot has arrived, whatever its parts do."""
        is_first = self._main.state == "idle"
        connecting = self._main.connect()
        if is_first:
            for kind, part in self._parts.items():
                maybeDeferred(part.connect).addErrback(self._on_no_part, kind)
            connecting.addCallbacks(lambda _: self._description, self._on_no_main)
        return connecting

    def disconnect(self) -> Deferred[None]:
        """Stop the motion, then close all links.  May be called twice."""
        closing = self._main.disconnect()
        self._leave_parts()
        return DeferredList([closing, *self._leaving]).addCallback(lambda _: None)

    def enable(self) -> Deferred[bool]:
        """The robot's motors on."""
        return self._main.enable()

    def disable(self) -> Deferred[bool]:
        """The robot's motors off."""
        return self._main.disable()

    def act(self, action: Action, permit: Permit) -> Action:
        """Have the robot do ``action`` until ``permit.deadline``; raises as its driver does."""
        return self._main.act(action, permit)

    def stop(self) -> Action:
        """Zero motion now; safe in any state and never refused."""
        return self._main.stop()

    def observe(self) -> Observation | None:
        """The robot's newest observation, with what its parts told by then; never blocks."""
        source = self._main.observe()
        if source is not self._source:
            self._source = source
            self._newest = None if source is None else self._joined(source)
        return self._newest

    def subscribe(self, seen: Callable[[Observation], None]) -> Callable[[], None]:
        """Call ``seen`` at each observation of the robot; call what is returned to end that."""
        return self._seen.add(seen)

    def invoke(self, name: str, **arguments: float | str) -> Deferred[Mapping[str, Value]]:
        """Have whoever knows the skill do it, the robot first."""
        for driver in (self._main, *self._parts.values()):
            if name in driver.description.skills:
                return driver.invoke(name, **arguments)
        known = ", ".join(self._description.skills) or "none"
        return fail(Unsupported(f"{self._name} has no skill {name!r}; it knows {known}"))

    def diagnostics(self) -> dict[str, float]:
        """The robot's counters, and each part's behind its kind and a dot, as in ``camera.age``.

        A second part of a kind has its number behind the kind: ``camera2.age``.
        """
        counts = dict(self._main.diagnostics())
        for kind, part in self._parts.items():
            counts |= {f"{kind}.{key}": count for key, count in part.diagnostics().items()}
        return counts

    def _on_main(self, _seen: Observation) -> None:
        observation = self.observe()
        if observation is None:
            return
        self._seen.tell(observation)

    def _joined(self, source: Observation) -> Observation:
        self._told.update(source.values)
        values: dict[str, Value] = {}
        frame = source.frame if self._camera is self._main else None
        for part in self._parts.values():
            sensed = part.observe()
            if sensed is None or part.state != "ready":
                continue
            for key, value in sensed.values.items():
                if key not in self._told:
                    values.setdefault(key, value)
            if part is self._camera and sensed.frame is not None:
                frame = self._dated(sensed.frame, sensed, source)
        return replace(source, values={**values, **source.values}, frame=frame)

    def _dated(self, frame: Frame, sensed: Observation, source: Observation) -> Frame:
        """``frame`` with its moment on the robot's clock: a part counts from another beginning."""
        age = max(0.0, sensed.t_robot - frame.t_robot) + max(0.0, source.t_host - sensed.t_host)
        return replace(frame, t_robot=source.t_robot - age)

    def _on_no_part(self, failure: Failure, kind: str) -> None:
        # A part that never came ends with an error when it is left; that is no news.
        if not self._is_left:
            self.log.error(
                "{robot}: its part {part} is given up: {error}",
                robot=self._name,
                part=kind,
                error=failure.getErrorMessage(),
            )

    def _on_no_main(self, failure: Failure) -> Failure:
        self._leave_parts()
        return failure

    def _leave_parts(self) -> None:
        if not self._is_left:
            self._is_left = True
            self._leaving = [part.disconnect() for part in self._parts.values()]


class FilmingJoined(Joined):
    """One whose camera takes as many pictures a second as it is asked for."""

    @property
    def camera_fps(self) -> float:
        """So many it takes."""
        return self._filming.camera_fps

    def set_camera_fps(self, fps: float) -> None:
        """Have it take ``fps``, 0: none."""
        self._filming.set_camera_fps(fps)

    @property
    def _filming(self) -> Filming:
        camera: Any = self._camera
        assert isinstance(camera, Filming)
        return camera


def _seeing(drivers: Sequence[Driver]) -> Driver | None:
    return next((driver for driver in drivers if CAMERA in driver.description.capabilities), None)


def _named(parts: Sequence[Driver]) -> list[str]:
    kinds = [part.description.kind for part in parts]
    before = [kinds[:place].count(kind) for place, kind in enumerate(kinds)]
    return [f"{kind}{count + 1}" if count else kind for kind, count in zip(kinds, before, strict=True)]
