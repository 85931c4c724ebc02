"""Combine a robot and the sensing parts mounted on it (a camera board, a compass) into one device.

Motion commands go to the robot, and its link is the device's link; parts connect and disconnect independently.
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


def combine_descriptions(main: Description, parts: Sequence[Description]) -> Description:
    """Combine the descriptions of ``main`` and ``parts``; if several have the same field, the first of them is used.

    Raises ``UsageError`` for a part that can move.
    """
    capabilities, rates, skills = dict(main.capabilities), dict(main.rates), list(main.skills)
    for number, part in enumerate(parts, 1):
        if part.limits:
            raise UsageError(
                f"part {number}: a robot of kind {part.kind!r} moves, but a part must only sense; "
                "make it the robot, or a separate device"
            )
        for name, properties in part.capabilities.items():
            capabilities.setdefault(name, properties)
        for name, rate in part.rates.items():
            rates.setdefault(name, rate)
        skills += (name for name in part.skills if name not in skills)
    return replace(main, capabilities=capabilities, rates=rates, skills=tuple(skills))


def combine_drivers(main: Driver, parts: Sequence[Driver], name: str) -> CompositeDriver:
    """Return the driver of the device ``name``; it implements ``Filming`` if the driver with the camera does."""
    is_filming = isinstance(_find_camera_driver((main, *parts)), Filming)
    return (FilmingCompositeDriver if is_filming else CompositeDriver)(main, parts, name)


class CompositeDriver:
    """``main`` with the sensors of ``parts``.

    Each observation of the robot also contains the newest values of the parts that are ``ready``. If the robot has no
    camera, the observation contains the picture of the first part that has a camera. Data from a part does not create
    an observation by itself. Once the robot has reported a key, no part overrides that key. ``samples`` come from the
    robot only.
    """

    log = Logger()

    def __init__(self, main: Driver, parts: Sequence[Driver], name: str) -> None:
        self._description = combine_descriptions(main.description, [part.description for part in parts])
        self._main = main
        self._parts = dict(zip(_number_parts(parts), parts, strict=True))
        self._name = name
        self._camera = _find_camera_driver((main, *parts))
        self._is_disconnecting_parts = False
        self._parts_closing: list[Deferred[None]] = []
        self._robot_keys: set[str] = set()
        self._robot_observation: Observation | None = None
        self._newest: Observation | None = None
        self._subscribers = Subscribers[Observation](name, self.log)
        main.subscribe(self._on_main)

    # -- the interface ----------------------------------------------------------------------------------------------

    @property
    def description(self) -> Description:
        """The combined description of the robot and its parts; valid before ``connect``."""
        return self._description

    @property
    def state(self) -> str:
        """The state of the robot's link; the links of the parts do not affect it."""
        return self._main.state

    @property
    def token(self) -> int:
        """The highest token that the robot reports to have obeyed."""
        return self._main.token

    @property
    def problem(self) -> str:
        """The reason why no data arrives from the robot, and the remedy, if its driver reports one."""
        return str(getattr(self._main, "problem", ""))

    def connect(self) -> Deferred[Description]:
        """Open all links; fires when the robot's first observation has arrived, whether or not its parts connect."""
        is_first = self._main.state == "idle"
        connecting = self._main.connect()
        if is_first:
            for kind, part in self._parts.items():
                maybeDeferred(part.connect).addErrback(self._on_part_failed, kind)
            connecting.addCallbacks(lambda _: self._description, self._on_robot_failed)
        return connecting

    def disconnect(self) -> Deferred[None]:
        """Stop the motion, then close all links.  May be called twice."""
        closing = self._main.disconnect()
        self._disconnect_parts()
        return DeferredList([closing, *self._parts_closing]).addCallback(lambda _: None)

    def enable(self) -> Deferred[bool]:
        """Switch the robot's motors on."""
        return self._main.enable()

    def disable(self) -> Deferred[bool]:
        """Switch the robot's motors off."""
        return self._main.disable()

    def act(self, action: Action, permit: Permit) -> Action:
        """Perform ``action`` on the robot until ``permit.deadline``; raises the errors of the robot's driver."""
        return self._main.act(action, permit)

    def stop(self) -> Action:
        """Set the motion to zero now; safe in any state and never refused."""
        return self._main.stop()

    def observe(self) -> Observation | None:
        """Return the robot's newest observation with the values of its parts at that time; never blocks."""
        source = self._main.observe()
        if source is not self._robot_observation:
            self._robot_observation = source
            self._newest = None if source is None else self._merge_parts(source)
        return self._newest

    def subscribe(self, callback: Callable[[Observation], None]) -> Callable[[], None]:
        """Call ``callback`` with each observation of the robot; return a function that ends the subscription."""
        return self._subscribers.add(callback)

    def invoke(self, name: str, **arguments: float | str) -> Deferred[Mapping[str, Value]]:
        """Run the skill on the robot, or on the first part that has it."""
        for driver in (self._main, *self._parts.values()):
            if name in driver.description.skills:
                return driver.invoke(name, **arguments)
        known = ", ".join(self._description.skills) or "none"
        return fail(Unsupported(f"{self._name} has no skill {name!r}; its skills are {known}"))

    def diagnostics(self) -> dict[str, float]:
        """Return the robot's counters, and each part's prefixed with its kind and a dot, as in ``camera.age``.

        For the second part of a kind, its number follows the kind: ``camera2.age``.
        """
        counts = dict(self._main.diagnostics())
        for kind, part in self._parts.items():
            counts |= {f"{kind}.{key}": count for key, count in part.diagnostics().items()}
        return counts

    def _on_main(self, _seen: Observation) -> None:
        observation = self.observe()
        if observation is None:
            return
        self._subscribers.notify(observation)

    def _merge_parts(self, source: Observation) -> Observation:
        self._robot_keys.update(source.values)
        values: dict[str, Value] = {}
        frame = source.frame if self._camera is self._main else None
        for part in self._parts.values():
            sensed = part.observe()
            if sensed is None or part.state != "ready":
                continue
            for key, value in sensed.values.items():
                if key not in self._robot_keys:
                    values.setdefault(key, value)
            if part is self._camera and sensed.frame is not None:
                frame = self._convert_frame_time(sensed.frame, sensed, source)
        return replace(source, values={**values, **source.values}, frame=frame)

    def _convert_frame_time(self, frame: Frame, sensed: Observation, source: Observation) -> Frame:
        """Return ``frame`` with its time converted from the part's clock to the robot's clock (different origins)."""
        age = max(0.0, sensed.t_robot - frame.t_robot) + max(0.0, source.t_host - sensed.t_host)
        return replace(frame, t_robot=source.t_robot - age)

    def _on_part_failed(self, failure: Failure, kind: str) -> None:
        # If a part never connected, disconnecting makes its connect() fail; that is expected.
        if not self._is_disconnecting_parts:
            self.log.error(
                "{robot}: cannot connect to its part {part}: {error}",
                robot=self._name,
                part=kind,
                error=failure.getErrorMessage(),
            )

    def _on_robot_failed(self, failure: Failure) -> Failure:
        self._disconnect_parts()
        return failure

    def _disconnect_parts(self) -> None:
        if not self._is_disconnecting_parts:
            self._is_disconnecting_parts = True
            self._parts_closing = [part.disconnect() for part in self._parts.values()]


class FilmingCompositeDriver(CompositeDriver):
    """A combined device with an adjustable camera frame rate."""

    @property
    def camera_fps(self) -> float:
        """The frame rate in pictures per second."""
        return self._filming.camera_fps

    def set_camera_fps(self, fps: float) -> None:
        """Set the frame rate in pictures per second; 0 switches the camera off."""
        self._filming.set_camera_fps(fps)

    @property
    def _filming(self) -> Filming:
        camera: Any = self._camera
        assert isinstance(camera, Filming)
        return camera


def _find_camera_driver(drivers: Sequence[Driver]) -> Driver | None:
    return next((driver for driver in drivers if CAMERA in driver.description.capabilities), None)


def _number_parts(parts: Sequence[Driver]) -> list[str]:
    kinds = [part.description.kind for part in parts]
    before = [kinds[:place].count(kind) for place, kind in enumerate(kinds)]
    return [f"{kind}{count + 1}" if count else kind for kind, count in zip(kinds, before, strict=True)]
