"""Run a scenario of faults on a stage, and measure the time of each takeover.

The stage is a running team (``swarm chaos``) or a simulated one in virtual time; both run the same steps.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

from middleware.directory.presence import Device
from middleware.faults.kinds import KINDS, Fault
from middleware.faults.scenario import ANY, WHO_ACTS, Scenario
from middleware.faults.takeover import TARGET_S, Takeover, acting

LOOK_S = 0.05
PATIENCE_S = 60.0
"""Seconds to wait for an executing device, or for the device with a given name."""
SETTLED_S = 6.0
"""Seconds after a fault without a takeover within which the remaining devices can end the task."""
BODILESS = {"bootstrap", "web"}


class NobodyThere(Exception):
    """The device for a fault is not present; ``str()`` is one line for display."""


class Stage(Protocol):
    """A team for fault scenarios; ``seconds`` is its clock."""

    def seconds(self) -> float:
        """Return the time in seconds."""

    def wait(self, seconds: float) -> None:
        """Wait for ``seconds``."""

    def devices(self) -> list[Device]:
        """Return the present devices, in the order of joining."""

    def assign(self, task: str) -> str:
        """Publish a predefined task; returns its id."""

    def cause(self, device: Device, fault: Fault) -> float:
        """Inject the fault into the device; returns the seconds until it begins, when the device has confirmed."""

    def is_over(self, task_id: str) -> bool:
        """Return whether the task has ended."""


@dataclass
class Loss:
    """One fault of a device and its takeover; ``is_ended``: the task ended before a takeover."""

    device: str
    fault: Fault
    clock: Takeover
    to: str = ""
    is_ended: bool = False

    @property
    def is_lost(self) -> bool:
        """Whether a device with this fault cannot continue its task."""
        return KINDS[self.fault.kind].is_lost

    @property
    def held(self) -> bool:
        """Whether another device took over in time, if that was necessary."""
        if self.clock.seconds is not None:
            return self.clock.seconds <= TARGET_S
        must = self.is_lost and self.fault.seconds > TARGET_S
        return not (self.clock.task and must) or self.is_ended

    def __str__(self) -> str:
        what = f"{self.device}: {self.fault.kind}"
        if not self.clock.task:
            return f"{what}, executed no task"
        if self.clock.seconds is not None:
            late = "" if self.held else f", later than {TARGET_S:g} s"
            return f"{what}, {self.to} took over {self.clock.task} after {self.clock.seconds:.2f} s{late}"
        if self.is_ended:
            return f"{what}, {self.clock.task} ended before another took over"
        return f"{what}, no device took over {self.clock.task}" if not self.held else f"{what}, no takeover needed"


def play(scenario: Scenario, seed: int, stage: Stage, say: Callable[[str], None]) -> list[Loss]:
    """Run the scenario, and report each loss when it is settled; raises ``NobodyThere``."""
    rng = random.Random(seed)
    losses: list[Loss] = []
    if scenario.task:
        say(f"assigned {scenario.task} as {stage.assign(scenario.task)}")
    began = stage.seconds()
    for step in scenario.steps:
        while stage.seconds() < began + step.at:
            _update(stage, losses, say)
        device = _wait_for_device(stage, step.device, rng, losses, say)
        task = acting(stage.devices()).get(device.uuid, "")
        now = stage.cause(device, step.fault) + stage.seconds()
        lasts = "" if step.fault.kind == "kill" else f" for {step.fault.seconds:g} s"
        say(f"{device.name}: {step.fault.kind}{lasts}")
        losses.append(Loss(device.name, step.fault, Takeover(device.uuid, task, now, now + step.fault.seconds)))
    while any(_is_open(loss, stage.seconds()) for loss in losses):
        _update(stage, losses, say)
    for loss in losses:
        if loss.clock.seconds is None:
            loss.is_ended = bool(loss.clock.task) and stage.is_over(loss.clock.task)
            say(str(loss))
    return losses


def _is_open(loss: Loss, now: float) -> bool:
    return loss.clock.is_open(now) and (loss.is_lost or now < loss.clock.until) and not _is_hopeless(loss, now)


def _is_hopeless(loss: Loss, now: float) -> bool:
    # A killed process has no end of its fault, and the end of a long fault is not awaited.
    return now > loss.clock.began + max(SETTLED_S, min(loss.fault.seconds, 3 * SETTLED_S))


def _update(stage: Stage, losses: Iterable[Loss], say: Callable[[str], None]) -> None:
    stage.wait(LOOK_S)
    devices = stage.devices()
    acts, names = acting(devices), {device.uuid: device.name for device in devices}
    for loss in losses:
        if loss.clock.look(acts, stage.seconds()):
            loss.to = names[loss.clock.to]
            say(str(loss))


def _wait_for_device(
    stage: Stage, wanted: str, rng: random.Random, losses: Iterable[Loss], say: Callable[[str], None]
) -> Device:
    end = stage.seconds() + PATIENCE_S
    while stage.seconds() <= end:
        if found := _matching_devices(stage, wanted, losses):
            return rng.choice(found) if wanted == ANY else found[0]
        _update(stage, losses, say)
    names = ", ".join(device.name for device in stage.devices()) or "none"
    what = "executes a task" if wanted == WHO_ACTS else "can be chosen" if wanted == ANY else f"has the name {wanted}"
    raise NobodyThere(f"no device {what} within {PATIENCE_S:g} s; present devices: {names}")


def _matching_devices(stage: Stage, wanted: str, losses: Iterable[Loss]) -> list[Device]:
    here = stage.devices()
    if wanted == ANY:
        return sorted((each for each in here if not BODILESS & set(each.roles)), key=lambda device: device.name)
    if wanted != WHO_ACTS:
        return [device for device in here if device.name == wanted]
    # An isolated device still reports that it executes the task; skip it.
    lost = {loss.clock.lost for loss in losses if loss.is_lost and stage.seconds() < loss.clock.until}
    acts = acting(here)
    return [device for device in here if device.uuid in acts and device.uuid not in lost]
